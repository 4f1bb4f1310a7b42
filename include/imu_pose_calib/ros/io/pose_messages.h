#pragma once

#include <topic_tools/shape_shifter.h>

#include <array>
#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/ros/io/conversions.h"

namespace imu_pose_calib {

/// A message type that holds one pose, and how to read it from a `Source` with instantiate<Msg>().
template <typename Source>
struct PoseType {
  const char* name;
  FramedPose (*read)(const Source&);
};

template <typename Msg, typename Source>
PoseType<Source> MakePoseType() {
  return {ros::message_traits::DataType<Msg>::value(),
          [](const Source& source) { return ToFramedPose(*source.template instantiate<Msg>()); }};
}

template <typename Source>
const std::array<PoseType<Source>, 4>& PoseTypes() {
  static const std::array<PoseType<Source>, 4> kTypes = {
      MakePoseType<geometry_msgs::PoseStamped, Source>(),
      MakePoseType<geometry_msgs::TransformStamped, Source>(),
      MakePoseType<geometry_msgs::PoseWithCovarianceStamped, Source>(),
      MakePoseType<nav_msgs::Odometry, Source>()};
  return kTypes;
}

/// The type of that name; null when it holds no pose.
template <typename Source>
const PoseType<Source>* FindPoseType(const std::string& name) {
  for (const PoseType<Source>& type : PoseTypes<Source>())
    if (name == type.name) return &type;
  return nullptr;
}

std::vector<std::string> PoseTypeNames();

/// What a message of an IMU gives; a vector may be of either sensor.
struct ImuContent {
  std::optional<ImuSample> gyro, accel;
  std::string frame;  ///< as in the message
};

/// Reads a message of `type`, kImuType or kVectorType, from a `Source` with instantiate<Msg>().
template <typename Source>
ImuContent ReadImuContent(const std::string& type, const Source& source) {
  ImuContent content;
  if (type == kVectorType) {
    const auto vector = source.template instantiate<geometry_msgs::Vector3Stamped>();
    content.gyro = content.accel = ToImuSample(*vector);
    content.frame = vector->header.frame_id;
  } else {
    const auto imu = source.template instantiate<sensor_msgs::Imu>();
    if (IsGiven(imu->angular_velocity_covariance)) content.gyro = ToGyroSample(*imu);
    if (IsGiven(imu->linear_acceleration_covariance)) content.accel = ToAccelSample(*imu);
    content.frame = imu->header.frame_id;
  }
  return content;
}

/// The pose of a message of one of these types. Throws ros::Exception when its definition differs.
FramedPose ToFramedPose(const topic_tools::ShapeShifter& msg);

}  // namespace imu_pose_calib
