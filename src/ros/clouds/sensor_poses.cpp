#include "imu_pose_calib/ros/clouds/sensor_poses.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <memory>

#include "imu_pose_calib/core/trajectory.h"

namespace imu_pose_calib {
namespace {

/// The poses as they were recorded, linear between them but for gaps.
class RecordedPoses {
 public:
  RecordedPoses(const CalibrationOptions& options,
                double rate_hz,
                const std::vector<PoseSample>& recorded)
      : max_gap_ns_(std::llround(
            1e9 * (options.max_gap_s > 0.0 ? options.max_gap_s : std::max(0.1, 5.0 / rate_hz)))) {
    for (const PoseSample& sample : recorded) {
      const PoseSample pose = ToMarkerPose(options, sample);
      const bool is_usable = pose.p_WM.allFinite() && pose.q_WM.coeffs().allFinite() &&
                             pose.q_WM.norm() > 0.0 && pose.t_ns > 0;
      if (!is_usable) continue;
      poses_.push_back(pose);
      poses_.back().q_WM.normalize();
    }
    std::stable_sort(poses_.begin(), poses_.end(), [](const PoseSample& a, const PoseSample& b) {
      return a.t_ns < b.t_ns;
    });
  }

  std::optional<Rigid3> At(int64_t t_ns) const {
    const auto after =
        std::upper_bound(poses_.begin(), poses_.end(), t_ns, [](int64_t t, const PoseSample& pose) {
          return t < pose.t_ns;
        });
    if (after == poses_.begin() || after == poses_.end()) return std::nullopt;
    const PoseSample& before = *std::prev(after);
    const int64_t period = after->t_ns - before.t_ns;
    if (period > max_gap_ns_) return std::nullopt;
    const double u = static_cast<double>(t_ns - before.t_ns) / static_cast<double>(period);
    return Rigid3{before.q_WM.slerp(u, after->q_WM), (1.0 - u) * before.p_WM + u * after->p_WM};
  }

 private:
  int64_t max_gap_ns_;
  std::vector<PoseSample> poses_;
};

/// What one takes for the time shift [ns] without a calibration: 0 where the stamps could be of one
/// clock, else what lets samples of both arrive together.
int64_t ShiftByArrival(const RecordingInfo& info, const SessionData& data) {
  const auto [pose_begin, pose_end] = SpanOf(data.poses);
  const auto [imu_begin, imu_end] = SpanOf(data.imus[0].gyro);
  const int64_t common = std::min(pose_end, imu_end) - std::max(pose_begin, imu_begin);
  const bool is_one_clock = common > std::min(pose_end - pose_begin, imu_end - imu_begin) / 2;
  if (is_one_clock || !info.imus[0].gyro_latency || !info.pose_latency) return 0;
  return std::llround(1e9 * (info.imus[0].gyro_latency->median_s - info.pose_latency->median_s));
}

}  // namespace

Eigen::Quaterniond ToRightAngles(const Eigen::Quaterniond& q) {
  // The most alike, by the sum of cosines between axes, of all 24.
  const Eigen::Matrix3d R = q.toRotationMatrix();
  Eigen::Matrix3d best = Eigen::Matrix3d::Identity();
  const int orders[6][3] = {{0, 1, 2}, {1, 2, 0}, {2, 0, 1}, {0, 2, 1}, {2, 1, 0}, {1, 0, 2}};
  double most = -std::numeric_limits<double>::infinity();
  for (const auto& order : orders)
    for (unsigned signs = 0; signs < 8; ++signs) {
      Eigen::Matrix3d candidate = Eigen::Matrix3d::Zero();
      for (int i = 0; i < 3; ++i)
        candidate(order[i], i) = (signs >> static_cast<unsigned>(i) & 1u) != 0u ? -1.0 : 1.0;
      const double likeness = (R.transpose() * candidate).trace();
      if (candidate.determinant() < 0.0 || likeness <= most) continue;
      most = likeness;
      best = candidate;
    }
  return Eigen::Quaterniond(best);
}

std::vector<SensorPoses> PosesWithAndWithout(const SensorMount& sensor,
                                             bool is_on_imu_clock,
                                             const OfflineResult& offline) {
  const Rigid3 T_MI = offline.result.imus[0].T_MI;
  const Rigid3 T_MS = sensor.is_on_imu ? T_MI * sensor.T : sensor.T;

  const Rigid3 guess =
      sensor.guessed_T_MI.value_or(Rigid3{ToRightAngles(T_MI.q), Eigen::Vector3d::Zero()});
  const Rigid3 guessed_T_MS = sensor.is_on_imu ? guess * sensor.T : sensor.T;

  // Times are of the pose clock, after its epoch [s].
  using PoseAt = std::function<std::optional<Rigid3>(double t)>;
  using TimeOf = std::function<double(int64_t stamp_ns)>;
  const std::shared_ptr<const Solution> solution = offline.result.solution;
  const auto track = std::make_shared<const SessionTrajectory>(solution, 0);
  const PoseAt trajectory = [=](double t) -> std::optional<Rigid3> {
    const auto body = track->Marker(t);
    if (!body) return std::nullopt;
    return Rigid3{body->q_WB, body->p_WB};
  };
  const int64_t epoch_ns = track->epoch_ns();
  const SessionData& data = offline.sessions[0];
  const auto poses = std::make_shared<const RecordedPoses>(
      offline.options, offline.result.sessions[0].poses.rate_hz, data.poses);
  const PoseAt recorded = [=](double t) { return poses->At(epoch_ns + std::llround(1e9 * t)); };

  const ImuSessionEstimate clock = solution->estimate.sessions[0].imus[0];
  const int64_t imu_epoch_ns = solution->imus[0][0].epoch_ns;
  const auto after = [](int64_t stamp_ns, int64_t begin_ns) {
    return 1e-9 * static_cast<double>(stamp_ns - begin_ns);
  };
  const TimeOf calibrated_time = [=](int64_t stamp_ns) {
    return is_on_imu_clock ? clock.PoseTime(after(stamp_ns, imu_epoch_ns))
                           : after(stamp_ns, epoch_ns);
  };
  const int64_t shift_ns = is_on_imu_clock ? ShiftByArrival(offline.infos[0], data) : 0;
  const TimeOf plain_time = [=](int64_t stamp_ns) { return after(stamp_ns + shift_ns, epoch_ns); };

  const auto make = [](const PoseAt& pose, const Rigid3& T_MS_used, const TimeOf& time) {
    return [=](int64_t stamp_ns) -> std::optional<Rigid3> {
      const auto T_WM = pose(time(stamp_ns));
      if (!T_WM) return std::nullopt;
      return *T_WM * T_MS_used;
    };
  };
  std::vector<SensorPoses> all;
  all.push_back({"without calibration", make(recorded, guessed_T_MS, plain_time)});
  if (sensor.is_on_imu)
    all.push_back({"all but T_marker_imu", make(trajectory, guessed_T_MS, calibrated_time)});
  if (is_on_imu_clock)
    all.push_back({"all but the time shift", make(trajectory, T_MS, plain_time)});
  all.push_back({"all but the trajectory", make(recorded, T_MS, calibrated_time)});
  all.push_back({"calibrated", make(trajectory, T_MS, calibrated_time)});
  return all;
}

}  // namespace imu_pose_calib
