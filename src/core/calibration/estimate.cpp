#include "imu_pose_calib/core/calibration/estimate.h"

#include <algorithm>
#include <cmath>
#include <map>

namespace imu_pose_calib {
namespace {

constexpr double kPositionErrors = 0.2, kRotationErrors = 0.5;  // [s] between knots of slow errors
constexpr double kPositionStart = 2e-5, kRotationStart = 1e-3;  // [m], [rad] sigma to start from

}  // namespace

BiasKnots::BiasKnots(const std::vector<TimedSample>& samples, double interval_s,
                     const Eigen::Vector3d& initial) {
  if (interval_s == 0.0) {
    for (const TimedSample& s : samples) t.push_back(s.t);
  } else {
    t = BiasKnots(samples.front().t, samples.back().t, interval_s).t;
  }
  values.assign(t.size(), initial);
}

BiasKnots::BiasKnots(double begin, double end, double interval_s) {
  const int intervals = std::max(1, static_cast<int>(std::ceil((end - begin) / interval_s)));
  for (int k = 0; k <= intervals; ++k) t.push_back(begin + (end - begin) * k / intervals);
  values.assign(t.size(), Eigen::Vector3d::Zero());
}

std::pair<size_t, double> BiasKnots::Locate(double time) const {
  const auto after = std::upper_bound(t.begin() + 1, t.end() - 1, time);
  const auto k = static_cast<size_t>(after - t.begin()) - 1;
  return {k, std::clamp((time - t[k]) / (t[k + 1] - t[k]), 0.0, 1.0)};
}

Eigen::Vector3d BiasKnots::At(double time) const {
  const auto [k, u] = Locate(time);
  return (1.0 - u) * values[k] + u * values[k + 1];
}

Eigen::Vector3d BiasKnots::Mean() const {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  for (const Eigen::Vector3d& v : values) sum += v;
  return sum / static_cast<double>(values.size());
}

SlowErrors::SlowErrors(double begin, double end, double interval_s, double start)
    : knots(begin, end, interval_s), std(start) {}

double SlowErrors::Kept(size_t k) const { return std::exp((knots.t[k] - knots.t[k + 1]) / kTime); }

double SlowErrors::Density(double omega2) const {
  const double interval = knots.t[1] - knots.t[0], kept = Kept(0);
  const double angle = std::sqrt(omega2) * interval;
  if (angle > M_PI) return 0.0;  // what is made up between knots
  const double passed = angle > 0.0 ? std::pow(std::sin(0.5 * angle) / (0.5 * angle), 4) : 1.0;
  return interval * passed * (1.0 - kept * kept) /
         (1.0 - 2.0 * kept * std::cos(angle) + kept * kept);
}

void SessionEstimate::BeginSlowErrors(double begin, double end) {
  position_errors = SlowErrors(begin, end, kPositionErrors, kPositionStart);
  rotation_errors = SlowErrors(begin, end, kRotationErrors, kRotationStart);
}

size_t SessionEstimate::FirstImu() const {
  const auto is_present = [](const ImuSessionEstimate& imu) { return imu.is_present; };
  return static_cast<size_t>(std::find_if(imus.begin(), imus.end(), is_present) - imus.begin());
}

Estimate::Estimate(const PreparedSession& session, double bias_knot_interval_s)
    : imus(session.starts.size()), sessions(1) {
  sessions[0].imus.resize(imus.size());
  sessions[0].g_W = session.starts[session.data.FirstImu()].g_W;
  sessions[0].BeginSlowErrors(session.data.poses.front().t, session.data.poses.back().t);
  for (size_t i = 0; i < imus.size(); ++i) {
    const ConditionedImu& samples = session.data.imus[i];
    if (!samples.IsPresent()) continue;
    const Start& start = session.starts[i];
    imus[i].q_MI = start.q_MI;
    imus[i].p_MI = start.p_MI;
    imus[i].accel_delay = start.accel_delay;
    ImuSessionEstimate& imu = sessions[0].imus[i];
    imu.is_present = true;
    static_cast<Clock&>(imu) = start;
    imu.gyro_bias = BiasKnots(samples.gyro, bias_knot_interval_s, start.gyro_bias);
    imu.accel_bias = BiasKnots(samples.accel, bias_knot_interval_s, start.accel_bias);
  }
}

bool IsOfPoses(ParameterKind kind) {
  return kind >= ParameterKind::kPoseSmoothing && kind <= ParameterKind::kPoseScale;
}

bool IsOfSession(ParameterKind kind) {
  return kind == ParameterKind::kTimeShift || kind == ParameterKind::kClockDrift;
}

std::vector<Parameter> CalibrationParameters(Estimate* estimate) {
  std::vector<Parameter> parameters;
  const auto add_clocks = [&](ParameterKind kind, size_t i, double ImuSessionEstimate::*clock) {
    for (size_t s = 0; s < estimate->sessions.size(); ++s) {
      ImuSessionEstimate& own = estimate->sessions[s].imus[i];
      if (own.is_present) parameters.push_back({kind, i, s, 1, &(own.*clock)});
    }
  };
  for (size_t i = 0; i < estimate->imus.size(); ++i) {
    ImuEstimate& imu = estimate->imus[i];
    parameters.push_back({ParameterKind::kTranslation, i, 0, 3, imu.p_MI.data()});
    parameters.push_back({ParameterKind::kRotation, i, 0, 3, imu.q_MI.coeffs().data()});
    add_clocks(ParameterKind::kTimeShift, i, &ImuSessionEstimate::time_shift);
    parameters.push_back({ParameterKind::kAccelDelay, i, 0, 1, &imu.accel_delay});
    add_clocks(ParameterKind::kClockDrift, i, &ImuSessionEstimate::clock_drift);
  }
  parameters.push_back({ParameterKind::kPoseSmoothing, 0, 0, 1, &estimate->pose_smoothing});
  parameters.push_back({ParameterKind::kPositionSmoothing, 0, 0, 1, &estimate->position_smoothing});
  parameters.push_back({ParameterKind::kPoseCumulants, 0, 0, 2, estimate->pose_cumulants.data()});
  parameters.push_back(
      {ParameterKind::kPositionCumulants, 0, 0, 2, estimate->position_cumulants.data()});
  parameters.push_back({ParameterKind::kPositionDelay, 0, 0, 1, &estimate->position_delay});
  parameters.push_back({ParameterKind::kPoseScale, 0, 0, 1, &estimate->pose_scale});
  for (size_t i = 0; i < estimate->imus.size(); ++i) {
    ImuEstimate& imu = estimate->imus[i];
    parameters.push_back({ParameterKind::kGyroSmoothing, i, 0, 1, &estimate->GyroSmoothing(i)});
    parameters.push_back({ParameterKind::kAccelSmoothing, i, 0, 1, &estimate->AccelSmoothing(i)});
    parameters.push_back({ParameterKind::kMountCompliance, i, 0, 1, &imu.mount_compliance});
    parameters.push_back({ParameterKind::kGyroIntrinsics, i, 0, 6, imu.gyro_intrinsics.data()});
    parameters.push_back({ParameterKind::kAccelIntrinsics, i, 0, 9, imu.accel_intrinsics.data()});
    parameters.push_back({ParameterKind::kAccelPositions, i, 0, 6, imu.accel_positions.data()});
  }
  return parameters;
}

bool IsEstimated(const CalibrationOptions& options, ParameterKind kind) {
  using Options = CalibrationOptions;
  static const std::map<ParameterKind, bool Options::*> kSwitches = {
      {ParameterKind::kTranslation, &Options::estimate_translation},
      {ParameterKind::kRotation, &Options::estimate_rotation},
      {ParameterKind::kTimeShift, &Options::estimate_time_shift},
      {ParameterKind::kAccelDelay, &Options::estimate_accel_delay},
      {ParameterKind::kClockDrift, &Options::estimate_clock_drift},
      {ParameterKind::kPoseSmoothing, &Options::estimate_pose_smoothing},
      {ParameterKind::kPositionSmoothing, &Options::estimate_pose_smoothing},
      {ParameterKind::kPoseCumulants, &Options::estimate_pose_smoothing},
      {ParameterKind::kPositionCumulants, &Options::estimate_pose_smoothing},
      {ParameterKind::kPositionDelay, &Options::estimate_pose_smoothing},
      {ParameterKind::kPoseScale, &Options::estimate_pose_scale},
      {ParameterKind::kGyroSmoothing, &Options::estimate_accel_smoothing},
      {ParameterKind::kAccelSmoothing, &Options::estimate_accel_smoothing},
      {ParameterKind::kMountCompliance, &Options::estimate_mount_compliance},
      {ParameterKind::kAccelPositions, &Options::estimate_size_effect},
      {ParameterKind::kGravity, &Options::estimate_gravity}};
  if (kind == ParameterKind::kGyroIntrinsics || kind == ParameterKind::kAccelIntrinsics)
    return options.imu_model == ImuModel::kScaleMisalignment;
  const auto found = kSwitches.find(kind);
  return found == kSwitches.end() || options.*found->second;
}

}  // namespace imu_pose_calib
