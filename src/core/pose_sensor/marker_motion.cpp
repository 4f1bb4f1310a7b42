#include "imu_pose_calib/core/pose_sensor/marker_motion.h"

namespace imu_pose_calib {

std::vector<MarkerMotion> MarkerMotions(const std::shared_ptr<const Solution>& solution) {
  std::vector<MarkerMotion> motions;
  for (size_t s = 0; s < solution->trajectories.size(); ++s) {
    const auto trajectory = std::make_shared<const SessionTrajectory>(solution, s);
    motions.push_back({solution->pose_epochs_ns[s], solution->trajectories[s],
                       [trajectory](double t) { return trajectory->Marker(t); }});
  }
  return motions;
}

}  // namespace imu_pose_calib
