#pragma once

#include <algorithm>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "imu_pose_calib/ros/clouds/cloud_map.h"
#include "imu_pose_calib/ros/offline/offline.h"

namespace imu_pose_calib {

/// First and last stamp.
template <typename Sample>
std::pair<int64_t, int64_t> SpanOf(const std::vector<Sample>& samples) {
  const auto [first, last] =
      std::minmax_element(samples.begin(), samples.end(), [](const Sample& a, const Sample& b) {
        return a.t_ns < b.t_ns;
      });
  return {first->t_ns, last->t_ns};
}

/// Where a sensor S sits on the body.
struct SensorMount {
  bool is_on_imu = true;
  Rigid3 T;  ///< T_IS, or T_MS
  /// T_MI of who has no calibration; default: the nearest right angles, and no lever arm.
  std::optional<Rigid3> guessed_T_MI;
};

/// The poses of a sensor, and what they are made with.
struct SensorPoses {
  std::string name;
  SensorPoseAt pose;
};

/// What the first IMU and the poses of the first session tell of the sensor: first without a
/// calibration, then without one part of it at a time, and last with all of it. Clouds are stamped
/// by the clock of the IMU or of the poses. The data must still be in `offline`.
std::vector<SensorPoses> PosesWithAndWithout(const SensorMount& sensor,
                                             bool is_on_imu_clock,
                                             const OfflineResult& offline);

/// The rotation nearest to `q` that turns axes into axes: what anybody sees who looks at a sensor.
Eigen::Quaterniond ToRightAngles(const Eigen::Quaterniond& q);

}  // namespace imu_pose_calib
