#pragma once

#include <string>

#include "imu_pose_calib/core/types.h"

namespace imu_pose_calib {

/// Record time minus header stamp of one stream [s]; the clocks may differ.
struct Latency {
  double median_s = 0.0;
  double spread_s = 0.0;  ///< robust sigma
};

/// Where a recording comes from and how its frames are called.
struct RecordingInfo {
  std::string bag;  ///< path
  /// Either `imu_topic`, or `gyro_topic` and `accel_topic` for a split IMU; the others are empty.
  std::string imu_topic, gyro_topic, accel_topic;
  std::string pose_topic;
  /// Frame names without leading slash: fixed frame of the poses, marker, imu.
  std::string world_frame, marker_frame, imu_frame;
  Latency pose_latency, gyro_latency, accel_latency;
};

/// The samples of one bag in the order in which they were recorded.
struct Recording {
  RecordingInfo info;
  CalibrationData data;
};

}  // namespace imu_pose_calib
