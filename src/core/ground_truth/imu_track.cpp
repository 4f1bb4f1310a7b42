#include "imu_pose_calib/core/ground_truth/imu_track.h"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <utility>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/intrinsics.h"
#include "imu_pose_calib/core/base/so3.h"

namespace imu_pose_calib {
namespace {

using Eigen::Matrix3d;
using Eigen::MatrixXd;
using Eigen::Vector3d;

/// Samples further apart are not interpolated between.
constexpr double kMaxPeriods = 2.5;
/// Of the squared distance of both ways in sigma, 9 degrees of freedom: by chance once in 1e7.
constexpr double kMaxDistance2 = 50.0;

// Places in the error of what is constant across the gap; biases as they are at one of its ends.
constexpr int kMount = 0;                      // p_MI and q_MI, as Ceres turns it
constexpr int kGyroMatrix = kMount + 6;        // of GyroMatrix()
constexpr int kAccelMatrix = kGyroMatrix + 6;  // of AccelMatrix()
constexpr int kScale = kAccelMatrix + 9;       // pose_scale
constexpr int kGravity = kScale + 1;
constexpr int kGyroBias = kGravity + 3;
constexpr int kAccelBias = kGyroBias + 3;
constexpr int kConstants = kAccelBias + 3;

/// One end of a run: covariance of rotation, position and velocity of the IMU there (9), and of the
/// constants. Matrices have no sizes at compile time: half a minute of that for what takes
/// milliseconds.
struct RunEnd {
  BodyState state;
  MatrixXd covariance;

  auto own() const { return covariance.topLeftCorner(9, 9); }
  auto cross() const { return covariance.topRightCorner(9, kConstants); }
  auto constants() const { return covariance.bottomRightCorner(kConstants, kConstants); }
};

RunEnd FindRunEnd(const Solution& solution, const SessionTrajectory& trajectory, size_t session,
                  size_t imu, double t) {
  const TrajectoryCovariance& covariance = *trajectory.covariance();
  const ImuSessionEstimate& biases = solution.estimate.sessions[session].imus[imu];
  const auto [gyro_knot, gyro_u] = biases.gyro_bias.Locate(biases.ImuTime(t));
  const auto [accel_knot, accel_u] = biases.accel_bias.Locate(biases.ImuTime(t));
  constexpr int kPoints = 6 * kSplineOrder;  // coordinates of the control points
  RunEnd end;
  SessionTrajectory::StateJacobian J;
  end.state = trajectory.Imu(imu, t, &J).value();
  MatrixXd A = MatrixXd::Zero(9 + kConstants, kPoints + kConstants + 6);  // by two knots each
  A.block(0, 0, 6, J.cols()) = J.topRows<6>();
  A.block(6, 0, 3, J.cols()) = J.middleRows<3>(9);
  A.block(9, kPoints, kGyroBias, kGyroBias).setIdentity();
  const auto knots = [&A](int place, int column, double u) {
    A.block<3, 3>(9 + place, kPoints + column).diagonal().setConstant(1.0 - u);
    A.block<3, 3>(9 + place, kPoints + column + 3).diagonal().setConstant(u);
  };
  knots(kGyroBias, kGyroBias, gyro_u);
  knots(kAccelBias, kGyroBias + 6, accel_u);
  end.covariance = covariance.Of(
      A, {covariance.ControlPoints(session, solution.splines[session].Locate(t).value().first),
          covariance.Calibrated(ParameterKind::kTranslation, imu, 3),
          covariance.Calibrated(ParameterKind::kRotation, imu, 3),
          covariance.Calibrated(ParameterKind::kGyroIntrinsics, imu, 6),
          covariance.Calibrated(ParameterKind::kAccelIntrinsics, imu, 9),
          covariance.Calibrated(ParameterKind::kPoseScale, imu, 1), covariance.Gravity(session),
          covariance.BiasKnotPair(session, imu, false, gyro_knot),
          covariance.BiasKnotPair(session, imu, true, accel_knot)});
  return end;
}

/// cross constants^-1, where what is held has no part.
MatrixXd Regression(const RunEnd& end) {
  MatrixXd constants = end.constants();
  for (int i = 0; i < kConstants; ++i)
    if (constants(i, i) == 0.0) constants(i, i) = 1.0;
  return Solve(constants, end.cross().transpose()).transpose();
}

/// What the IMU measures at one instant: rate and specific force in I.
struct Measured {
  Vector3d omega, f;
};

/// A state on the way, and where its error comes from.
struct Carried {
  ImuState state;
  MatrixXd by_both = MatrixXd::Identity(9, 9 + kConstants);  ///< derivative by the first state's
                                                             ///< error and that of the constants
  MatrixXd noise = MatrixXd::Zero(9, 9);  ///< covariance that the samples since add

  auto by_start() const { return by_both.leftCols(9); }
};

/// Integration along the gap and how its errors grow.
class Integrator {
 public:
  Integrator(const Solution& solution, size_t session, size_t imu)
      : g_W_(solution.estimate.sessions[session].g_W), scale_(solution.estimate.pose_scale) {
    for (const SensorModel& model : solution.models) {
      if (model.session != session || model.imu != imu) continue;
      if (model.quantity == Quantity::kGyro) gyro_density_ = model.Density();
      if (model.quantity == Quantity::kAccel) accel_density_ = model.Density();
    }
    const ImuEstimate& rig = solution.estimate.imus[imu];
    inverse_M_g_ = GyroMatrix(rig.gyro_intrinsics).inverse();
    inverse_M_a_ = AccelMatrix(rig.accel_intrinsics).inverse();
  }

  /// From recorded values less biases.
  Measured Correct(const Vector3d& gyro, const Vector3d& accel) const {
    return {inverse_M_g_ * gyro, inverse_M_a_ * accel};
  }

  /// Moves the state on by `dt`.
  void Step(const Measured& a, const Measured& b, double dt, Carried* carried) const {
    ImuState* x = &carried->state;
    // To third order for rates that change linearly.
    const Vector3d turn = 0.5 * dt * (a.omega + b.omega) + dt * dt / 12.0 * a.omega.cross(b.omega);
    const Eigen::Quaterniond after = (x->q_WB * Exp<double>(turn)).normalized();
    const Vector3d a_W = scale_ * (x->q_WB * a.f + g_W_), b_W = scale_ * (after * b.f + g_W_);

    const Matrix3d R = (x->q_WB * Exp<double>(0.5 * turn)).toRotationMatrix();
    const Vector3d omega = 0.5 * (a.omega + b.omega), f = 0.5 * (a.f + b.f);
    const Matrix3d accel_by_turn = -scale_ * R * Hat(f);
    MatrixXd F = MatrixXd::Identity(9, 9);
    F.block<3, 3>(0, 0) = Exp<double>(-turn).toRotationMatrix();
    F.block<3, 3>(3, 0) = 0.5 * dt * dt * accel_by_turn;
    F.block<3, 3>(3, 6).diagonal().setConstant(dt);
    F.block<3, 3>(6, 0) = dt * accel_by_turn;

    MatrixXd G = MatrixXd::Zero(9, kConstants);
    Eigen::Matrix<double, 3, 6> by_M_g = Eigen::Matrix<double, 3, 6>::Zero();
    by_M_g.block(0, 0, 1, 1) = omega.head(1).transpose();
    by_M_g.block(1, 1, 1, 2) = omega.head(2).transpose();
    by_M_g.block(2, 3, 1, 3) = omega.transpose();
    G.block<3, 6>(0, kGyroMatrix) = -dt * inverse_M_g_ * by_M_g;
    G.block<3, 3>(0, kGyroBias) = -dt * inverse_M_g_;
    MatrixXd accel = MatrixXd::Zero(3, kConstants);
    const Matrix3d by_accel = -scale_ * R * inverse_M_a_;
    for (int row = 0; row < 3; ++row)
      accel.middleCols<3>(kAccelMatrix + 3 * row) = by_accel.col(row) * f.transpose();
    accel.block<3, 3>(0, kAccelBias) = by_accel;
    accel.col(kScale) = R * f + g_W_;
    accel.block<3, 3>(0, kGravity).diagonal().setConstant(scale_);
    G.middleRows(3, 3) = 0.5 * dt * dt * accel;
    G.middleRows(6, 3) = dt * accel;

    MatrixXd Q = MatrixXd::Zero(9, 9);
    const auto add_noise = [&Q](int row, int column, double variance) {
      Q.block<3, 3>(row, column).diagonal().setConstant(variance);
    };
    add_noise(0, 0, gyro_density_ * dt);
    add_noise(3, 3, accel_density_ * dt * dt * dt / 3.0);
    add_noise(3, 6, accel_density_ * dt * dt / 2.0);
    add_noise(6, 3, accel_density_ * dt * dt / 2.0);
    add_noise(6, 6, accel_density_ * dt);

    x->t += dt;
    x->p_WB += dt * x->v_W + dt * dt / 6.0 * (2.0 * a_W + b_W);
    x->v_W += 0.5 * dt * (a_W + b_W);
    x->q_WB = after;
    x->omega_B = b.omega;
    x->a_W = b_W;
    carried->by_both = Product(F, carried->by_both);
    carried->by_both.rightCols(kConstants) += G;
    carried->noise = Propagate(F, carried->noise) + Q;
  }

 private:
  Vector3d g_W_;
  double scale_;
  double gyro_density_ = 0.0, accel_density_ = 0.0;  ///< [(rad/s)^2/Hz], [(m/s^2)^2/Hz]
  Matrix3d inverse_M_g_, inverse_M_a_;
};

/// A sensor as recorded at t [s, IMU clock], linear between samples; nothing where some are
/// missing.
std::optional<Vector3d> RecordedAt(const std::vector<TimedSample>& samples, double rate_hz,
                                   double t) {
  const auto after =
      std::lower_bound(samples.begin(), samples.end(), t,
                       [](const TimedSample& s, double value) { return s.t < value; });
  if (after == samples.begin() || after == samples.end()) return std::nullopt;
  const TimedSample &a = *std::prev(after), &b = *after;
  if (b.t - a.t > kMaxPeriods / rate_hz) return std::nullopt;
  const double u = (t - a.t) / (b.t - a.t);
  return (1.0 - u) * (a.value + a.rest) + u * (b.value + b.rest);
}

/// Turn rates and accelerations at the instants [s, pose clock]; none when the IMU has a gap there.
std::vector<Measured> MeasuredAt(const Solution& solution, const SessionTrajectory& trajectory,
                                 size_t session, size_t imu, const Integrator& integrator,
                                 const std::vector<double>& instants) {
  const ConditionedImu& samples = solution.imus[session][imu];
  const ImuSessionEstimate& clock = solution.estimate.sessions[session].imus[imu];
  const double delay = solution.estimate.imus[imu].accel_delay;
  std::vector<Measured> measured;
  for (const double t : instants) {
    const double t_imu = clock.ImuTime(t);
    const auto gyro = RecordedAt(samples.gyro, samples.gyro_report.rate_hz, t_imu);
    const auto accel = RecordedAt(samples.accel, samples.accel_report.rate_hz, t_imu + delay);
    if (!gyro || !accel) return {};
    const ImuBiases biases = trajectory.Biases(imu, t);
    measured.push_back(integrator.Correct(*gyro - biases.gyro, *accel - biases.accel));
  }
  return measured;
}

/// The motion of an IMU from `begin` to `end` [s, pose clock], between two runs of a joint solve's
/// trajectory: integrated from the state in which the first run ends, and adjusted to meet the one
/// in which the second begins, each by its covariance (doc/trajectory.md). States at both ends and
/// at the samples of the gyroscope in between; none when the IMU has a gap, too, or when the two
/// runs are further apart than their sigmas and the IMU's noise explain.
std::vector<ImuState> CarryAcrossGap(const Solution& solution, const SessionTrajectory& trajectory,
                                     size_t session, size_t imu, double begin, double end) {
  const ConditionedImu& samples = solution.imus[session][imu];
  const ImuSessionEstimate& clock = solution.estimate.sessions[session].imus[imu];
  std::vector<double> instants = {begin};
  for (const TimedSample& s : samples.gyro) {
    const double t = clock.PoseTime(s.t);
    if (t > begin && t < end) instants.push_back(t);
  }
  instants.push_back(end);

  const Integrator integrator(solution, session, imu);
  const std::vector<Measured> measured =
      MeasuredAt(solution, trajectory, session, imu, integrator, instants);
  if (measured.empty()) return {};

  const RunEnd first = FindRunEnd(solution, trajectory, session, imu, begin);
  const RunEnd last = FindRunEnd(solution, trajectory, session, imu, end);
  std::vector<Carried> way(instants.size());
  way[0].state = ImuState(first.state, begin);
  way[0].state.is_carried = true;
  for (size_t j = 1; j < way.size(); ++j) {
    way[j] = way[j - 1];
    integrator.Step(measured[j - 1], measured[j], instants[j] - instants[j - 1], &way[j]);
  }

  // Apart from the constants, both ends err independently: beyond the constants' part the last
  // state has errors of its own, `rest`.
  const MatrixXd gain = Regression(last);
  const MatrixXd rest = last.own() - Product(gain, last.cross().transpose());
  const MatrixXd& P = first.covariance;
  const Carried& there = way.back();
  MatrixXd h = there.by_both;
  h.rightCols(kConstants) -= gain;
  const MatrixXd S = Propagate(h, P) + there.noise + rest;
  Eigen::VectorXd distance(9);
  distance << Log(Eigen::Quaterniond(there.state.q_WB.conjugate() * last.state.q_WB)),
      last.state.p_WB - there.state.p_WB, last.state.v_W - there.state.v_W;
  if (!(SquaredDistance(distance, S) < kMaxDistance2)) return {};
  const MatrixXd S_inverse = Inverse(S);

  std::vector<ImuState> states;
  for (const Carried& here : way) {
    const MatrixXd& A = here.by_both;
    // What errs until here turns up at the end as much as the steps from here on carry it.
    const MatrixXd rest_of_way = Product(there.by_start(), Inverse(here.by_start()));
    const MatrixXd with_distance =
        Product(h, Product(P, A.transpose())) + Product(rest_of_way, here.noise);
    const MatrixXd K = Product(S_inverse, with_distance).transpose();
    states.push_back(here.state);
    ImuState& x = states.back();
    const Eigen::VectorXd error = Product(K, distance);
    x.q_WB = (x.q_WB * Exp<double>(error.head<3>())).normalized();
    x.p_WB += error.segment<3>(3);
    x.v_W += error.tail<3>();
    const MatrixXd C = Propagate(A, P) + here.noise - Propagate(K, S);
    const int place[] = {0, 3, 9};  // of rotation, position and velocity
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        x.covariance.block<3, 3>(place[i], place[j]) = C.block<3, 3>(3 * i, 3 * j);
  }
  return states;
}

/// Between two states that follow each other.
ImuState Interpolate(const ImuState& a, const ImuState& b, double t) {
  const double dt = b.t - a.t, u = (t - a.t) / dt, v = 1.0 - u;
  ImuState x;
  x.t = t;
  x.is_carried = true;
  x.q_WB = a.q_WB.slerp(u, b.q_WB);
  // The cubic that has both positions and velocities.
  x.p_WB = v * v * (1.0 + 2.0 * u) * a.p_WB + u * u * (1.0 + 2.0 * v) * b.p_WB +
           dt * u * v * (v * a.v_W - u * b.v_W);
  x.v_W = v * a.v_W + u * b.v_W;
  x.omega_B = v * a.omega_B + u * b.omega_B;
  x.a_W = v * a.a_W + u * b.a_W;
  x.covariance = v * a.covariance + u * b.covariance;
  return x;
}

}  // namespace

ImuTrack::ImuTrack(const std::shared_ptr<const Solution>& solution, size_t session, size_t imu,
                   TrackClock clock, double max_gap_s)
    : solution_(solution),
      session_(session),
      imu_(imu),
      clock_(clock),
      trajectory_(solution, session) {
  for (const SensorModel& model : solution->models)
    if (model.quantity == Quantity::kGyro && model.session == session && model.imu == imu)
      gyro_noise_ = model.noise;
  if (!has_covariance()) return;
  std::vector<CorrectionSplines::Run> runs;  // of which there is a trajectory
  for (const CorrectionSplines::Run& run : solution->splines[session].Runs())
    if (IsOnTrajectory(*solution->trajectories[session], 0.5 * (run.begin + run.end)))
      runs.push_back(run);
  for (size_t k = 0; k + 1 < runs.size(); ++k) {
    gaps_.push_back({runs[k].end, runs[k + 1].begin, {}});
    TrackGap& gap = gaps_.back();
    if (gap.end - gap.begin <= max_gap_s)
      gap.carried = CarryAcrossGap(*solution, trajectory_, session, imu, gap.begin, gap.end);
  }
}

int64_t ImuTrack::Stamp(double t_imu) const {
  if (clock_ == TrackClock::kImu) return Recorded().epoch_ns + std::llround(1e9 * t_imu);
  return trajectory_.epoch_ns() + std::llround(1e9 * Clock().PoseTime(t_imu));
}

std::vector<ImuTrack::Instant> ImuTrack::Instants(double rate_hz) const {
  std::vector<Instant> instants;
  for (const TimedSample& s : Recorded().gyro)
    instants.push_back({Stamp(s.t), Clock().PoseTime(s.t)});
  return EvenInstants(instants, rate_hz);
}

std::optional<ImuState> ImuTrack::At(double t) const {
  ImuState state;
  const auto next_gap =
      std::upper_bound(gaps_.begin(), gaps_.end(), t,
                       [](double value, const TrackGap& gap) { return value <= gap.begin; });
  if (next_gap != gaps_.begin() && t < std::prev(next_gap)->end) {
    const std::vector<ImuState>& carried = std::prev(next_gap)->carried;
    if (carried.empty()) return std::nullopt;
    const auto after =
        std::upper_bound(carried.begin() + 1, carried.end() - 1, t,
                         [](double value, const ImuState& x) { return value < x.t; });
    state = Interpolate(*std::prev(after), *after, t);
  } else if (const auto body = IsOnTrajectory(*solution_->trajectories[session_], t)
                                   ? trajectory_.Imu(imu_, t)
                                   : std::nullopt) {
    state = ImuState(*body, t);
    if (const auto C = trajectory_.ImuCovariance(imu_, t, clock_ == TrackClock::kImu))
      state.covariance = C->topLeftCorner<12, 12>();
  } else {
    return std::nullopt;
  }
  state.biases = trajectory_.Biases(imu_, t);
  if (const auto C = trajectory_.BiasCovariance(imu_, t)) state.bias_covariance = *C;
  if (!state.is_carried) return state;
  state.covariance.block<3, 3>(6, 6) = gyro_noise_ * gyro_noise_ * Matrix3d::Identity() +
                                       state.bias_covariance.topLeftCorner<3, 3>();
  if (clock_ == TrackClock::kImu) {
    Eigen::Matrix<double, 12, 1> rate;
    rate << state.omega_B, state.v_W, Vector3d::Zero(), state.a_W;
    state.covariance += trajectory_.ClockVariance(imu_, t) * rate * rate.transpose();
  }
  return state;
}

std::vector<ImuTrack::Sample> ImuTrack::Samples() const {
  const double delay = solution_->estimate.imus[imu_].accel_delay;
  std::vector<Sample> samples;
  for (const TimedSample& s : Recorded().gyro) {
    const auto accel = RecordedAt(Recorded().accel, Recorded().accel_report.rate_hz, s.t + delay);
    if (accel) samples.push_back({Stamp(s.t), s.value + s.rest, *accel});
  }
  return samples;
}

std::vector<ImuTrack::Instant> EvenInstants(const std::vector<ImuTrack::Instant>& recorded,
                                            double rate_hz) {
  if (rate_hz == 0.0 || recorded.size() < 2) return recorded;
  const int64_t first = recorded.front().stamp_ns, last = recorded.back().stamp_ns;
  std::vector<ImuTrack::Instant> even;
  auto next = recorded.begin() + 1;
  for (int64_t stamp = first; stamp <= last;
       stamp = first + std::llround(1e9 * static_cast<double>(even.size()) / rate_hz)) {
    while (next->stamp_ns < stamp) ++next;
    const ImuTrack::Instant &a = *std::prev(next), &b = *next;
    const double u = static_cast<double>(stamp - a.stamp_ns);
    even.push_back({stamp, a.t + u / static_cast<double>(b.stamp_ns - a.stamp_ns) * (b.t - a.t)});
  }
  return even;
}

}  // namespace imu_pose_calib
