#pragma once

#include <ros/time.h>
#include <visualization_msgs/MarkerArray.h>

#include <deque>
#include <string>

#include "imu_pose_calib/core/result.h"
#include "imu_pose_calib/ros/live/live_calibration.h"

namespace imu_pose_calib {

/// What there is to draw of a live calibration.
struct Scene {
  std::string world_frame;
  LiveStatus status;
  const Calibration* result;           ///< null: none yet
  const PoseSample* pose;              ///< newest; null: none yet
  const std::deque<PoseSample>& path;  ///< the last poses, thinned out
};

/// Frames, paths, gravity, the lever arm with the ellipsoid of its sigma, excitation bars and
/// verdict, all in the world frame. Each array replaces the one before.
visualization_msgs::MarkerArray Draw(const Scene& scene, const ros::Time& stamp);

}  // namespace imu_pose_calib
