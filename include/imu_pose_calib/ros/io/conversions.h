#pragma once

#include <geometry_msgs/Pose.h>
#include <geometry_msgs/PoseStamped.h>
#include <geometry_msgs/PoseWithCovariance.h>
#include <geometry_msgs/PoseWithCovarianceStamped.h>
#include <geometry_msgs/Transform.h>
#include <geometry_msgs/TransformStamped.h>
#include <geometry_msgs/Vector3Stamped.h>
#include <nav_msgs/Odometry.h>
#include <ros/time.h>
#include <sensor_msgs/Imu.h>

#include <algorithm>
#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/CalibrationResult.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {

/// Nanoseconds since the epoch of the stamp's clock, exact.
int64_t ToNanoseconds(const ros::Time& stamp);
/// Throws InputError when `t_ns` is outside of what a ROS stamp can hold (0 to year 2106).
ros::Time FromNanoseconds(int64_t t_ns);

geometry_msgs::Point ToPointMsg(const Eigen::Vector3d& p);
geometry_msgs::Vector3 ToVector3Msg(const Eigen::Vector3d& v);
geometry_msgs::Transform ToTransformMsg(const Rigid3& T);
geometry_msgs::Pose ToPoseMsg(const Rigid3& T);
std_msgs::Header MakeHeader(const ros::Time& stamp, const std::string& frame);
geometry_msgs::TransformStamped ToTransformStamped(const std_msgs::Header& header,
                                                   const std::string& child, const Rigid3& T);

PoseSample ToPoseSample(const ros::Time& stamp, const geometry_msgs::Pose& pose);
PoseSample ToPoseSample(const ros::Time& stamp, const geometry_msgs::PoseWithCovariance& pose);
PoseSample ToPoseSample(const ros::Time& stamp, const geometry_msgs::Transform& transform);

/// Types of the messages of an IMU; a vector is one sensor of a split one.
constexpr char kImuType[] = "sensor_msgs/Imu";
constexpr char kVectorType[] = "geometry_msgs/Vector3Stamped";

/// What one pose message says.
struct FramedPose {
  PoseSample pose;
  std::string world_frame, marker_frame;  ///< as in the message; marker empty: not given
};

/// Root mean square of the sigmas along (position) and about (rotation) the three axes. 0 when the
/// diagonal holds a number that is not finite or not positive, which is how "unknown" is
/// written.
PoseStd ToPoseStd(const geometry_msgs::PoseWithCovariance& pose);

/// BodyFrames() as tf: parent marker, child imu or sensor.
std::vector<geometry_msgs::TransformStamped> ToTransforms(const Calibration& result,
                                                          const RecordingInfo& info,
                                                          const ros::Time& stamp);
/// Without an IMU, its fields are 0. There are none of pose sensors.
CalibrationResult ToMsg(const Calibration& result, const RecordingInfo& info,
                        const ros::Time& stamp);

/// Types of the messages that hold one pose.
inline const std::vector<std::string> kPoseTypes = {
    "geometry_msgs/PoseStamped", "geometry_msgs/TransformStamped",
    "geometry_msgs/PoseWithCovarianceStamped", "nav_msgs/Odometry"};
inline bool IsPoseType(const std::string& type) {
  return std::count(kPoseTypes.begin(), kPoseTypes.end(), type) > 0;
}

/// The pose of a message of one of these types, from a `Source` with instantiate<Msg>().
template <typename Source>
FramedPose ReadPose(const std::string& type, const Source& source) {
  const auto framed = [](const auto& msg, const auto& pose, const std::string& child) {
    return FramedPose{ToPoseSample(msg.header.stamp, pose), msg.header.frame_id, child};
  };
  if (type == "geometry_msgs/PoseStamped") {
    const auto msg = source.template instantiate<geometry_msgs::PoseStamped>();
    return framed(*msg, msg->pose, "");
  }
  if (type == "geometry_msgs/TransformStamped") {
    const auto msg = source.template instantiate<geometry_msgs::TransformStamped>();
    return framed(*msg, msg->transform, msg->child_frame_id);
  }
  if (type == "geometry_msgs/PoseWithCovarianceStamped") {
    const auto msg = source.template instantiate<geometry_msgs::PoseWithCovarianceStamped>();
    return framed(*msg, msg->pose, "");
  }
  const auto msg = source.template instantiate<nav_msgs::Odometry>();
  return framed(*msg, msg->pose, msg->child_frame_id);
}

/// What a message of an IMU gives; a vector may be of either sensor.
struct ImuContent {
  std::optional<ImuSample> gyro, accel;
  std::string frame;  ///< as in the message
};
ImuContent ToImuContent(const geometry_msgs::Vector3Stamped& msg);
ImuContent ToImuContent(const sensor_msgs::Imu& msg);

/// Reads a message of `type`, kImuType or kVectorType, from a `Source` with instantiate<Msg>().
template <typename Source>
ImuContent ReadImuContent(const std::string& type, const Source& source) {
  if (type == kVectorType)
    return ToImuContent(*source.template instantiate<geometry_msgs::Vector3Stamped>());
  return ToImuContent(*source.template instantiate<sensor_msgs::Imu>());
}

}  // namespace imu_pose_calib
