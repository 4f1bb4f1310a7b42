#include "imu_pose_calib/core/calibrator.h"

#include <algorithm>
#include <cmath>
#include <optional>
#include <string>
#include <utility>

#include "imu_pose_calib/core/base/intrinsics.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibration/gp_problem.h"
#include "imu_pose_calib/core/calibration/joint_solver.h"
#include "imu_pose_calib/core/calibration/knot_spacing.h"
#include "imu_pose_calib/core/pose_sensor/pose_sensor.h"
#include "imu_pose_calib/core/pose_sensor/sensor_track.h"
#include "imu_pose_calib/core/start/data_check.h"
#include "imu_pose_calib/core/start/preparation.h"
#include "imu_pose_calib/core/verdict/verdict.h"

namespace imu_pose_calib {
namespace {

/// "session 2: ", or nothing for the only one.
std::string InSession(size_t session, size_t count) {
  return count == 1 ? "" : "session " + std::to_string(session + 1) + ": ";
}

/// Whether samples were given twice: more than a tenth of the fewer are the same to the last bit at
/// the same stamps.
template <typename Sample>
bool AreShared(const std::vector<Sample>& a, const std::vector<Sample>& b,
               Eigen::Vector3d Sample::*value) {
  size_t equal = 0, i = 0;
  for (const Sample& of_b : b) {
    while (i < a.size() && a[i].t_ns < of_b.t_ns) ++i;
    if (i < a.size() && a[i].t_ns == of_b.t_ns && a[i].*value == of_b.*value) ++equal;
  }
  return 10 * equal > std::min(a.size(), b.size());
}

/// Throws InputError for what cannot be known of several IMUs or sessions and for an IMU or a time
/// that is given twice: two IMUs that agree to the last bit seem to have no noise, and the same
/// data do not tell more the second time. Throws DataError for an IMU without samples.
void CheckRig(const CalibrationOptions& options, const std::vector<SessionData>& sessions) {
  if (sessions.empty()) throw InputError("there is no session to calibrate from");
  const size_t imus = sessions[0].imus.size(), sensors = sessions[0].pose_sensors.size();
  if (imus + sensors == 0) throw InputError("the rig has no imu and no pose sensor");
  for (const SessionData& session : sessions)
    if (session.imus.size() != imus || session.pose_sensors.size() != sensors)
      throw InputError(
          "the sessions are not of one rig: their numbers of imus differ, or of pose sensors");
  for (size_t i = 0; i < imus && imus > 1; ++i)
    if (std::all_of(sessions.begin(), sessions.end(),
                    [i](const SessionData& session) { return session.imus[i].IsEmpty(); }))
      throw DataError("there are no samples" + OfImu(i, imus));
  CheckSingle(options, imus, sessions.size());
  for (const SessionData& session : sessions)
    for (size_t b = 0; b < imus; ++b)
      for (size_t a = 0; a < b; ++a)
        if (AreShared(session.imus[a].gyro, session.imus[b].gyro, &ImuSample::value))
          throw InputError("imu" + std::to_string(b) + " has the samples of imu" +
                           std::to_string(a) + ": give each IMU of the rig once");
  for (size_t b = 0; b < sessions.size(); ++b)
    for (size_t a = 0; a < b; ++a)
      if (AreShared(sessions[a].poses, sessions[b].poses, &PoseSample::p_WM))
        throw InputError(InSession(b, sessions.size()) + "poses of session " +
                         std::to_string(a + 1) +
                         " once more: give each recording once, bags of one with one_recording");
}

void ReportData(const DataCheck& check, SessionCalibration* session) {
  session->poses = check.poses.report;
  session->segments = check.segments;
  session->gaps = check.gaps;
  session->jumps = check.jumps;
  session->imus.resize(check.imus.size());
  for (size_t i = 0; i < check.imus.size(); ++i) {
    session->imus[i].is_present = check.imus[i].gyro.count > 0;
    session->imus[i].gyro = check.imus[i].gyro.report;
    session->imus[i].accel = check.imus[i].accel.report;
  }
}

/// Residuals of the poses when the trajectory is not estimated.
PoseStd PoseResiduals(const PreparedSession& session) {
  double position2 = 0.0, rotation2 = 0.0, count = 0.0;
  for (const TimedPose& pose : session.data.poses) {
    if (!session.trajectory->Contains(pose.t)) continue;
    const Rigid3 smooth = session.trajectory->PoseAt(pose.t);
    position2 += (pose.p_WM - smooth.p).squaredNorm();
    rotation2 += Log(Eigen::Quaterniond(smooth.q.conjugate() * pose.q_WM)).squaredNorm();
    count += 3.0;
  }
  return {std::sqrt(position2 / count), std::sqrt(rotation2 / count)};
}

void ReportEstimate(const Estimate& estimate, const std::vector<PreparedSession>& sessions,
                    Calibration* result) {
  result->pose_smoothing = estimate.pose_smoothing;
  result->position_smoothing = estimate.position_smoothing;
  result->pose_cumulants = estimate.pose_cumulants;
  result->position_cumulants = estimate.position_cumulants;
  result->position_delay = estimate.position_delay;
  result->pose_scale = estimate.pose_scale;
  result->imus.resize(estimate.imus.size());
  for (size_t i = 0; i < estimate.imus.size(); ++i) {
    const ImuEstimate& imu = estimate.imus[i];
    result->imus[i].T_MI = {imu.q_MI.normalized(), imu.p_MI};
    if (imu.q_MI.w() < 0.0) result->imus[i].T_MI.q.coeffs() *= -1.0;
    result->imus[i].accel_delay = imu.accel_delay;
    result->imus[i].gyro_smoothing = estimate.gyro_smoothing + imu.gyro_smoothing;
    result->imus[i].accel_smoothing = i == 0 ? estimate.accel_smoothing : imu.accel_smoothing;
    result->imus[i].mount_compliance = imu.mount_compliance;
    result->imus[i].gyro_matrix = GyroMatrix(imu.gyro_intrinsics);
    result->imus[i].accel_matrix = AccelMatrix(imu.accel_intrinsics);
    result->imus[i].accel_positions = AccelPositions(imu.accel_positions);
  }
  for (size_t s = 0; s < sessions.size(); ++s) {
    result->sessions[s].g_W = estimate.sessions[s].g_W;
    if (result->method == Method::kJoint)
      result->sessions[s].slow_errors = {estimate.sessions[s].position_errors.std,
                                         estimate.sessions[s].rotation_errors.std};
    for (size_t i = 0; i < estimate.imus.size(); ++i) {
      const ImuSessionEstimate& clock = estimate.sessions[s].imus[i];
      if (!clock.is_present) continue;
      ImuSession& own = result->sessions[s].imus[i];
      const int64_t imu_epoch_ns = sessions[s].data.imus[i].epoch_ns;
      own.time_shift = 1e-9 * static_cast<double>(sessions[s].data.pose_epoch_ns - imu_epoch_ns) +
                       clock.time_shift;
      own.clock_drift = clock.clock_drift;
      own.clock_reference = 1e-9 * static_cast<double>(imu_epoch_ns) + clock.clock_reference;
      own.gyro_bias = clock.gyro_bias.Mean();
      own.accel_bias = clock.accel_bias.Mean();
    }
  }
}

void ReportSensors(const Solution& solution, Calibration* result) {
  for (size_t k = 0; k < solution.models.size(); ++k) {
    const SensorModel& model = solution.models[k];
    const SensorStatistics& found = solution.statistics[k];
    SessionCalibration& session = result->sessions[model.session];
    ImuSession& imu = session.imus[model.imu];
    const std::pair<double*, double*> places[] = {
        {&session.noise.position, &session.rms.position},
        {&session.noise.rotation, &session.rms.rotation},
        {&imu.noise.gyro, &imu.rms.gyro},
        {&imu.noise.accel, &imu.rms.accel}};  // in the order of Quantity
    const auto& [noise, rms] = places[static_cast<int>(model.quantity)];
    *noise = found.noise;
    *rms = found.rms;
  }
}

/// Offsets of the clocks over time; sigmas enlarged as that of the time shift.
void ReportClocks(const std::shared_ptr<const Solution>& solution, Calibration* result) {
  for (size_t s = 0; s < result->sessions.size(); ++s) {
    const SessionTrajectory trajectory(solution, s);
    for (size_t i = 0; i < result->imus.size(); ++i) {
      const ImuSessionEstimate& clock = solution->estimate.sessions[s].imus[i];
      if (!clock.is_present) continue;
      ImuSession& own = result->sessions[s].imus[i];
      const double reference = clock.clock_reference, epoch = own.clock_reference - reference;
      own.clock.wanders = !clock.walk.IsLine();
      const std::vector<TimedSample>& gyro = solution->imus[s][i].gyro;
      const std::vector<double> knots =
          own.clock.wanders ? clock.walk.t : std::vector<double>{gyro.front().t, gyro.back().t};
      const bool has_covariance = own.clock.wanders && solution->marginals.inverse.valid();
      const auto model_std = [&](double t) {
        return std::sqrt(trajectory.ClockVariance(i, clock.PoseTime(t)));
      };
      const double enlarged =
          has_covariance ? std::max(1.0, own.time_shift_std / model_std(reference)) : 1.0;
      for (const double t : knots) {
        const double grown = own.clock_drift * (t - reference);
        const double grown_std = own.clock_drift_std * (t - reference);
        own.clock.t.push_back(epoch + t);
        own.clock.offset.push_back(own.time_shift + grown + clock.walk.At(t));
        own.clock.std.push_back(has_covariance ? enlarged * model_std(t)
                                               : std::hypot(own.time_shift_std, grown_std));
      }
      for (const size_t k : clock.walk.steps)
        own.clock.steps.push_back(
            {epoch + clock.walk.t[k + 1], clock.walk.offset[k + 1] - clock.walk.offset[k]});
    }
  }
}

/// Session s, ready to be calibrated, with what its data are in `result`. Nothing when its motion
/// is degenerate, which is the result then. Its data go: those of a long recording are a lot.
/// Throws DataError or OptionNeeded that name the session.
std::optional<PreparedSession> PrepareSession(const CalibrationOptions& options, SessionData* data,
                                              size_t s, Calibration* result) {
  const std::string in_session = InSession(s, result->sessions.size());
  DataCheck check;
  const auto report = [&] {
    ReportData(check, &result->sessions[s]);
    for (const std::string& warning : check.warnings)
      result->warnings.push_back(in_session + warning);
  };
  try {
    PreparedSession session = Prepare(options, *data, &check);
    *data = SessionData();
    report();
    result->sessions[s].position_lengthscale_s =
        session.trajectory->position_hyperparameters().lengthscale_s;
    result->sessions[s].rotation_lengthscale_s =
        session.trajectory->rotation_hyperparameters().lengthscale_s;
    return session;
  } catch (const DegenerateMotion& error) {
    report();
    result->status = Status::kDegenerate;
    result->message = in_session + error.what();
    result->unobservable = {in_session + error.unobservable};
    return std::nullopt;
  } catch (const OptionNeeded& error) {
    throw OptionNeeded(in_session + error.what());
  } catch (const DataError& error) {
    throw DataError(in_session + error.what());
  }
}

/// Adds the start of a session, and of the IMUs it has.
void AddStart(const Estimate& start, Estimate* estimate) {
  estimate->sessions.push_back(start.sessions[0]);
  estimate->imus.resize(start.imus.size());
  for (size_t i = 0; i < start.imus.size(); ++i)
    if (start.sessions[0].imus[i].is_present) estimate->imus[i] = start.imus[i];
}

/// Pose sensor number `sensor` of all sessions. Data that cannot be used, or a motion that is not
/// enough, are its status, not that of the rig.
PoseSensorCalibration CalibrateSensor(const CalibrationOptions& options,
                                      const std::vector<std::vector<PoseSample>>& poses,
                                      size_t sensor, Calibration* result) {
  PoseSensorCalibration calibration;
  try {
    calibration = CalibratePoseSensor(options, result->solution, poses);
    for (size_t s = 0; s < poses.size(); ++s)
      if (calibration.sessions[s].is_present)
        calibration.sessions[s].errors = FindErrors(result->solution, s, calibration);
  } catch (const DataError& error) {
    calibration.sessions.resize(poses.size());
    calibration.status = Status::kDegenerate;
    calibration.message = error.what();
  }
  const std::string name = "sensor" + std::to_string(sensor) + ": ";
  if (calibration.status != Status::kOk) {
    if (result->status == Status::kOk) {
      result->status = Status::kWeak;
      result->message = name + calibration.message;
    }
    result->warnings.push_back(name + calibration.message);
  }
  return calibration;
}

/// Pose sensors of the rig, on the trajectories of the marker in `result`.
void CalibrateSensors(const CalibrationOptions& options, const std::vector<SessionData>& data,
                      const Progress& progress, Calibration* result) {
  if (data[0].pose_sensors.empty() || !result->IsUsable()) return;
  progress("pose sensors", std::nullopt);
  for (size_t k = 0; k < data[0].pose_sensors.size(); ++k) {
    std::vector<std::vector<PoseSample>> poses;
    for (const SessionData& session : data) poses.push_back(session.pose_sensors[k]);
    result->pose_sensors.push_back(CalibrateSensor(options, poses, k, result));
  }
  const auto is_degenerate = [](const PoseSensorCalibration& sensor) {
    return sensor.status == Status::kDegenerate;
  };
  const auto& sensors = result->pose_sensors;
  if (result->imus.empty() && std::all_of(sensors.begin(), sensors.end(), is_degenerate))
    result->status = Status::kDegenerate;
  progress("pose sensors", 0);
}

/// S3 or S4, and S5 but for pose sensors.
Solution SolveRig(const CalibrationOptions& options, const Progress& progress,
                  std::vector<PreparedSession>* sessions, Calibration* result) {
  Estimate estimate;
  for (const PreparedSession& session : *sessions)
    AddStart(Estimate(session, options.bias_knot_interval_s), &estimate);
  const bool is_joint = options.method == Method::kJoint;
  const std::string solve = is_joint ? "trajectory and calibration" : "calibration";
  progress(solve, std::nullopt);
  std::vector<double> spacings;
  for (size_t s = 0; is_joint && s < sessions->size(); ++s) {
    spacings.push_back(ChooseKnotSpacing(options, (*sessions)[s].data));
    result->sessions[s].knot_spacing_s = spacings[s];
  }
  Solution solution = is_joint ? SolveJointly(options, spacings, sessions, &estimate)
                               : SolveAgainstTrajectory(options, *sessions, &estimate);
  progress(solve, solution.iterations);
  progress("sigmas and verdict", std::nullopt);
  ReportEstimate(estimate, *sessions, result);
  ReportSensors(solution, result);
  for (size_t s = 0; !is_joint && s < sessions->size(); ++s)
    result->sessions[s].rms = PoseResiduals((*sessions)[s]);
  const Marginals marginals = CompareSessions(CoverHalves(solution.marginals), result);
  GradeResult(options, marginals, result);
  DoubtResult(*sessions, solution.has_settled, result);
  TestSessionAgreement(result);
  solution.estimate = std::move(estimate);
  progress("sigmas and verdict", 0);
  return solution;
}

}  // namespace

Calibration Calibrate(const CalibrationOptions& options, std::vector<SessionData> data,
                      const Progress& told) {
  const Progress progress = told ? told : [](const std::string&, std::optional<int>) {};
  options.Validate();
  CheckRig(options, data);
  Calibration result;
  result.method = options.method;
  result.imu_model = options.method == Method::kJoint ? options.imu_model : ImuModel::kCalibrated;
  result.imus.resize(data[0].imus.size());
  result.sessions.resize(data.size());
  std::vector<SessionData> of_sensors(data.size());
  for (size_t s = 0; s < data.size(); ++s) of_sensors[s].pose_sensors.swap(data[s].pose_sensors);
  std::vector<PreparedSession> sessions;
  CalibrationOptions of_session = options;
  for (size_t s = 0; s < data.size(); ++s) {
    const std::string preparation = InSession(s, data.size()) + "data and start";
    progress(preparation, std::nullopt);
    std::optional<PreparedSession> session = PrepareSession(of_session, &data[s], s, &result);
    if (!session) return result;
    sessions.push_back(std::move(*session));
    progress(preparation, 0);
    // Initial values are those of the first IMU, time shift and the direction of gravity those of
    // the first session.
    of_session.initial_time_shift.reset();
    of_session.gravity_magnitude = options.GravityMagnitude();
    of_session.latitude.reset();
    of_session.initial_gravity.reset();
  }

  Solution solution;
  if (!result.imus.empty()) {
    solution = SolveRig(options, progress, &sessions, &result);
  } else {  // the trajectories are those of the poses alone
    solution.estimate.sessions.resize(sessions.size());
    result.status = GradeSpectrum(options, &result.observability, &result.message);
  }
  for (PreparedSession& session : sessions) {
    solution.trajectories.push_back(session.trajectory);
    solution.pose_epochs_ns.push_back(session.data.pose_epoch_ns);
    solution.imus.push_back(std::move(session.data.imus));
  }
  result.solution = std::make_shared<const Solution>(std::move(solution));
  ReportClocks(result.solution, &result);
  CalibrateSensors(options, of_sensors, progress, &result);
  return result;
}

Calibration Calibrate(const CalibrationOptions& options, const SessionData& session) {
  return Calibrate(options, std::vector<SessionData>{session});
}

}  // namespace imu_pose_calib
