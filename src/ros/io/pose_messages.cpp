#include "imu_pose_calib/ros/io/pose_messages.h"

namespace imu_pose_calib {

std::vector<std::string> PoseTypeNames() {
  std::vector<std::string> names;
  for (const auto& type : PoseTypes<topic_tools::ShapeShifter>()) names.emplace_back(type.name);
  return names;
}

FramedPose ToFramedPose(const topic_tools::ShapeShifter& msg) {
  const auto* type = FindPoseType<topic_tools::ShapeShifter>(msg.getDataType());
  if (type == nullptr) throw InputError(msg.getDataType() + " holds no pose");
  return type->read(msg);
}

}  // namespace imu_pose_calib
