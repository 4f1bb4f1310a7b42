#include "imu_pose_calib/core/pose_sensor/pose_sensor.h"

#include <algorithm>
#include <cmath>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/text.h"
#include "imu_pose_calib/core/pose_sensor/sensor_problem.h"
#include "imu_pose_calib/core/start/rate_alignment.h"
#include "imu_pose_calib/core/verdict/verdict.h"

namespace imu_pose_calib {
namespace {

using Eigen::Vector3d;

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
  CalibrationOptions options = given;  // those of the marker's poses aside
  options.invert_poses = given.invert_sensor_poses;
  options.position_unit = 1.0;
  options.position_lengthscale_s = options.position_signal_std = options.position_noise_std = 0.0;
  options.rotation_lengthscale_s = options.rotation_signal_std = options.rotation_noise_std = 0.0;
  SessionData data;
  data.poses = poses;
  data.imus.clear();
  ConditionedData conditioned = ConditionData(options, data);
  const PoseTrajectory trajectory = FitTrajectory(options, &conditioned);
  session->epoch_ns = conditioned.pose_epoch_ns;
  session->report = conditioned.pose_report;
  session->samples.resize(conditioned.poses.size());
  for (size_t i = 0; i < conditioned.poses.size(); ++i)
    session->samples[i].measured = conditioned.poses[i];
  session->clock.clock_reference = 0.5 * (conditioned.poses.front().t + conditioned.poses.back().t);
  session->noise << trajectory.position_hyperparameters().noise_std,
      trajectory.rotation_hyperparameters().noise_std;
  session->drift = session->noise;
  const std::vector<TimedSample> rates = TurnRates(trajectory);
  const std::vector<double> shifts = FindTimeShifts(marker, rates, options.min_overlap_s,
                                                    std::nullopt, kCandidates, options.Threads());
  RateAlignment best = MatchRates(marker, rates, shifts,
                                  {"the marker and the sensor", "the sensor's",
                                   "invert_sensor_poses", given.invert_sensor_poses},
                                  options.Threads());
  session->clock.time_shift = best.time_shift;
  return best;
}

/// Begins a piece where V jumps (relocalisation): as the medians of the poses before and after see
/// it, in the V that the pose between implies.
void CutAtJumps(SensorSession* session) {
  std::vector<SensorPose>& samples = session->samples;
  std::vector<Eigen::Array2d> steps;  // of position and rotation, at all but the outermost poses
  for (size_t i = kAround; i + kAround <= samples.size(); ++i) {
    std::vector<Vector6d> residuals;
    for (size_t k = i - kAround; k < i + kAround; ++k)
      residuals.push_back(FindResidual(
          samples[k], Carried(*session, samples[i], samples[k], ImpliedWorld(samples[i]))));
    const auto median = [&](size_t begin) {
      return MedianOfEach(begin, begin + kAround, [&](size_t k) { return residuals[k]; });
    };
    const Vector6d step = median(kAround) - median(0);
    steps.emplace_back(step.head<3>().norm(), step.tail<3>().norm());
  }
  if (steps.empty()) return;
  const Eigen::Array2d usual = MedianOfEach(0, steps.size(), [&](size_t i) { return steps[i]; });
  std::vector<double> sizes;
  for (const Eigen::Array2d& step : steps) sizes.push_back((step / usual).maxCoeff());
  for (size_t i = 0; i < sizes.size(); ++i) {
    const auto begin = sizes.begin() + static_cast<ptrdiff_t>(i - std::min(i, kAround));
    const auto end = sizes.begin() + static_cast<ptrdiff_t>(std::min(i + kAround, sizes.size()));
    if (sizes[i] > kJump && *std::max_element(begin, end) == sizes[i])
      samples[i + kAround].begins_piece = true;
  }
}

/// Refuses a free scale that is surely not that of a metric sensor.
void CheckScale(const CalibrationOptions& options, SensorEstimate* estimate) {
  const Eigen::MatrixXd C = FindSensorCovariance(options, estimate);
  Eigen::Index place = 8;
  for (const SensorSession& session : estimate->sessions) {
    const double sigma = std::sqrt(C(place, place)), off = std::abs(session.scale - 1.0);
    if (off > kForeignScale && off > kSurely * sigma)
      Throw<OptionNeeded>("the sensor's positions are ", Number(session.scale, "%.3g"), " +- ",
                          Number(sigma, "%.2g"),
                          " times those of the marker: set estimate_sensor_scale: true");
    place += 3;
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
  for (SensorSession& session : estimate.sessions) CutAtJumps(&session);
  return estimate;
}

/// Whether it drifts from pose to pose by more than its noise, as estimates that are smoothed
/// (VIO).
bool IsAllDrift(const SensorSession& session) {
  if (session.samples.empty()) return false;
  return (session.drift * std::sqrt(1.0 / session.report.rate_hz) > session.noise).any();
}

/// `variances`: of time shift, drift of the clock and scale.
PoseSensorSession ReportSession(const SensorSession& session, const Vector3d& variances) {
  const double marker_epoch = 1e-9 * static_cast<double>(session.marker->epoch_ns());
  PoseSensorSession result;
  result.is_present = true;
  result.poses = session.report;
  result.time_shift = 1e-9 * static_cast<double>(session.marker->epoch_ns() - session.epoch_ns) +
                      session.clock.time_shift;
  result.time_shift_std = std::sqrt(variances[0]);
  result.clock_drift = session.clock.clock_drift;
  result.clock_drift_std = std::sqrt(variances[1]);
  result.clock_reference =
      1e-9 * static_cast<double>(session.epoch_ns) + session.clock.clock_reference;
  result.scale = session.scale;
  result.scale_std = std::sqrt(variances[2]);
  result.noise = {session.noise[0], session.noise[1]};
  result.drift = {session.drift[0], session.drift[1]};
  Vector6d squares = Vector6d::Zero();
  for (const SensorPose& sample : session.samples) {
    const Rigid3& world = sample.world;
    const double t = marker_epoch + session.clock.PoseTime(sample.measured.t);
    const Vector6d residual = FindResidual(sample, world);
    result.world.push_back({t,
                            {world.q, world.p - session.scale * (world.q * sample.sensor.p_WB)},
                            sample.begins_piece});
    result.residuals.push_back({t, residual.head<3>(),
                                sample.measured.q_WM.conjugate() * Vector3d(residual.tail<3>()),
                                std::min(1.0, sample.weight[0]), std::min(1.0, sample.weight[1]),
                                session.epoch_ns + std::llround(1e9 * sample.measured.t)});
    squares += residual.cwiseAbs2() / static_cast<double>(session.samples.size());
  }
  result.rms = {std::sqrt(squares.head<3>().mean()), std::sqrt(squares.tail<3>().mean())};
  return result;
}

PoseSensorCalibration Report(const CalibrationOptions& options, SensorEstimate* estimate) {
  const Eigen::MatrixXd C = FindSensorCovariance(options, estimate);
  const size_t sessions = estimate->sessions.size();
  PoseSensorCalibration result;
  result.T_MS = estimate->T_MS;
  if (result.T_MS.q.w() < 0.0) result.T_MS.q.coeffs() *= -1.0;
  result.sessions.resize(sessions);
  if (!C.allFinite() || C.diagonal().minCoeff() <= 0.0) {
    result.status = Status::kDegenerate;
    result.message = "the data do not determine all parameters";
    return result;
  }
  result.covariance = C.topLeftCorner<6, 6>();
  AddDirections(C.block<3, 3>(0, 0), "p_MS along ", "marker", "m", &result.observability);
  AddDirections(C.block<3, 3>(3, 3), "R_MS about ", "sensor", "rad", &result.observability);
  for (size_t s = 0; s < sessions; ++s) {
    if (estimate->sessions[s].samples.empty()) continue;
    Vector3d variances = C.diagonal().segment<3>(6 + 3 * static_cast<Eigen::Index>(s));
    if (!options.estimate_clock_drift) variances[1] = 0.0;
    result.sessions[s] = ReportSession(estimate->sessions[s], variances);
    result.observability.push_back({"time_shift" + OfSession(s, sessions),
                                    result.sessions[s].time_shift_std, "s", Status::kNotRun});
  }
  result.status = GradeSpectrum(options, &result.observability, &result.message);
  return result;
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
  PoseSensorCalibration result = Report(options, &estimate);
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

}  // namespace imu_pose_calib
