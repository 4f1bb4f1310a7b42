#pragma once

#include <string>
#include <vector>

#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {

/// Reads what a request has in bags: of ROS 1, or of ROS 2 (folder, .mcap, .db3): IMU samples
/// (sensor_msgs/Imu on one topic; gyroscope and accelerometer on two as sensor_msgs/Imu or
/// geometry_msgs/Vector3Stamped) and poses (geometry_msgs/PoseStamped, TransformStamped or
/// PoseWithCovarianceStamped, nav_msgs/Odometry, or tf; of ROS 2 also messages that hold poses of
/// several bodies by name).
///
/// Time is the header stamp, at full precision. World frame: header.frame_id of the poses; marker
/// frame: child_frame_id, else "marker"; imu frame: header.frame_id of the IMU, else "imu". Of a
/// pose sensor the same as of the marker, else "camera_pose" and "camera_pose_world" for
/// /camera/pose.
///
/// With a pose sensor there need not be an IMU.
///
/// Throws InputError when a bag cannot be read or when the bags do not hold exactly one choice of
/// topics: the text, printable, names what they have and which field to give.
Recording ReadBag(const RecordingRequest& request);

/// Bags by the recording that they are of, in the order in which they are given. Those that
/// continue each other, or hold other topics of the same time, are one recording. Reads and throws
/// as ReadBag() does.
std::vector<std::vector<std::string>> GroupBags(const std::vector<std::string>& paths);

}  // namespace imu_pose_calib
