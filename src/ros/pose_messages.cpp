#include "imu_pose_calib/ros/pose_messages.h"

#include <geometry_msgs/PoseStamped.h>
#include <geometry_msgs/PoseWithCovarianceStamped.h>
#include <geometry_msgs/TransformStamped.h>
#include <nav_msgs/Odometry.h>

#include "imu_pose_calib/ros/conversions.h"

namespace imu_pose_calib {
namespace {

FramedPose Read(const geometry_msgs::PoseStamped& msg) {
  return {ToPoseSample(msg.header.stamp, msg.pose), msg.header.frame_id, ""};
}

FramedPose Read(const geometry_msgs::PoseWithCovarianceStamped& msg) {
  return {ToPoseSample(msg.header.stamp, msg.pose.pose), msg.header.frame_id, ""};
}

FramedPose Read(const nav_msgs::Odometry& msg) {
  return {ToPoseSample(msg.header.stamp, msg.pose.pose), msg.header.frame_id, msg.child_frame_id};
}

FramedPose Read(const geometry_msgs::TransformStamped& msg) {
  return {ToPoseSample(msg.header.stamp, msg.transform), msg.header.frame_id, msg.child_frame_id};
}

template <typename Msg>
FramedPose ReadAs(const topic_tools::ShapeShifter& msg) {
  return Read(*msg.instantiate<Msg>());
}

struct PoseType {
  const char* name;
  FramedPose (*read)(const topic_tools::ShapeShifter&);
};
constexpr PoseType kPoseTypes[] = {
    {"geometry_msgs/PoseStamped", ReadAs<geometry_msgs::PoseStamped>},
    {"geometry_msgs/PoseWithCovarianceStamped", ReadAs<geometry_msgs::PoseWithCovarianceStamped>},
    {"geometry_msgs/TransformStamped", ReadAs<geometry_msgs::TransformStamped>},
    {"nav_msgs/Odometry", ReadAs<nav_msgs::Odometry>},
};

}  // namespace

std::vector<std::string> PoseTypes() {
  std::vector<std::string> names;
  for (const PoseType& type : kPoseTypes) names.push_back(type.name);
  return names;
}

FramedPose ToFramedPose(const topic_tools::ShapeShifter& msg) {
  for (const PoseType& type : kPoseTypes)
    if (msg.getDataType() == type.name) return type.read(msg);
  throw InputError(msg.getDataType() + " holds no pose");
}

}  // namespace imu_pose_calib
