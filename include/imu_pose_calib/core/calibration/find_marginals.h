#pragma once

#include "imu_pose_calib/core/calibration/least_squares.h"
#include "imu_pose_calib/core/calibration/marginals.h"

namespace imu_pose_calib {

/// Stage S5 where a solve has ended, doc/math.md, "Covariance" and "What one more step tells".
Marginals FindMarginals(LeastSquares* solved);

}  // namespace imu_pose_calib
