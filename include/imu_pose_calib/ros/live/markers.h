#pragma once

#include <visualization_msgs/MarkerArray.h>

#include <string>

#include "imu_pose_calib/ros/live/live_calibration.h"

namespace imu_pose_calib {

/// Frames, paths, gravity, the lever arm with the ellipsoid of its sigma, excitation bars and
/// verdict as `status` has them, all in the world frame. Each array replaces the one before.
visualization_msgs::MarkerArray Draw(const LiveCalibration& live, const CalibrationStatus& status,
                                     const std::string& world_frame);

}  // namespace imu_pose_calib
