#pragma once

#include <string>

#include "imu_pose_calib/ros/recording.h"

namespace imu_pose_calib {

/// What to read from a bag. Topics left empty are found by their type.
struct BagRequest {
  std::string path;
  std::string imu_topic;
  std::string pose_topic;
  /// Split IMU, both or none; not together with `imu_topic`.
  std::string gyro_topic, accel_topic;
  double start_s = 0.0;     ///< [s] after the first record time of the bag
  double duration_s = 0.0;  ///< [s] 0: to the end
};

/// Reads poses (geometry_msgs/PoseStamped, geometry_msgs/TransformStamped) and IMU samples
/// (sensor_msgs/Imu on one topic, or gyroscope and accelerometer on two).
///
/// Time is the header stamp, at full precision. World frame: header.frame_id of the poses; marker
/// frame: child_frame_id, else "marker"; imu frame: header.frame_id of the IMU, else "imu".
///
/// Throws InputError when the bag cannot be read or when it does not hold exactly one choice of
/// topics: the text names what the bag has and which field to give.
Recording ReadBag(const BagRequest& request);

}  // namespace imu_pose_calib
