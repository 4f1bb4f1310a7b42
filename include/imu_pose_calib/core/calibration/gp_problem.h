#pragma once

#include <vector>

#include "imu_pose_calib/core/calibration/solution.h"

namespace imu_pose_calib {

/// Stage S3, the method of the paper: the calibration against the fixed trajectories of S1, solved
/// by Ceres. Rotation, gyro bias and time shift on the gyroscope; then everything on both sensors,
/// twice: each time with the noise that the residuals before show. Moves `estimate`. Throws
/// DataError when no sample falls on a trajectory, or a solve does not converge.
Solution SolveAgainstTrajectory(const CalibrationOptions& options,
                                const std::vector<PreparedSession>& sessions, Estimate* estimate);

}  // namespace imu_pose_calib
