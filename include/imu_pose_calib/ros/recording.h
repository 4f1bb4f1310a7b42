#pragma once

#include <optional>
#include <string>

#include "imu_pose_calib/core/types.h"

namespace imu_pose_calib {

/// Sigma of a pose, per axis.
struct PoseStd {
  double position = 0.0;  ///< [m]
  double rotation = 0.0;  ///< [rad]
};

/// Where a recording comes from and how its frames are called.
struct RecordingInfo {
  std::string bag;  ///< path
  /// Either `imu_topic`, or `gyro_topic` and `accel_topic` for a split IMU; the others are empty.
  std::string imu_topic, gyro_topic, accel_topic;
  std::string pose_topic;
  /// Frame names without leading slash: fixed frame of the poses, marker, imu.
  std::string world_frame, marker_frame, imu_frame;
  /// What the covariances of the poses say, median; not used, reported only.
  std::optional<PoseStd> stated_pose_std;
};

/// The samples of one bag in the order in which they were recorded.
struct Recording {
  RecordingInfo info;
  CalibrationData data;
};

}  // namespace imu_pose_calib
