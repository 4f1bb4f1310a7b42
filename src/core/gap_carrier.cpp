#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <optional>

#include "imu_pose_calib/core/imu_track.h"
#include "imu_pose_calib/core/intrinsics.h"
#include "imu_pose_calib/core/manifolds.h"
#include "imu_pose_calib/core/so3.h"

namespace imu_pose_calib {
namespace {

using Eigen::Matrix3d;
using Eigen::MatrixXd;
using Eigen::Vector3d;
using Matrix9d = Eigen::Matrix<double, 9, 9>;

/// Samples further apart are not interpolated between.
constexpr double kMaxPeriods = 2.5;
/// Of the squared distance of both ways in sigma, 9 degrees of freedom: by chance once in 1e7.
constexpr double kMaxDistance2 = 50.0;

// Places in the error of what is constant across the gap; biases as they are at one of its ends.
constexpr int kMount = 0;                      // p_MI and q_MI, as Ceres turns it
constexpr int kGyroMatrix = kMount + 6;        // of GyroMatrix()
constexpr int kAccelMatrix = kGyroMatrix + 6;  // of AccelMatrix()
constexpr int kScale = kAccelMatrix + 9;       // pose_scale
constexpr int kGravity = kScale + 1;           // in the tangent space
constexpr int kGyroBias = kGravity + 2;
constexpr int kAccelBias = kGyroBias + 3;
constexpr int kConstants = kAccelBias + 3;
using ByConstants = Eigen::Matrix<double, 9, kConstants>;

/// One end of a run: covariance of rotation, position and velocity of the IMU there, of the
/// constants, and of both.
struct RunEnd {
  BodyState state;
  Matrix9d own;
  ByConstants cross;
  Eigen::Matrix<double, kConstants, kConstants> constants;
};

RunEnd FindRunEnd(const Solution& solution,
                  const SessionTrajectory& trajectory,
                  size_t session,
                  size_t imu,
                  double t) {
  const TrajectoryCovariance& covariance = *trajectory.covariance();
  const ImuSessionEstimate& biases = solution.estimate.sessions[session].imus[imu];
  const auto [gyro_knot, gyro_u] = biases.gyro_bias.Locate(biases.ImuTime(t));
  const auto [accel_knot, accel_u] = biases.accel_bias.Locate(biases.ImuTime(t));
  constexpr int kPoints = 6 * kSplineOrder;  // coordinates of the control points
  const auto columns = TrajectoryCovariance::Joined(
      {covariance.ControlPoints(session, solution.splines[session].Locate(t)->first),
       covariance.Calibrated(ParameterKind::kTranslation, imu, 3),
       covariance.Calibrated(ParameterKind::kRotation, imu, 3),
       covariance.Calibrated(ParameterKind::kGyroIntrinsics, imu, 6),
       covariance.Calibrated(ParameterKind::kAccelIntrinsics, imu, 9),
       covariance.Calibrated(ParameterKind::kPoseScale, imu, 1),
       covariance.Gravity(session),
       covariance.BiasKnotPair(session, imu, false, gyro_knot),
       covariance.BiasKnotPair(session, imu, true, accel_knot)});

  RunEnd end;
  SessionTrajectory::StateJacobian J;
  end.state = *trajectory.Imu(imu, t, &J);
  MatrixXd A = MatrixXd::Zero(9 + kConstants, static_cast<Eigen::Index>(columns.size()));
  A.block(0, 0, 6, J.cols()) = J.topRows<6>();
  A.block(6, 0, 3, J.cols()) = J.middleRows<3>(9);
  A.block<kGyroBias, kGyroBias>(9, kPoints).setIdentity();
  const auto knots = [&A](int place, int column, double u) {
    A.block<3, 3>(9 + place, kPoints + column) = (1.0 - u) * Matrix3d::Identity();
    A.block<3, 3>(9 + place, kPoints + column + 3) = u * Matrix3d::Identity();
  };
  knots(kGyroBias, kGyroBias, gyro_u);
  knots(kAccelBias, kGyroBias + 6, accel_u);
  const MatrixXd C = A * covariance.At(columns) * A.transpose();
  end.own = C.topLeftCorner<9, 9>();
  end.cross = C.topRightCorner<9, kConstants>();
  end.constants = C.bottomRightCorner<kConstants, kConstants>();
  return end;
}

/// cross constants^-1, where what is held has no part.
ByConstants Regression(const RunEnd& end) {
  Eigen::Matrix<double, kConstants, 1> inverse_std;
  for (int i = 0; i < kConstants; ++i)
    inverse_std[i] = end.constants(i, i) > 0.0 ? 1.0 / std::sqrt(end.constants(i, i)) : 0.0;
  MatrixXd correlation = inverse_std.asDiagonal() * end.constants * inverse_std.asDiagonal();
  for (int i = 0; i < kConstants; ++i) correlation(i, i) = 1.0;
  const MatrixXd scaled = end.cross * inverse_std.asDiagonal();
  return correlation.ldlt().solve(scaled.transpose()).transpose() * inverse_std.asDiagonal();
}

/// What the IMU measures at one instant: rate and specific force in I.
struct Measured {
  Vector3d omega, f;
};

/// A state on the way, and where its error comes from.
struct Carried {
  CarriedState state;
  Matrix9d by_start = Matrix9d::Identity();        ///< derivative by that of the first state
  ByConstants by_constants = ByConstants::Zero();  ///< derivative by that of the constants
  Matrix9d noise = Matrix9d::Zero();               ///< covariance that the samples since add

  Eigen::Matrix<double, 9, 9 + kConstants> ByBoth() const {
    Eigen::Matrix<double, 9, 9 + kConstants> A;
    A << by_start, by_constants;
    return A;
  }
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
    gravity_basis_ = PlusJacobian(BlockKind::kSphere, 3, g_W_.data());
  }

  /// From recorded values less biases.
  Measured Correct(const Vector3d& gyro, const Vector3d& accel) const {
    return {inverse_M_g_ * gyro, inverse_M_a_ * accel};
  }

  /// Moves the state on by `dt`.
  void Step(const Measured& a, const Measured& b, double dt, Carried* carried) const {
    CarriedState* x = &carried->state;
    // To third order for rates that change linearly.
    const Vector3d turn = 0.5 * dt * (a.omega + b.omega) + dt * dt / 12.0 * a.omega.cross(b.omega);
    const Eigen::Quaterniond after = (x->q_WI * Exp<double>(turn)).normalized();
    const Vector3d a_W = scale_ * (x->q_WI * a.f + g_W_), b_W = scale_ * (after * b.f + g_W_);

    const Matrix3d R = (x->q_WI * Exp<double>(0.5 * turn)).toRotationMatrix();
    const Vector3d omega = 0.5 * (a.omega + b.omega), f = 0.5 * (a.f + b.f);
    const Matrix3d accel_by_turn = -scale_ * R * Hat(f);
    Matrix9d F = Matrix9d::Identity();
    F.block<3, 3>(0, 0) = Exp<double>(-turn).toRotationMatrix();
    F.block<3, 3>(3, 0) = 0.5 * dt * dt * accel_by_turn;
    F.block<3, 3>(3, 6) = dt * Matrix3d::Identity();
    F.block<3, 3>(6, 0) = dt * accel_by_turn;

    ByConstants G = ByConstants::Zero();
    Eigen::Matrix<double, 3, 6> by_M_g = Eigen::Matrix<double, 3, 6>::Zero();
    by_M_g.block<1, 1>(0, 0) = omega.head<1>().transpose();
    by_M_g.block<1, 2>(1, 1) = omega.head<2>().transpose();
    by_M_g.block<1, 3>(2, 3) = omega.transpose();
    G.block<3, 6>(0, kGyroMatrix) = -dt * inverse_M_g_ * by_M_g;
    G.block<3, 3>(0, kGyroBias) = -dt * inverse_M_g_;
    Eigen::Matrix<double, 3, kConstants> accel = Eigen::Matrix<double, 3, kConstants>::Zero();
    Eigen::Matrix<double, 3, 9> by_M_a = Eigen::Matrix<double, 3, 9>::Zero();
    for (int row = 0; row < 3; ++row) by_M_a.block<1, 3>(row, 3 * row) = f.transpose();
    accel.middleCols<9>(kAccelMatrix) = -scale_ * R * inverse_M_a_ * by_M_a;
    accel.middleCols<3>(kAccelBias) = -scale_ * R * inverse_M_a_;
    accel.col(kScale) = R * f + g_W_;
    accel.middleCols<2>(kGravity) = scale_ * gravity_basis_;
    G.middleRows<3>(3) = 0.5 * dt * dt * accel;
    G.middleRows<3>(6) = dt * accel;

    Matrix9d Q = Matrix9d::Zero();
    Q.block<3, 3>(0, 0) = gyro_density_ * dt * Matrix3d::Identity();
    Q.block<3, 3>(3, 3) = accel_density_ * dt * dt * dt / 3.0 * Matrix3d::Identity();
    Q.block<3, 3>(3, 6) = Q.block<3, 3>(6, 3) =
        accel_density_ * dt * dt / 2.0 * Matrix3d::Identity();
    Q.block<3, 3>(6, 6) = accel_density_ * dt * Matrix3d::Identity();

    x->t += dt;
    x->p_WI += dt * x->v_W + dt * dt / 6.0 * (2.0 * a_W + b_W);
    x->v_W += 0.5 * dt * (a_W + b_W);
    x->q_WI = after;
    x->omega_I = b.omega;
    carried->by_start = F * carried->by_start;
    carried->by_constants = F * carried->by_constants + G;
    carried->noise = F * carried->noise * F.transpose() + Q;
  }

 private:
  Vector3d g_W_;
  double scale_;
  double gyro_density_ = 0.0, accel_density_ = 0.0;  ///< [(rad/s)^2/Hz], [(m/s^2)^2/Hz]
  Matrix3d inverse_M_g_, inverse_M_a_;
  Eigen::Matrix<double, 3, 2> gravity_basis_;
};

/// `x` moved by an error of rotation, position and velocity.
void Move(const Eigen::Matrix<double, 9, 1>& error, CarriedState* x) {
  x->q_WI = (x->q_WI * Exp<double>(error.head<3>())).normalized();
  x->p_WI += error.segment<3>(3);
  x->v_W += error.tail<3>();
}

}  // namespace

std::optional<Vector3d> RecordedAt(const std::vector<TimedSample>& samples,
                                   double rate_hz,
                                   double t) {
  const auto after =
      std::lower_bound(samples.begin(), samples.end(), t, [](const TimedSample& s, double value) {
        return s.t < value;
      });
  if (after == samples.begin() || after == samples.end()) return std::nullopt;
  const TimedSample &a = *std::prev(after), &b = *after;
  if (b.t - a.t > kMaxPeriods / rate_hz) return std::nullopt;
  const double u = (t - a.t) / (b.t - a.t);
  return (1.0 - u) * (a.value + a.rest) + u * (b.value + b.rest);
}

std::vector<CarriedState> CarryAcrossGap(const Solution& solution,
                                         const SessionTrajectory& trajectory,
                                         size_t session,
                                         size_t imu,
                                         double begin,
                                         double end) {
  const ConditionedImu& samples = solution.imus[session][imu];
  const ImuSessionEstimate& clock = solution.estimate.sessions[session].imus[imu];
  const double delay = solution.estimate.imus[imu].accel_delay;
  std::vector<double> instants = {begin};
  for (const TimedSample& s : samples.gyro) {
    const double t = clock.PoseTime(s.t);
    if (t > begin && t < end) instants.push_back(t);
  }
  instants.push_back(end);

  const Integrator integrator(solution, session, imu);
  std::vector<Measured> measured;
  for (const double t : instants) {
    const double t_imu = clock.ImuTime(t);
    const auto gyro = RecordedAt(samples.gyro, samples.gyro_report.rate_hz, t_imu);
    const auto accel = RecordedAt(samples.accel, samples.accel_report.rate_hz, t_imu + delay);
    if (!gyro || !accel) return {};
    const ImuBiases biases = trajectory.Biases(imu, t);
    measured.push_back(integrator.Correct(*gyro - biases.gyro, *accel - biases.accel));
  }

  const RunEnd first = FindRunEnd(solution, trajectory, session, imu, begin);
  const RunEnd last = FindRunEnd(solution, trajectory, session, imu, end);
  const BodyState& start = first.state;
  std::vector<Carried> way(instants.size());
  way[0].state = {begin, start.q_WB, start.p_WB, start.v_W, start.omega_B, Matrix9d::Zero()};
  for (size_t j = 1; j < way.size(); ++j) {
    way[j] = way[j - 1];
    integrator.Step(measured[j - 1], measured[j], instants[j] - instants[j - 1], &way[j]);
  }

  // Apart from the constants, both ends err independently: beyond the constants' part the last
  // state has errors of its own, `rest`.
  const ByConstants gain = Regression(last);
  const Matrix9d rest = last.own - gain * last.cross.transpose();
  MatrixXd P(9 + kConstants, 9 + kConstants);  // of the first state and the constants
  P << first.own, first.cross, first.cross.transpose(), first.constants;
  const Carried there = way.back();
  Eigen::Matrix<double, 9, 9 + kConstants> h = there.ByBoth();
  h.rightCols<kConstants>() -= gain;
  const Matrix9d S = h * P * h.transpose() + there.noise + rest;
  Eigen::Matrix<double, 9, 1> distance;
  distance << Log(Eigen::Quaterniond(there.state.q_WI.conjugate() * last.state.q_WB)),
      last.state.p_WB - there.state.p_WI, last.state.v_W - there.state.v_W;
  const Eigen::LDLT<Matrix9d> S_inverse(S);
  if (!(distance.dot(S_inverse.solve(distance)) < kMaxDistance2)) return {};

  std::vector<CarriedState> states;
  for (const Carried& here : way) {
    const auto A = here.ByBoth();
    // What errs until here turns up at the end as much as the steps from here on carry it.
    const Matrix9d rest_of_way = there.by_start * here.by_start.inverse();
    const Matrix9d with_distance = A * P * h.transpose() + here.noise * rest_of_way.transpose();
    const Matrix9d K = S_inverse.solve(with_distance.transpose()).transpose();
    states.push_back(here.state);
    Move(K * distance, &states.back());
    states.back().covariance = A * P * A.transpose() + here.noise - K * S * K.transpose();
  }
  return states;
}

CarriedState Interpolate(const CarriedState& a, const CarriedState& b, double t) {
  const double dt = b.t - a.t, u = (t - a.t) / dt, v = 1.0 - u;
  CarriedState x;
  x.t = t;
  x.q_WI = a.q_WI.slerp(u, b.q_WI);
  // The cubic that has both positions and velocities.
  x.p_WI = v * v * (1.0 + 2.0 * u) * a.p_WI + u * u * (1.0 + 2.0 * v) * b.p_WI +
           dt * u * v * (v * a.v_W - u * b.v_W);
  x.v_W = v * a.v_W + u * b.v_W;
  x.omega_I = v * a.omega_I + u * b.omega_I;
  x.covariance = v * a.covariance + u * b.covariance;
  return x;
}

}  // namespace imu_pose_calib
