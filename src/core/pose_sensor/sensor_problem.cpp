#include "imu_pose_calib/core/pose_sensor/sensor_problem.h"

#include <ceres/ceres.h>

#include <Eigen/Cholesky>
#include <Eigen/Sparse>
#include <Eigen/SparseCholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <tuple>
#include <utility>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/base/student_t.h"
#include "imu_pose_calib/core/calibration/marginals.h"

namespace imu_pose_calib {
namespace {

using Eigen::Map;
using Eigen::Quaterniond;
using Eigen::Vector3d;

/// Knots of V: at most so far apart [s], and so close that V moves by a pose's noise from one to
/// the next; the poses around one that its start is the median of.
constexpr double kLongestInterval = 1.0;
constexpr size_t kAround = 5;
constexpr size_t kPerKnot = 4;  // poses that tell outliers
/// Of positions whose scale is not estimated as free [1]: boards and rooms are measured so well.
constexpr double kMetricScale = 2e-3;
constexpr double kHeldDrift = 1e-12;  // [s/s] sigma of a clock's drift that is not estimated
/// Squared drift over squared noise [1/s], its logarithm: what is searched, and how finely.
constexpr double kLeastDrift = -16.0, kMostDrift = 10.0, kDriftStep = 0.25;
/// Noise and drift have settled when what they are together, from one pose to the next and over a
/// second, changes by a smaller share.
constexpr double kSettled = 0.02;
constexpr double kTimeBlocks = 24.0;

template <typename T>
using Vector3 = Eigen::Matrix<T, 3, 1>;

/// R_VW of a knot that has moved.
template <typename T>
Eigen::Quaternion<T> Rotation(const WorldKnot& knot, const T* moved) {
  return Exp<T>(Map<const Vector3<T>>(moved + 3)) * knot.T_VW.q.cast<T>();
}
template <typename T>
Vector3<T> Translation(const WorldKnot& knot, const T* moved) {
  return knot.T_VW.p.cast<T>() + Map<const Vector3<T>>(moved);
}

/// r = ((p_meas - p_VS) / sigma_p, Log(R_VS^-1 R_meas) / sigma_R), 3 rows each. Blocks: p_MS | turn
/// of R_MS on the right (3) | time shift, drift of the clock (further) | scale | the two knots (6).
struct PoseResidual {
  const SensorPose& sample;
  const WorldKnot &knot_0, &knot_1;
  Quaterniond q_MS;
  double own_time, position_sigma, rotation_sigma;

  template <typename T>
  bool operator()(const T* p_MS, const T* turn, const T* clock, const T* scale, const T* moved_0,
                  const T* moved_1, T* residual) const {
    const BodyState& m = sample.marker;
    const T dt = clock[0] + own_time * clock[1];
    const Vector3<T> turned = (m.omega_B.cast<T>() + T(0.5) * dt * m.alpha_B.cast<T>()) * dt;
    const Eigen::Quaternion<T> q_WM = m.q_WB.cast<T>() * Exp<T>(turned);
    const Vector3<T> p_WM =
        m.p_WB.cast<T>() + dt * (m.v_W.cast<T>() + T(0.5) * dt * m.a_W.cast<T>());
    const Eigen::Quaternion<T> q_0 = Rotation(knot_0, moved_0);
    const Vector3<T> between = Log<T>(q_0.conjugate() * Rotation(knot_1, moved_1));
    const Eigen::Quaternion<T> q_VW = q_0 * Exp<T>(T(sample.u) * between);
    const Vector3<T> p_VW = T(1.0 - sample.u) * Translation(knot_0, moved_0) +
                            T(sample.u) * Translation(knot_1, moved_1);
    const Vector3<T> p_WS = p_WM + q_WM * Map<const Vector3<T>>(p_MS);
    const Eigen::Quaternion<T> q_VS =
        q_VW * q_WM * q_MS.cast<T>() * Exp<T>(Map<const Vector3<T>>(turn));
    Map<Vector3<T>> position(residual), rotation(residual + 3);
    position = (sample.T_VS.p.cast<T>() - p_VW - *scale * (q_VW * p_WS)) / T(position_sigma);
    rotation = Log<T>(q_VS.conjugate() * sample.T_VS.q.cast<T>()) / T(rotation_sigma);
    return true;
  }
};

/// How V moves from one knot to the next where the sensor is, over the sigmas of that.
struct DriftResidual {
  const WorldKnot &knot_0, &knot_1;
  double position_sigma, rotation_sigma;

  template <typename T>
  bool operator()(const T* scale, const T* moved_0, const T* moved_1, T* residual) const {
    const Eigen::Quaternion<T> q_0 = Rotation(knot_0, moved_0), q_1 = Rotation(knot_1, moved_1);
    const Vector3<T> p_VS = *scale * knot_0.p_WS.cast<T>();
    Map<Vector3<T>> position(residual), rotation(residual + 3);
    position =
        (Translation(knot_1, moved_1) - Translation(knot_0, moved_0) + (q_1 * p_VS - q_0 * p_VS)) /
        T(position_sigma);
    rotation = Log<T>(q_1 * q_0.conjugate()) / T(rotation_sigma);
    return true;
  }
};

/// An element of a block less what is expected, over sigma.
struct Prior {
  int element;
  double expected, sigma;
  template <typename T>
  bool operator()(const T* block, T* residual) const {
    residual[0] = (block[element] - T(expected)) / T(sigma);
    return true;
  }
};

template <typename Residual, int... kSizes>
ceres::CostFunction* Automatic(Residual residual) {
  return new ceres::AutoDiffCostFunction<Residual, kSizes...>(new Residual(std::move(residual)));
}

/// The cost of all sessions. Refers to the estimate; its solution is taken from `p_MS` and so on.
struct SensorProblem {
  ceres::Problem problem;
  Vector3d p_MS, turn = Vector3d::Zero();
  struct Clock {
    double value[2] = {0.0, 0.0};
  };
  std::vector<Clock> clocks;
  std::vector<double> scales;
  /// Of each session that has the sensor: what is calibrated, then the knots.
  std::vector<double*> calibrated, knots;
  std::vector<ceres::ResidualBlockId> residuals;
  std::vector<std::pair<size_t, double>> places;  ///< of residuals: session and t

  SensorProblem(const CalibrationOptions& options, SensorEstimate* estimate)
      : p_MS(estimate->T_MS.p), clocks(estimate->sessions.size()) {
    for (const SensorSession& session : estimate->sessions) scales.push_back(session.scale);
    calibrated = {p_MS.data(), turn.data()};
    for (size_t s = 0; s < clocks.size(); ++s)
      if (!estimate->sessions[s].samples.empty()) AddSession(options, estimate, s);
  }

  template <typename... Blocks>
  void Add(size_t session, double t, ceres::CostFunction* cost, Blocks... blocks) {
    residuals.push_back(problem.AddResidualBlock(cost, nullptr, blocks...));
    places.emplace_back(session, t);
  }

  void AddSession(const CalibrationOptions& options, SensorEstimate* estimate, size_t s) {
    SensorSession& session = estimate->sessions[s];
    double *const clock = clocks[s].value, *const scale = &scales[s];
    for (const SensorPose& sample : session.samples) {
      WorldKnot &knot_0 = session.knots[sample.knot], &knot_1 = session.knots[sample.knot + 1];
      PoseResidual residual{
          sample,
          knot_0,
          knot_1,
          estimate->T_MS.q,
          sample.t - session.reference,
          session.noise.position * sample.position_scale / std::sqrt(sample.position_weight),
          session.noise.rotation * sample.rotation_scale / std::sqrt(sample.rotation_weight)};
      Add(s, sample.t, Automatic<PoseResidual, 6, 3, 3, 2, 1, 6, 6>(std::move(residual)),
          p_MS.data(), turn.data(), clock, scale, knot_0.moved.data(), knot_1.moved.data());
    }
    for (size_t k = 0; k < session.knots.size(); ++k) {
      WorldKnot& knot = session.knots[k];
      knots.push_back(knot.moved.data());
      if (knot.begins_piece) continue;
      WorldKnot& before = session.knots[k - 1];
      const double root = std::sqrt(knot.t - before.t);
      Add(s, before.t,
          Automatic<DriftResidual, 6, 1, 6, 6>(DriftResidual{
              before, knot, root * session.drift.position, root * session.drift.rotation}),
          scale, before.moved.data(), knot.moved.data());
    }
    const double drift_sigma = options.estimate_clock_drift ? kDriftPrior : kHeldDrift;
    Add(s, session.reference, Automatic<Prior, 1, 2>(Prior{1, -session.clock_drift, drift_sigma}),
        clock);
    if (!options.estimate_sensor_scale)
      Add(s, session.reference, Automatic<Prior, 1, 1>(Prior{0, 1.0, kMetricScale}), scale);
    calibrated.insert(calibrated.end(), {clock, scale});
  }
};

/// A value of a series, and its derivatives by what is calibrated.
constexpr int kCalibrated = 9;  // time shift, drift of the clock, scale, p_MS, turn of R_MS
using TrackValue = Eigen::Matrix<double, 3, 1 + kCalibrated>;
struct TrackSample {
  double t;
  TrackValue value;
  double variance;  ///< over that of a sample of weight 1
  bool begins_piece;
};

/// Noise per sample, and density of the walk, of a series that is a walk beside white noise (local
/// level model): the likeliest, by the Kalman filter, with the calibration that makes it likeliest:
/// errors of the calibration move with the body and would pass for a walk.
std::pair<double, double> FitWalk(const std::vector<TrackSample>& track) {
  double best = -std::numeric_limits<double>::infinity();
  std::pair<double, double> found;
  for (double x = kLeastDrift; x <= kMostDrift; x += kDriftStep) {
    const double q = std::exp(x);
    TrackValue mean = TrackValue::Zero();
    Eigen::Matrix<double, 1 + kCalibrated, 1 + kCalibrated> products;
    products.setZero();
    double P = 0.0, t = 0.0, log_det = 0.0, count = 1.0;
    for (const TrackSample& sample : track) {
      P += q * (sample.t - t);
      t = sample.t;
      if (sample.begins_piece) {
        mean = sample.value;
        P = sample.variance;
        continue;
      }
      const double F = P + sample.variance;
      const TrackValue innovation = sample.value - mean;
      products += innovation.transpose() * innovation / F;
      log_det += 3.0 * std::log(F);
      count += 3.0;
      mean += P / F * innovation;
      P *= sample.variance / F;
    }
    Eigen::Matrix<double, kCalibrated, kCalibrated> H =
        products.bottomRightCorner<kCalibrated, kCalibrated>();
    H.diagonal().array() += 1e-12 * H.trace() + 1e-24;  // of what does not act
    const Eigen::Matrix<double, kCalibrated, 1> g = products.bottomLeftCorner<kCalibrated, 1>();
    const double squares = products(0, 0) - g.dot(H.ldlt().solve(g));
    const double variance = std::max(squares / count, 1e-24);
    const double log_likelihood = -0.5 * (log_det + count * std::log(variance));
    if (log_likelihood <= best) continue;
    best = log_likelihood;
    found = {std::sqrt(variance), std::sqrt(variance * q)};
  }
  return found;
}

/// Student's t distribution of residuals: their weights, and the factor by which it enlarges the
/// noise of a sample of weight 1 in the information, Fisher's over that of the weighted squares.
double SetWeights(const std::vector<Vector3d>& residuals, double SensorPose::*weight,
                  std::vector<SensorPose>* samples) {
  const StudentT spread = FitStudentT(residuals);
  for (size_t i = 0; i < samples->size(); ++i)
    (*samples)[i].*weight = spread.Weight(residuals[i].squaredNorm());
  return std::sqrt((spread.dof + 5.0) / (spread.dof + 3.0));
}

/// Derivatives of the position and the rotation in V of a sample, which is predicted to be at T_VS,
/// by what is calibrated; the first columns are free.
std::pair<TrackValue, TrackValue> ByCalibration(const SensorEstimate& estimate,
                                                const SensorSession& session,
                                                const SensorPose& sample, const Rigid3& T_VS) {
  const BodyState& m = sample.marker;
  const Quaterniond q_VM = T_VS.q * estimate.T_MS.q.conjugate();
  TrackValue position = TrackValue::Zero(), rotation = TrackValue::Zero();
  position.col(1) =
      session.scale * (q_VM * (m.q_WB.conjugate() * m.v_W + m.omega_B.cross(estimate.T_MS.p)));
  position.col(3) = q_VM * (m.q_WB.conjugate() * m.p_WB + estimate.T_MS.p);
  position.block<3, 3>(0, 4) = q_VM.toRotationMatrix();
  rotation.col(1) = q_VM * m.omega_B;
  rotation.rightCols<3>() = T_VS.q.toRotationMatrix();
  for (TrackValue* const value : {&position, &rotation})
    value->col(2) = (sample.t - session.reference) * value->col(1);
  return {position, rotation};
}

void FindNoise(const SensorEstimate& estimate, SensorSession* session) {
  std::vector<Rigid3> predicted;
  std::vector<Vector6d> residuals;  // in V: position [m], rotation [rad]
  std::vector<Vector3d> positions, rotations;
  for (const SensorPose& sample : session->samples) {
    const Rigid3& T_VS = predicted.emplace_back(PredictPose(estimate, *session, sample));
    residuals.emplace_back() << sample.T_VS.p - T_VS.p,
        Log(Quaterniond(sample.T_VS.q * T_VS.q.conjugate()));
    positions.push_back(residuals.back().head<3>() / sample.position_scale);
    rotations.push_back(residuals.back().tail<3>() / sample.rotation_scale);
  }
  // Where each pose has a knot of its own, residuals are what that leaves and tell no outliers.
  const bool has_freedom = kPerKnot * session->knots.size() < session->samples.size();
  if (has_freedom) {
    session->loss.position = SetWeights(positions, &SensorPose::position_weight, &session->samples);
    session->loss.rotation = SetWeights(rotations, &SensorPose::rotation_weight, &session->samples);
  }
  // What V has moved by since the first knot, where the sensor was, and the piece of each knot.
  std::vector<Vector6d> moved = {Vector6d::Zero()};
  std::vector<int> piece = {0};
  for (size_t k = 1; k < session->knots.size(); ++k) {
    const WorldKnot &last = session->knots[k - 1], &knot = session->knots[k];
    const Vector3d p_VS = session->scale * last.p_WS;
    Vector6d step = Vector6d::Zero();
    if (!knot.begins_piece)
      step << knot.T_VW.p + knot.T_VW.q * p_VS - last.T_VW.p - last.T_VW.q * p_VS,
          Log(Quaterniond(knot.T_VW.q * last.T_VW.q.conjugate()));
    moved.push_back(moved.back() + step);
    piece.push_back(piece.back() + (knot.begins_piece ? 1 : 0));
  }
  std::vector<TrackSample> position, rotation;
  int last_piece = -1;
  for (size_t i = 0; i < residuals.size(); ++i) {
    const SensorPose& sample = session->samples[i];
    const Vector6d value =
        residuals[i] + (1.0 - sample.u) * moved[sample.knot] + sample.u * moved[sample.knot + 1];
    auto [of_position, of_rotation] = ByCalibration(estimate, *session, sample, predicted[i]);
    of_position.col(0) = value.head<3>();
    of_rotation.col(0) = value.tail<3>();
    const bool begins_piece = piece[sample.knot] != std::exchange(last_piece, piece[sample.knot]);
    const auto variance = [](double scale, double weight) { return scale * scale / weight; };
    position.push_back({sample.t, of_position,
                        variance(sample.position_scale, sample.position_weight), begins_piece});
    rotation.push_back({sample.t, of_rotation,
                        variance(sample.rotation_scale, sample.rotation_weight), begins_piece});
  }
  std::tie(session->noise.position, session->drift.position) = FitWalk(position);
  std::tie(session->noise.rotation, session->drift.rotation) = FitWalk(rotation);
  session->noise.position *= session->loss.position;
  session->noise.rotation *= session->loss.rotation;
}

}  // namespace

Rigid3 PredictPose(const SensorEstimate& estimate, const SensorSession& session,
                   const SensorPose& sample) {
  const WorldKnot &knot_0 = session.knots[sample.knot], &knot_1 = session.knots[sample.knot + 1];
  const Rigid3 T_VW{knot_0.T_VW.q.slerp(sample.u, knot_1.T_VW.q),
                    (1.0 - sample.u) * knot_0.T_VW.p + sample.u * knot_1.T_VW.p};
  const BodyState& marker = sample.marker;
  const Vector3d p_WS = marker.p_WB + marker.q_WB * estimate.T_MS.p;
  return {T_VW.q * marker.q_WB * estimate.T_MS.q, T_VW.p + session.scale * (T_VW.q * p_WS)};
}

Rigid3 MedianWorld(const Rigid3& T_MS, double scale, const SensorPose* begin,
                   const SensorPose* end) {
  const auto world = [&](const SensorPose& s) {
    return Quaterniond(s.T_VS.q * (s.marker.q_WB * T_MS.q).conjugate());
  };
  const SensorPose& middle = begin[(end - begin) / 2];
  const Quaterniond q = world(middle);
  const Vector3d p_WS = middle.marker.p_WB + middle.marker.q_WB * T_MS.p;
  std::vector<double> components[6];
  for (const SensorPose* s = begin; s != end; ++s) {
    const Quaterniond q_VW = world(*s);
    const Vector3d turn = Log(Quaterniond(q_VW * q.conjugate()));
    const Vector3d p_VS =
        s->T_VS.p + scale * (q_VW * (p_WS - s->marker.p_WB - s->marker.q_WB * T_MS.p));
    for (int i = 0; i < 3; ++i) {
      components[i].push_back(p_VS[i]);
      components[3 + i].push_back(turn[i]);
    }
  }
  Vector6d median;
  for (int i = 0; i < 6; ++i) median[i] = Median(std::move(components[i]));
  const Quaterniond q_VW = Exp<double>(Vector3d(median.tail<3>())) * q;
  return {q_VW, median.head<3>() - scale * (q_VW * p_WS)};
}

void PlaceSamples(SensorSession* session) {
  std::vector<SensorPose> placed;
  auto before = session->samples.begin();
  for (const TimedPose& pose : session->data.poses) {
    const auto state = session->marker->at(pose.t + session->time_shift +
                                           session->clock_drift * (pose.t - session->reference));
    if (!state) continue;
    placed.push_back(
        {pose.t, *state, {pose.q_WM, pose.p_WM}, pose.position_scale, pose.rotation_scale});
    while (before != session->samples.end() && before->t < pose.t) ++before;
    if (before == session->samples.end() || before->t != pose.t) continue;
    placed.back().position_weight = before->position_weight;
    placed.back().rotation_weight = before->rotation_weight;
  }
  session->samples = std::move(placed);
}

void PlaceKnots(const Rigid3& T_MS, SensorSession* session) {
  std::vector<SensorPose>& samples = session->samples;
  double interval = kLongestInterval;
  for (double PoseStd::*kind : {&PoseStd::position, &PoseStd::rotation})
    if (session->drift.*kind > 0.0)
      interval = std::min(interval, std::pow(session->noise.*kind / session->drift.*kind, 2));
  interval = std::max(interval, 1.0 / session->data.pose_report.rate_hz);
  session->knots.clear();
  auto jump = session->jumps.begin();
  for (size_t begin = 0, end = 0; begin < samples.size(); begin = end) {
    while (jump != session->jumps.end() && *jump < samples[begin].t) ++jump;
    while (end < samples.size() && (jump == session->jumps.end() || samples[end].t < *jump)) ++end;
    const double first = samples[begin].t;
    const double length = std::max(samples[end - 1].t - first, 1e-3);
    const auto intervals = static_cast<size_t>(std::ceil(length / interval));
    const double step = length / static_cast<double>(intervals);
    const size_t first_knot = session->knots.size();
    for (size_t k = 0; k <= intervals; ++k) {
      const double t = first + step * static_cast<double>(k);
      const auto after =
          std::lower_bound(samples.begin() + static_cast<ptrdiff_t>(begin),
                           samples.begin() + static_cast<ptrdiff_t>(end - 1), t,
                           [](const SensorPose& sample, double value) { return sample.t < value; });
      const auto middle = static_cast<size_t>(after - samples.begin());
      const size_t from = std::max(begin + kAround, middle) - kAround;
      const SensorPose* const around = &samples[from];
      session->knots.push_back(
          {t,
           MedianWorld(T_MS, session->scale, around, &samples[0] + std::min(end, middle + kAround)),
           k == 0, after->marker.p_WB + after->marker.q_WB * T_MS.p});
    }
    for (size_t i = begin; i < end; ++i) {
      const double place = (samples[i].t - first) / step;
      const size_t k = std::min(static_cast<size_t>(place), intervals - 1);
      samples[i].knot = first_knot + k;
      samples[i].u = place - static_cast<double>(k);
    }
  }
}

bool SolveSensor(const CalibrationOptions& options, SensorEstimate* estimate) {
  SensorProblem sensor(options, estimate);
  ceres::Solver::Options solver;
  solver.linear_solver_type = ceres::SPARSE_NORMAL_CHOLESKY;
  solver.num_threads = options.Threads();
  solver.max_num_iterations = options.max_iterations;
  solver.function_tolerance = 1e-9;
  solver.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(solver, &sensor.problem, &summary);
  if (!summary.IsSolutionUsable()) return false;
  estimate->T_MS = {(estimate->T_MS.q * Exp<double>(sensor.turn)).normalized(), sensor.p_MS};
  for (size_t s = 0; s < estimate->sessions.size(); ++s) {
    SensorSession& session = estimate->sessions[s];
    session.time_shift += sensor.clocks[s].value[0];
    session.clock_drift += sensor.clocks[s].value[1];
    session.scale = sensor.scales[s];
    for (WorldKnot& knot : session.knots) {
      knot.T_VW = {Rotation(knot, knot.moved.data()).normalized(),
                   Translation(knot, knot.moved.data())};
      knot.moved.setZero();
    }
  }
  return summary.termination_type == ceres::CONVERGENCE;
}

bool FindNoise(SensorEstimate* estimate) {
  bool has_settled = true;
  for (SensorSession& session : estimate->sessions) {
    if (session.samples.empty()) continue;
    const PoseStd noise = session.noise, drift = session.drift;
    FindNoise(*estimate, &session);
    for (double PoseStd::*kind : {&PoseStd::position, &PoseStd::rotation})
      for (const double t : {1.0 / session.data.pose_report.rate_hz, 1.0}) {
        const double before = std::hypot(noise.*kind, drift.*kind * std::sqrt(t));
        const double after = std::hypot(session.noise.*kind, session.drift.*kind * std::sqrt(t));
        has_settled = has_settled && std::abs(std::log(after / before)) <= kSettled;
      }
  }
  return has_settled;
}

SensorCovariance FindSensorCovariance(const CalibrationOptions& options, SensorEstimate* estimate) {
  SensorProblem sensor(options, estimate);
  ceres::Problem::EvaluateOptions what;
  what.parameter_blocks = sensor.calibrated;
  what.parameter_blocks.insert(what.parameter_blocks.end(), sensor.knots.begin(),
                               sensor.knots.end());
  what.residual_blocks = sensor.residuals;
  what.num_threads = options.Threads();
  std::vector<double> residuals;
  ceres::CRSMatrix crs;
  sensor.problem.Evaluate(what, nullptr, &residuals, nullptr, &crs);
  const Map<const Eigen::SparseMatrix<double, Eigen::RowMajor>> J(
      crs.num_rows, crs.num_cols, static_cast<Eigen::Index>(crs.values.size()), crs.rows.data(),
      crs.cols.data(), crs.values.data());
  const Eigen::SparseMatrix<double> columns = J, H = columns.transpose() * columns;
  const Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>> factor(H);
  const auto calibrated = 6 + 3 * static_cast<Eigen::Index>(sensor.calibrated.size() - 2) / 2;
  const Eigen::MatrixXd X = factor.solve(Eigen::MatrixXd::Identity(H.rows(), calibrated));
  // Scores of time blocks.
  double duration = 0.0;
  for (const SensorSession& session : estimate->sessions)
    if (!session.samples.empty()) duration += session.samples.back().t - session.samples.front().t;
  const double block = std::max(duration / kTimeBlocks, 2.0);
  const Eigen::MatrixXd JX = columns * X;
  std::map<std::pair<size_t, int>, Eigen::VectorXd> scores;
  Eigen::Index row = 0;
  for (size_t b = 0; b < sensor.residuals.size(); ++b) {
    const auto& [session, t] = sensor.places[b];
    auto& score =
        scores
            .try_emplace({session, static_cast<int>(t / block)}, Eigen::VectorXd::Zero(calibrated))
            .first->second;
    const int rows =
        sensor.problem.GetCostFunctionForResidualBlock(sensor.residuals[b])->num_residuals();
    for (const Eigen::Index end = row + rows; row < end; ++row)
      score += residuals[static_cast<size_t>(row)] * JX.row(row).transpose();
  }
  const Eigen::MatrixXd model = X.topRows(calibrated);
  Eigen::MatrixXd robust = Eigen::MatrixXd::Zero(calibrated, calibrated);
  for (const auto& [place, score] : scores) robust += score * score.transpose();
  const Eigen::VectorXd enlargement = Enlargement(model, robust);
  return {model, enlargement.asDiagonal() * model * enlargement.asDiagonal()};
}

}  // namespace imu_pose_calib
