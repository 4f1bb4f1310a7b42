#pragma once

#include <visualization_msgs/MarkerArray.h>

#include <deque>
#include <string>

#include "imu_pose_calib/CalibrationStatus.h"
#include "imu_pose_calib/core/base/result.h"

namespace imu_pose_calib {

/// What there is to draw of a live calibration.
struct Scene {
  std::string world_frame;
  const CalibrationStatus& status;
  const Calibration* result;           ///< null: none yet
  const PoseSample* pose;              ///< newest; null: none yet
  const std::deque<PoseSample>& path;  ///< the last poses, thinned out
};

/// Frames, paths, gravity, the lever arm with the ellipsoid of its sigma, excitation bars and
/// verdict, all in the world frame. Each array replaces the one before.
visualization_msgs::MarkerArray Draw(const Scene& scene);

}  // namespace imu_pose_calib
