#include "imu_pose_calib/core/pose_sensor/pose_sensor.h"

#include <algorithm>
#include <cmath>
#include <string>
#include <utility>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/base/text.h"
#include "imu_pose_calib/core/pose_sensor/sensor_problem.h"
#include "imu_pose_calib/core/start/rate_alignment.h"
#include "imu_pose_calib/core/verdict/observability.h"

namespace imu_pose_calib {
namespace {

using Eigen::Quaterniond;
using Eigen::Vector3d;

constexpr double kStiff = 0.1;         // [1/sqrt(s)] drift over noise at first
constexpr double kForeignScale = 0.1;  // [1] that is no error of a metric sensor,
constexpr double kSurely = 3.0;        // sigmas off
/// A jump: medians of so many poses before and after it differ by so many times the usual.
constexpr size_t kAround = 10;
constexpr double kJump = 10.0;
constexpr int kMaxRounds = 15;

/// Rates of turn of the sensor [rad/s], in S, as often as a gyroscope has them.
std::vector<TimedSample> TurnRates(const PoseTrajectory& trajectory) {
  std::vector<TimedSample> rates;
  MarkerRotation<double> rotation;
  for (double t = 0.0; t <= trajectory.End(); t += kRateBin)
    if (trajectory.EvaluateRotation(t, &rotation)) rates.push_back({t, rotation.omega_M});
  return rates;
}

/// Conditions the poses of a session and finds its clock; returns how R_MS explains its rates.
RateAlignment StartSession(const CalibrationOptions& given, const PoseTrajectory& marker,
                           const std::vector<PoseSample>& poses, SensorSession* session) {
  CalibrationOptions options;
  options.max_gap_s = given.max_gap_s;
  options.min_segment_s = given.min_segment_s;
  options.min_overlap_s = given.min_overlap_s;
  options.max_bad_fraction = given.max_bad_fraction;
  options.outlier_threshold = given.outlier_threshold;
  options.recover_stamps = given.recover_stamps;
  options.num_threads = given.num_threads;
  options.invert_poses = given.invert_sensor_poses;
  SessionData data;
  data.poses = poses;
  data.imus.clear();
  ConditionedData conditioned = ConditionData(options, data);
  const PoseTrajectory trajectory = FitTrajectory(options, &conditioned);
  session->epoch_ns = conditioned.pose_epoch_ns;
  session->report = conditioned.pose_report;
  const std::vector<TimedPose>& own = conditioned.poses;
  session->samples.resize(own.size());
  for (size_t i = 0; i < own.size(); ++i) {
    SensorPose& sample = session->samples[i];
    sample.t = own[i].t;
    sample.T_VS = {own[i].q_WM, own[i].p_WM};
    sample.scale = {own[i].position_scale, own[i].rotation_scale};
  }
  session->reference = 0.5 * (own.front().t + own.back().t);
  session->noise = {trajectory.position_hyperparameters().noise_std,
                    trajectory.rotation_hyperparameters().noise_std};
  session->drift = session->noise;
  const std::vector<TimedSample> rates = TurnRates(trajectory);
  const std::vector<double> shifts = FindTimeShifts(marker, rates, options.min_overlap_s,
                                                    std::nullopt, kCandidates, options.Threads());
  RateAlignment best = AlignRates(marker, rates, shifts, false, options.Threads());
  session->time_shift = best.time_shift;
  if (best.explained >= kMinExplained) return best;
  const double inverted = AlignRates(marker, rates, shifts, true, options.Threads()).explained;
  const std::string agree = "the turn rates of the marker and the sensor agree ";
  if (inverted >= kMinExplained)
    throw OptionNeeded(agree +
                       "only when the sensor's poses are inverted: set "
                       "invert_sensor_poses: " +
                       (given.invert_sensor_poses ? "false" : "true"));
  throw DataError(agree + "at no time shift (best explains " +
                  Number(100.0 * std::max(0.0, best.explained), "%.0f") +
                  " % of them, bound: " + Number(100.0 * kMinExplained, "%.0f") +
                  " %): do both recordings overlap, and are both of the same rigid body?");
}

/// Begins a piece where V jumps (relocalisation): as the medians of the poses before and after see
/// it, in the V that the pose between implies.
void CutAtJumps(SensorSession* session) {
  std::vector<SensorPose>& samples = session->samples;
  std::vector<double> sizes[2];
  for (size_t i = kAround; i + kAround <= samples.size(); ++i) {
    const Rigid3 T_VW = ImpliedWorld(*session, samples[i]);
    std::vector<double> before[6], after[6];
    for (size_t k = i - kAround; k < i + kAround; ++k) {
      const Vector6d residual = FindResidual(*session, samples[k], T_VW);
      for (int axis = 0; axis < 6; ++axis) (k < i ? before : after)[axis].push_back(residual[axis]);
    }
    Vector6d step;
    for (int axis = 0; axis < 6; ++axis) step[axis] = Median(after[axis]) - Median(before[axis]);
    sizes[0].push_back(step.head<3>().norm());
    sizes[1].push_back(step.tail<3>().norm());
  }
  if (sizes[0].empty()) return;
  const double usual[2] = {Median(sizes[0]), Median(sizes[1])};
  std::vector<double> size;
  for (size_t i = 0; i < sizes[0].size(); ++i)
    size.push_back(std::max(sizes[0][i] / usual[0], sizes[1][i] / usual[1]));
  for (size_t i = 0; i < size.size(); ++i) {
    const auto begin = size.begin() + static_cast<ptrdiff_t>(i - std::min(i, kAround));
    const auto end = size.begin() + static_cast<ptrdiff_t>(std::min(i + kAround, size.size()));
    if (size[i] > kJump && *std::max_element(begin, end) == size[i])
      samples[i + kAround].begins_piece = true;
  }
}

/// Refuses a free scale that is surely not that of a metric sensor.
void CheckScale(const CalibrationOptions& options, SensorEstimate* estimate) {
  const Eigen::MatrixXd covariance = FindSensorCovariance(options, estimate).covariance;
  Eigen::Index scale = 8;
  for (const SensorSession& session : estimate->sessions) {
    if (session.samples.empty()) continue;
    const double sigma = std::sqrt(covariance(scale, scale)), off = std::abs(session.scale - 1.0);
    if (off > kForeignScale && off > kSurely * sigma)
      throw OptionNeeded("the sensor's positions are " + Number(session.scale, "%.3g") + " +- " +
                         Number(sigma, "%.2g") +
                         " times those of the marker: set estimate_sensor_scale: true");
    scale += 3;
  }
}

/// Clocks and R_MS in closed form, all else by a first solve in which V may drift.
SensorEstimate StartSensor(const CalibrationOptions& options,
                           const std::shared_ptr<const Solution>& solution,
                           const std::vector<std::vector<PoseSample>>& poses) {
  if (std::all_of(poses.begin(), poses.end(), [](const auto& session) { return session.empty(); }))
    throw DataError("there are no poses");
  SensorEstimate estimate;
  estimate.sessions.resize(poses.size());
  double best = 0.0;
  for (size_t s = 0; s < poses.size(); ++s) {
    SensorSession& session = estimate.sessions[s];
    session.marker = std::make_shared<const SessionTrajectory>(solution, s);
    if (poses[s].empty()) continue;
    const RateAlignment alignment =
        StartSession(options, *solution->trajectories[s], poses[s], &session);
    const double explained = alignment.explained * static_cast<double>(alignment.count);
    if (explained <= best) continue;
    best = explained;
    estimate.T_MS.q = alignment.q_MI;
  }
  for (SensorSession& session : estimate.sessions) PlaceSamples(estimate.T_MS, &session);
  CalibrationOptions free = options;
  free.estimate_sensor_scale = true;
  SolveSensor(free, &estimate);
  if (!options.estimate_sensor_scale) CheckScale(free, &estimate);
  for (SensorSession& session : estimate.sessions) {
    CutAtJumps(&session);
    // A world that is too stiff shows its drift, one that is too loose takes up the motion.
    session.drift = {kStiff * session.noise.position, kStiff * session.noise.rotation};
  }
  return estimate;
}

/// Whether it drifts from pose to pose by more than its noise, as estimates that are smoothed
/// (VIO).
bool IsAllDrift(const SensorSession& session) {
  if (session.samples.empty()) return false;
  const double root = std::sqrt(1.0 / session.report.rate_hz);
  return session.drift.position * root > session.noise.position ||
         session.drift.rotation * root > session.noise.rotation;
}

void ReportSession(const SensorSession& session, PoseSensorSession* result) {
  const int64_t marker_ns = session.marker->epoch_ns();
  result->is_present = true;
  result->poses = session.report;
  result->time_shift =
      1e-9 * static_cast<double>(marker_ns - session.epoch_ns) + session.time_shift;
  result->clock_drift = session.clock_drift;
  result->clock_reference = 1e-9 * static_cast<double>(session.epoch_ns) + session.reference;
  result->scale = session.scale;
  result->noise = session.noise;
  result->drift = session.drift;
  Vector6d squares = Vector6d::Zero();
  for (const SensorPose& sample : session.samples) {
    const double t = 1e-9 * static_cast<double>(marker_ns) + sample.t + session.time_shift +
                     session.clock_drift * (sample.t - session.reference);
    const Vector6d residual = FindResidual(session, sample, sample.T_VW);
    const Vector3d rotation_S = sample.T_VS.q.conjugate() * Vector3d(residual.tail<3>());
    result->world.push_back({t, sample.T_VW, sample.begins_piece});
    result->residuals.push_back(
        {t, residual.head<3>(), rotation_S, std::min(1.0, sample.weight.position),
         std::min(1.0, sample.weight.rotation), session.epoch_ns + std::llround(1e9 * sample.t)});
    squares += residual.cwiseAbs2() / static_cast<double>(session.samples.size());
  }
  result->rms = {std::sqrt(squares.head<3>().mean()), std::sqrt(squares.tail<3>().mean())};
}

void Report(const CalibrationOptions& options, SensorEstimate* solved,
            PoseSensorCalibration* result) {
  const SensorCovariance found = FindSensorCovariance(options, solved);
  const SensorEstimate& estimate = *solved;
  result->T_MS = estimate.T_MS;
  if (result->T_MS.q.w() < 0.0) result->T_MS.q.coeffs() *= -1.0;
  result->sessions.resize(estimate.sessions.size());
  const Eigen::MatrixXd& C = found.covariance;
  if (!C.allFinite() || found.model.diagonal().minCoeff() <= 0.0) {
    result->status = Status::kDegenerate;
    result->message = "the data do not determine all parameters";
    return;
  }
  result->model_covariance = found.model.topLeftCorner<6, 6>();
  result->covariance = C.topLeftCorner<6, 6>();
  AddDirections(C.block<3, 3>(0, 0), "p_MS along ", "marker", "m", &result->observability);
  AddDirections(C.block<3, 3>(3, 3), "R_MS about ", "sensor", "rad", &result->observability);
  Eigen::Index column = 6;
  for (size_t s = 0; s < estimate.sessions.size(); ++s) {
    if (estimate.sessions[s].samples.empty()) continue;
    PoseSensorSession& session = result->sessions[s];
    ReportSession(estimate.sessions[s], &session);
    session.time_shift_std = std::sqrt(C(column, column));
    session.clock_drift_std =
        options.estimate_clock_drift ? std::sqrt(C(column + 1, column + 1)) : 0.0;
    session.scale_std = std::sqrt(C(column + 2, column + 2));
    column += 3;
    result->observability.push_back({"time_shift" + OfSession(s, estimate.sessions.size()),
                                     session.time_shift_std, "s", Status::kNotRun});
  }
  result->status = GradeSpectrum(options, &result->observability, &result->message);
}

}  // namespace

PoseSensorCalibration CalibratePoseSensor(const CalibrationOptions& options,
                                          const std::shared_ptr<const Solution>& solution,
                                          const std::vector<std::vector<PoseSample>>& poses) {
  SensorEstimate estimate = StartSensor(options, solution, poses);
  bool has_settled = false;
  for (int round = 0; round < kMaxRounds && !has_settled; ++round) {
    const bool has_converged = SolveSensor(options, &estimate);
    has_settled = FindNoise(&estimate) && has_converged;
  }
  const bool has_converged = SolveSensor(options, &estimate);
  PoseSensorCalibration result;
  Report(options, &estimate, &result);
  const auto doubt = [&result](const char* message) {
    if (result.status != Status::kOk) return;
    result.status = Status::kWeak;
    result.message = message;
  };
  if (!has_settled || !has_converged)
    doubt("the solve has not settled: the result may move by parts of its sigma");
  if (std::any_of(estimate.sessions.begin(), estimate.sessions.end(), IsAllDrift))
    doubt(
        "from pose to pose it drifts by more than its noise: what such a source errs by is no "
        "walk, goes with the motion, and sigmas may be several times too small");
  return result;
}

BetweenImus BetweenSensors(const Rigid3& T_MF, const Matrix6d& covariance_F, const Rigid3& T_MS,
                           const Matrix6d& covariance_S) {
  Eigen::Matrix<double, 12, 12> both = Eigen::Matrix<double, 12, 12>::Zero();
  both.topLeftCorner<6, 6>() = covariance_F;
  both.bottomRightCorner<6, 6>() = covariance_S;
  return Between(T_MF, T_MS, both);
}

}  // namespace imu_pose_calib
