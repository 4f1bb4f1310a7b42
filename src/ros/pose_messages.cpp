#include "imu_pose_calib/ros/pose_messages.h"

namespace imu_pose_calib {
namespace {

template <typename Msg>
FramedPose ReadAs(const topic_tools::ShapeShifter& msg) {
  return ToFramedPose(*msg.instantiate<Msg>());
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
