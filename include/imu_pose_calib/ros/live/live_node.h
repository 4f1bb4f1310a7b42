#pragma once

#include <ros/node_handle.h>

namespace imu_pose_calib {

/// Calibrates from topics as they arrive until the node is shut down. Parameters, topics and
/// services are private to `node`; README.md lists them.
///
/// Throws InputError for parameters that cannot be used as given.
void RunLive(const ros::NodeHandle& node);

}  // namespace imu_pose_calib
