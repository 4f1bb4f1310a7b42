#pragma once

#include <vector>

#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/ground_truth/trajectory.h"

namespace imu_pose_calib {

/// How the sigmas of one IMU shrink while more of a session is used.
struct InformationGrowth {
  std::vector<double> share;  ///< (0..1] of the session, increasing, the last is 1
  /// Sigmas at each share: translation [m], rotation [rad], time_shift [s], accel_delay [s]; at 1
  /// those of the result, so 0 throughout for what is not estimated.
  std::vector<Eigen::Matrix<double, 8, 1>> std;
};

/// By the motion from `begin` to `end` [s, pose clock]: what the samples of gyroscope and
/// accelerometer tell of the calibration beside gravity and constant biases on a trajectory that is
/// known, brought to the sigmas of the result. What the trajectory's own errors cost is taken to be
/// the same share throughout.
InformationGrowth GrowInformation(const Calibration& result, size_t session, size_t imu,
                                  const SessionTrajectory& trajectory, double begin, double end);

}  // namespace imu_pose_calib
