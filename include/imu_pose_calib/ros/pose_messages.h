#pragma once

#include <topic_tools/shape_shifter.h>

#include <string>
#include <vector>

#include "imu_pose_calib/ros/conversions.h"

namespace imu_pose_calib {

/// Names of the message types that hold one pose.
std::vector<std::string> PoseTypes();

/// The pose of a message of one of these types. Throws ros::Exception when its definition differs.
FramedPose ToFramedPose(const topic_tools::ShapeShifter& msg);

}  // namespace imu_pose_calib
