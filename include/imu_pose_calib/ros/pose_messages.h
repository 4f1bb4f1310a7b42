#pragma once

#include <topic_tools/shape_shifter.h>

#include <string>
#include <vector>

#include "imu_pose_calib/core/types.h"

namespace imu_pose_calib {

/// A pose as it comes out of any of the pose messages.
struct FramedPose {
  PoseSample pose;
  std::string world_frame, marker_frame;  ///< as in the message; empty: it has none
};

/// Names of the message types that hold one pose.
std::vector<std::string> PoseTypes();

/// The pose of a message of one of these types. Throws ros::Exception when its definition differs.
FramedPose ToFramedPose(const topic_tools::ShapeShifter& msg);

}  // namespace imu_pose_calib
