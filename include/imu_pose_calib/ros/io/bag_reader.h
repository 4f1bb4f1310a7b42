#pragma once

#include <string>
#include <vector>

#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {

/// What to read from bags. Topics left empty are found by their type.
struct BagRequest {
  /// Bags of one recording, each with all topics or only some; at least one.
  std::vector<std::string> paths;
  std::string imu_topic;  ///< several IMUs: white space between them, as below
  std::string pose_topic;
  std::string body;  ///< of a pose topic, or file of poses, that holds several
  /// Split IMU, both or none; not together with `imu_topic`.
  std::string gyro_topic, accel_topic;
  /// Poses of `tf_child` in `tf_parent` from tf, both or none; not together with `pose_topic`.
  std::string tf_parent, tf_child;
  double start_s = 0.0;      ///< [s] after the first record time of the bags
  double duration_s = 0.0;   ///< [s] 0: to the end
  bool record_time = false;  ///< Stamp with the record times instead of the header stamps.
  /// What to read; the other part is in text files. Its fields above are to be empty then.
  bool poses = true, imus = true;
  /// TOPIC, TOPIC:BODY where messages hold several, or tf:PARENT:CHILD. A nameless one is
  /// elsewhere.
  std::vector<std::string> pose_sensors;
  /// An IMU or pose sensor that is named may be missing: another session of the rig has it.
  bool may_lack_sensors = false;
  /// Taken when no IMU topic is given and the bags have it.
  std::string usual_imu_topic;
};

/// Reads bags of ROS 1, or of ROS 2 (folder, .mcap, .db3): IMU samples (sensor_msgs/Imu on one
/// topic; gyroscope and accelerometer on two as sensor_msgs/Imu or geometry_msgs/Vector3Stamped)
/// and poses (geometry_msgs/PoseStamped, TransformStamped or PoseWithCovarianceStamped,
/// nav_msgs/Odometry, or tf; of ROS 2 also messages that hold poses of several bodies by name).
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
Recording ReadBag(const BagRequest& request);

/// Bags by the recording that they are of, in the order in which they are given. Those that
/// continue each other, or hold other topics of the same time, are one recording. Reads and throws
/// as ReadBag() does.
std::vector<std::vector<std::string>> GroupBags(const std::vector<std::string>& paths);

}  // namespace imu_pose_calib
