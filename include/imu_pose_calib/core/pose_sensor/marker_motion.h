#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <vector>

#include "imu_pose_calib/core/ground_truth/trajectory.h"

namespace imu_pose_calib {

/// The marker in one session.
struct MarkerMotion {
  int64_t epoch_ns;                                      ///< [ns, pose clock] at which t = 0
  std::shared_ptr<const PoseTrajectory> poses;           ///< of S1
  std::function<std::optional<BodyState>(double t)> at;  ///< nothing where it is not known
};

/// Those of all sessions.
std::vector<MarkerMotion> MarkerMotions(const std::shared_ptr<const Solution>& solution);

}  // namespace imu_pose_calib
