#pragma once

#include <string>
#include <vector>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/message_source.h"

namespace imu_pose_calib {

/// Messages of ROS 2 that hold the poses of several bodies, by name: mocap4r2_msgs/RigidBodies,
/// motion_capture_tracking_interfaces/NamedPoseArray.
bool HoldsBodies(const std::string& type);

/// The poses in such a message, each with the name of the body as its marker frame.
std::vector<FramedPose> ReadBodies(const BagMessage& message);

}  // namespace imu_pose_calib
