#include "imu_pose_calib/core/pose_sensor/sensor_problem.h"

#include <ceres/ceres.h>
#include <ceres/normal_prior.h>

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
constexpr int kCalibrated = 9;  // p_MS, turn of R_MS, time shift, drift of the clock, scale

constexpr double PoseStd::*kKinds[] = {&PoseStd::position, &PoseStd::rotation};

template <typename T>
using Vector3 = Eigen::Matrix<T, 3, 1>;

/// T_VW of a knot that has moved.
template <typename T>
std::pair<Eigen::Quaternion<T>, Vector3<T>> Moved(const WorldKnot& knot, const T* moved) {
  return {Exp<T>(Map<const Vector3<T>>(moved + 3)) * knot.T_VW.q.cast<T>(),
          knot.T_VW.p.cast<T>() + Map<const Vector3<T>>(moved)};
}

/// r = ((p_meas - p_VS) / sigma_p, Log(R_VS^-1 R_meas) / sigma_R), 3 rows each. Blocks: p_MS and
/// turn of R_MS on the right | time shift and drift of the clock, further, and scale | the two
/// knots.
struct PoseResidual {
  const SensorPose& sample;
  const WorldKnot &knot_0, &knot_1;
  Quaterniond q_MS;
  double own_time;
  PoseStd sigma;

  template <typename T>
  bool operator()(const T* mount, const T* own, const T* moved_0, const T* moved_1,
                  T* residual) const {
    const BodyState& m = sample.marker;
    const T dt = own[0] + own_time * own[1];
    const Vector3<T> turned = (m.omega_B.cast<T>() + T(0.5) * dt * m.alpha_B.cast<T>()) * dt;
    const Eigen::Quaternion<T> q_WM = m.q_WB.cast<T>() * Exp<T>(turned);
    const Vector3<T> p_WM =
        m.p_WB.cast<T>() + dt * (m.v_W.cast<T>() + T(0.5) * dt * m.a_W.cast<T>());
    const auto [q_0, p_0] = Moved(knot_0, moved_0);
    const auto [q_1, p_1] = Moved(knot_1, moved_1);
    const Vector3<T> turn = T(sample.u) * Log<T>(q_0.conjugate() * q_1);
    const Eigen::Quaternion<T> q_VW = q_0 * Exp<T>(turn);
    const Vector3<T> p_VW = T(1.0 - sample.u) * p_0 + T(sample.u) * p_1;
    const Vector3<T> p_WS = p_WM + q_WM * Map<const Vector3<T>>(mount);
    const Eigen::Quaternion<T> q_VS =
        q_VW * q_WM * q_MS.cast<T>() * Exp<T>(Map<const Vector3<T>>(mount + 3));
    Map<Vector3<T>> position(residual), rotation(residual + 3);
    position = (sample.T_VS.p.cast<T>() - p_VW - own[2] * (q_VW * p_WS)) / T(sigma.position);
    rotation = Log<T>(q_VS.conjugate() * sample.T_VS.q.cast<T>()) / T(sigma.rotation);
    return true;
  }
};

using PoseCost = ceres::AutoDiffCostFunction<PoseResidual, 6, 6, 3, 6, 6>;

PoseResidual Against(const SensorEstimate& estimate, const SensorSession& session,
                     const SensorPose& sample, const PoseStd& sigma) {
  return {sample,          session.knots[sample.knot],   session.knots[sample.knot + 1],
          estimate.T_MS.q, sample.t - session.reference, sigma};
}

/// How V moves from one knot to the next where the sensor is, over the sigmas of that.
struct DriftResidual {
  const WorldKnot &knot_0, &knot_1;
  PoseStd sigma;

  template <typename T>
  bool operator()(const T* own, const T* moved_0, const T* moved_1, T* residual) const {
    const auto [q_0, p_0] = Moved(knot_0, moved_0);
    const auto [q_1, p_1] = Moved(knot_1, moved_1);
    const Vector3<T> p_VS = own[2] * knot_0.p_WS.cast<T>();
    Map<Vector3<T>> position(residual), rotation(residual + 3);
    position = (p_1 - p_0 + (q_1 * p_VS - q_0 * p_VS)) / T(sigma.position);
    rotation = Log<T>(q_1 * q_0.conjugate()) / T(sigma.rotation);
    return true;
  }
};

/// The cost of all sessions. Refers to the estimate; its solution is taken from `mount` and `own`.
struct SensorProblem {
  ceres::Problem problem;
  Vector6d mount = Vector6d::Zero();
  std::vector<Vector3d> own;                    ///< of each session, as PoseResidual has them
  std::vector<std::pair<size_t, double>> rows;  ///< of the Jacobian: session and t

  SensorProblem(const CalibrationOptions& options, SensorEstimate* estimate) {
    mount.head<3>() = estimate->T_MS.p;
    for (const SensorSession& session : estimate->sessions)
      own.emplace_back(0.0, 0.0, session.scale);
    for (size_t s = 0; s < own.size(); ++s)
      if (!estimate->sessions[s].samples.empty()) AddSession(options, estimate, s);
  }

  template <typename... Blocks>
  void Add(size_t session, double t, ceres::CostFunction* cost, Blocks... blocks) {
    problem.AddResidualBlock(cost, nullptr, blocks...);
    rows.insert(rows.end(), static_cast<size_t>(cost->num_residuals()), {session, t});
  }

  void AddSession(const CalibrationOptions& options, SensorEstimate* estimate, size_t s) {
    SensorSession& session = estimate->sessions[s];
    for (const SensorPose& sample : session.samples) {
      PoseStd sigma;
      for (const auto kind : kKinds)
        sigma.*kind = session.noise.*kind * sample.scale.*kind / std::sqrt(sample.weight.*kind);
      Add(s, sample.t, new PoseCost(new PoseResidual(Against(*estimate, session, sample, sigma))),
          mount.data(), own[s].data(), session.knots[sample.knot].moved.data(),
          session.knots[sample.knot + 1].moved.data());
    }
    for (size_t k = 1; k < session.knots.size(); ++k) {
      WorldKnot &last = session.knots[k - 1], &knot = session.knots[k];
      if (knot.begins_piece) continue;
      const double root = std::sqrt(knot.t - last.t);
      Add(s, last.t,
          new ceres::AutoDiffCostFunction<DriftResidual, 6, 3, 6, 6>(new DriftResidual{
              last, knot, {root * session.drift.position, root * session.drift.rotation}}),
          own[s].data(), last.moved.data(), knot.moved.data());
    }
    const Vector3d information(0.0, 1.0 / (options.estimate_clock_drift ? kDriftPrior : kHeldDrift),
                               options.estimate_sensor_scale ? 0.0 : 1.0 / kMetricScale);
    Add(s, session.reference,
        new ceres::NormalPrior(information.asDiagonal().toDenseMatrix(),
                               Vector3d(0.0, -session.clock_drift, 1.0)),
        own[s].data());
  }

  /// What is calibrated, then the knots.
  std::vector<double*> Blocks(SensorEstimate* estimate) {
    std::vector<double*> blocks = {mount.data()};
    for (size_t s = 0; s < own.size(); ++s)
      if (!estimate->sessions[s].samples.empty()) blocks.push_back(own[s].data());
    for (SensorSession& session : estimate->sessions)
      for (WorldKnot& knot : session.knots) blocks.push_back(knot.moved.data());
    return blocks;
  }
};

/// A value of a series, and its derivatives by what is calibrated.
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

/// FindResidual(), and its derivatives by what is calibrated.
Eigen::Matrix<double, 6, 1 + kCalibrated> Residual(const SensorEstimate& estimate,
                                                   const SensorSession& session,
                                                   const SensorPose& sample) {
  const PoseCost cost(new PoseResidual(Against(estimate, session, sample, {1.0, 1.0})));
  Vector6d mount = Vector6d::Zero(), residual;
  mount.head<3>() = estimate.T_MS.p;
  const Vector3d own(0.0, 0.0, session.scale);
  const double* const blocks[] = {mount.data(), own.data(), session.knots[sample.knot].moved.data(),
                                  session.knots[sample.knot + 1].moved.data()};
  Eigen::Matrix<double, 6, 6, Eigen::RowMajor> by_mount;
  Eigen::Matrix<double, 6, 3, Eigen::RowMajor> by_own;
  double* jacobians[] = {by_mount.data(), by_own.data(), nullptr, nullptr};
  cost.Evaluate(blocks, residual.data(), jacobians);
  Eigen::Matrix<double, 6, 1 + kCalibrated> all;
  all << residual, by_mount, by_own;
  return all;
}

void FindNoise(const SensorEstimate& estimate, SensorSession* session) {
  // What V has moved by since the first knot, where the sensor was.
  std::vector<Vector6d> moved = {Vector6d::Zero()};
  for (size_t k = 1; k < session->knots.size(); ++k) {
    const WorldKnot &last = session->knots[k - 1], &knot = session->knots[k];
    moved.push_back(moved.back());
    if (!knot.begins_piece)
      moved.back() += WorldStep(last.T_VW, knot.T_VW, session->scale * last.p_WS);
  }
  // Positions and rotations in V, 3 rows each.
  std::vector<Eigen::Matrix<double, 6, 1 + kCalibrated>> values;
  std::vector<Vector3d> residuals[2];
  for (const SensorPose& sample : session->samples) {
    auto& value = values.emplace_back(Residual(estimate, *session, sample));
    value.bottomRows<3>() = sample.T_VS.q.toRotationMatrix() * value.bottomRows<3>().eval();
    for (int k : {0, 1})
      residuals[k].push_back(value.col(0).segment<3>(3 * k) / sample.scale.*kKinds[k]);
    value.col(0) += (1.0 - sample.u) * moved[sample.knot] + sample.u * moved[sample.knot + 1];
  }
  for (int k : {0, 1}) {
    const auto kind = kKinds[k];
    // Where each pose has a knot of its own, residuals are what that leaves and tell no outliers.
    if (kPerKnot * session->knots.size() < session->samples.size()) {
      const StudentT spread = FitStudentT(residuals[k]);
      for (size_t i = 0; i < values.size(); ++i)
        session->samples[i].weight.*kind = spread.Weight(residuals[k][i].squaredNorm());
      session->loss.*kind = std::sqrt((spread.dof + 5.0) / (spread.dof + 3.0));
    }
    std::vector<TrackSample> track;
    for (size_t i = 0; i < values.size(); ++i) {
      const SensorPose& sample = session->samples[i];
      track.push_back({sample.t, values[i].middleRows<3>(3 * k),
                       std::pow(sample.scale.*kind, 2) / sample.weight.*kind, sample.begins_piece});
    }
    std::tie(session->noise.*kind, session->drift.*kind) = FitWalk(track);
    session->noise.*kind *= session->loss.*kind;
  }
}

/// Samples among the knots.
void LocateSamples(SensorSession* session) {
  const std::vector<WorldKnot>& knots = session->knots;
  auto last = knots.begin();
  for (SensorPose& sample : session->samples) {
    const auto after = KnotAfter(knots, sample.t), before = std::prev(after);
    sample.knot = static_cast<size_t>(before - knots.begin());
    sample.u = (sample.t - before->t) / (after->t - before->t);
    sample.begins_piece =
        std::any_of(last, after, [](const WorldKnot& knot) { return knot.begins_piece; });
    last = after;
  }
}

}  // namespace

Vector6d FindResidual(const SensorEstimate& estimate, const SensorSession& session,
                      const SensorPose& sample) {
  return Residual(estimate, session, sample).col(0);
}

Vector6d WorldStep(const Rigid3& from, const Rigid3& to, const Vector3d& p_V) {
  Vector6d step;
  step << to.p + to.q * p_V - from.p - from.q * p_V, Log(Quaterniond(to.q * from.q.conjugate()));
  return step;
}

Rigid3 MedianWorld(const Rigid3& T_MS, double scale, const SensorPose* begin,
                   const SensorPose* end) {
  const SensorPose& middle = begin[(end - begin) / 2];
  const auto world = [&](const SensorPose& s) {
    const Quaterniond q = s.T_VS.q * (s.marker.q_WB * T_MS.q).conjugate();
    return Rigid3{q, s.T_VS.p - scale * (q * s.p_WS(T_MS))};
  };
  const Rigid3 about{world(middle).q, Vector3d::Zero()};
  const Vector3d p_WS = scale * middle.p_WS(T_MS);
  std::vector<double> components[6];
  for (const SensorPose* s = begin; s != end; ++s) {
    const Vector6d step = WorldStep(about, world(*s), p_WS);
    for (int i = 0; i < 6; ++i) components[i].push_back(step[i]);
  }
  Vector6d median;
  for (int i = 0; i < 6; ++i) median[i] = Median(std::move(components[i]));
  const Quaterniond q = Exp<double>(Vector3d(median.tail<3>())) * about.q;
  return {q, median.head<3>() + about.q * p_WS - q * p_WS};
}

void PlaceSamples(SensorSession* session) {
  std::vector<SensorPose> placed;
  for (SensorPose& sample : session->samples) {
    const auto state = session->marker->Marker(
        sample.t + session->time_shift + session->clock_drift * (sample.t - session->reference));
    if (!state) continue;
    sample.marker = *state;
    placed.push_back(sample);
  }
  session->samples = std::move(placed);
  if (!session->knots.empty()) LocateSamples(session);
}

void PlaceKnots(const Rigid3& T_MS, SensorSession* session) {
  const std::vector<SensorPose>& samples = session->samples;
  double interval = kLongestInterval;
  for (const auto kind : kKinds)
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
    for (size_t k = 0; k <= intervals; ++k) {
      const double t = first + step * static_cast<double>(k);
      const auto after =
          std::lower_bound(samples.begin() + static_cast<ptrdiff_t>(begin),
                           samples.begin() + static_cast<ptrdiff_t>(end - 1), t,
                           [](const SensorPose& sample, double value) { return sample.t < value; });
      const auto middle = static_cast<size_t>(after - samples.begin());
      const SensorPose *const from = &samples[std::max(begin + kAround, middle) - kAround],
                              *const to = &samples[0] + std::min(end, middle + kAround);
      session->knots.push_back(
          {t, MedianWorld(T_MS, session->scale, from, to), k == 0, after->p_WS(T_MS)});
    }
  }
  LocateSamples(session);
}

bool SolveSensor(const CalibrationOptions& options, SensorEstimate* estimate) {
  SensorProblem sensor(options, estimate);
  ceres::Solver::Options solver;
  solver.linear_solver_type = ceres::SPARSE_NORMAL_CHOLESKY;
  solver.num_threads = options.Threads();
  solver.max_num_iterations = options.max_iterations;
  solver.function_tolerance = 1e-9;
  solver.initial_trust_region_radius = 1e12;  // a stiff world moves as a whole at once
  solver.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(solver, &sensor.problem, &summary);
  if (!summary.IsSolutionUsable()) return false;
  const Vector3d turn = sensor.mount.tail<3>();
  estimate->T_MS = {(estimate->T_MS.q * Exp<double>(turn)).normalized(), sensor.mount.head<3>()};
  for (size_t s = 0; s < estimate->sessions.size(); ++s) {
    SensorSession& session = estimate->sessions[s];
    session.time_shift += sensor.own[s][0];
    session.clock_drift += sensor.own[s][1];
    session.scale = sensor.own[s][2];
    for (WorldKnot& knot : session.knots) {
      const auto [q, p] = Moved(knot, knot.moved.data());
      knot.T_VW = {q.normalized(), p};
      knot.moved.setZero();
    }
    PlaceSamples(&session);
  }
  return summary.termination_type == ceres::CONVERGENCE;
}

bool FindNoise(SensorEstimate* estimate) {
  bool has_settled = true;
  for (SensorSession& session : estimate->sessions) {
    if (session.samples.empty()) continue;
    const PoseStd noise = session.noise, drift = session.drift;
    FindNoise(*estimate, &session);
    for (const auto kind : kKinds)
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
  what.parameter_blocks = sensor.Blocks(estimate);
  what.num_threads = options.Threads();
  std::vector<double> residuals;
  ceres::CRSMatrix crs;
  sensor.problem.Evaluate(what, nullptr, &residuals, nullptr, &crs);
  const Map<const Eigen::SparseMatrix<double, Eigen::RowMajor>> J(
      crs.num_rows, crs.num_cols, static_cast<Eigen::Index>(crs.values.size()), crs.rows.data(),
      crs.cols.data(), crs.values.data());
  const Eigen::SparseMatrix<double> columns = J, H = columns.transpose() * columns;
  const Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>> factor(H);
  Eigen::Index calibrated = 6;
  double duration = 0.0;
  for (const SensorSession& session : estimate->sessions) {
    if (session.samples.empty()) continue;
    calibrated += 3;
    duration += session.samples.back().t - session.samples.front().t;
  }
  const Eigen::MatrixXd X = factor.solve(Eigen::MatrixXd::Identity(H.rows(), calibrated));
  // Scores of time blocks.
  const double block = std::max(duration / kTimeBlocks, 2.0);
  const Eigen::MatrixXd JX = columns * X;
  std::map<std::pair<size_t, int>, Eigen::VectorXd> scores;
  for (size_t row = 0; row < sensor.rows.size(); ++row) {
    const auto& [session, t] = sensor.rows[row];
    const std::pair<size_t, int> place{session, static_cast<int>(t / block)};
    auto& score = scores.try_emplace(place, Eigen::VectorXd::Zero(calibrated)).first->second;
    score += residuals[row] * JX.row(static_cast<Eigen::Index>(row)).transpose();
  }
  const Eigen::MatrixXd model = X.topRows(calibrated);
  Eigen::MatrixXd robust = Eigen::MatrixXd::Zero(calibrated, calibrated);
  for (const auto& [place, score] : scores) robust += score * score.transpose();
  const Eigen::VectorXd enlargement = Enlargement(model, robust);
  return {model, enlargement.asDiagonal() * model * enlargement.asDiagonal()};
}

}  // namespace imu_pose_calib
