#include "imu_pose_calib/ros/io/body_poses.h"

namespace imu_pose_calib {
namespace {

constexpr char kRigidBodies[] = "mocap4r2_msgs/RigidBodies";
constexpr char kNamedPoses[] = "motion_capture_tracking_interfaces/NamedPoseArray";

/// Reads over the markers of a body.
void SkipMarkers(CdrInput* input) {
  const uint32_t markers = input->Count();
  for (uint32_t k = 0; k < markers; ++k) {
    input->Number<int8_t>();   // kind of the number
    input->Number<int32_t>();  // number
    input->String();
    geometry_msgs::Point position;
    input->next(position);
  }
}

std::vector<FramedPose> ReadBodies(std::string_view message, bool has_markers) {
  CdrInput input(message);
  std_msgs::Header header;
  input.next(header);
  if (has_markers) input.Number<uint32_t>();  // frame
  const uint32_t count = input.Count();
  std::vector<FramedPose> bodies;
  for (uint32_t k = 0; k < count; ++k) {
    const std::string name = input.String();
    if (has_markers) SkipMarkers(&input);
    geometry_msgs::Pose pose;
    input.next(pose);
    bodies.push_back({ToPoseSample(header.stamp, pose), header.frame_id, name});
  }
  input.Finish();
  return bodies;
}

}  // namespace

bool HoldsBodies(const std::string& type) { return type == kRigidBodies || type == kNamedPoses; }

std::vector<FramedPose> ReadBodies(const BagMessage& message) {
  std::vector<FramedPose> bodies;
  message.Decode(
      [&](std::string_view data) { bodies = ReadBodies(data, message.type() == kRigidBodies); });
  return bodies;
}

}  // namespace imu_pose_calib
