#pragma once

#include <ros/node_handle.h>

#include "imu_pose_calib/ros/offline/offline.h"

namespace imu_pose_calib {

/// Calibrates from topics as they arrive until the node is shut down. Topics and services are
/// private to `node`; doc/live.md lists them and the parameters. Of `request`, what names topics,
/// frames, options and the result counts.
///
/// Throws InputError for parameters that cannot be used as given.
void RunLive(const ros::NodeHandle& node, const OfflineRequest& request);

}  // namespace imu_pose_calib
