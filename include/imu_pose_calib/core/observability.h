#pragma once

#include <string>

#include "imu_pose_calib/core/calibration_problem.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/conditioning.h"
#include "imu_pose_calib/core/options.h"
#include "imu_pose_calib/core/pose_trajectory.h"

namespace imu_pose_calib {

/// How the marker turns: principal axes of its mean-free rate, the trajectory's own variance
/// subtracted.
struct TurnExcitation {
  Eigen::Vector3d rate_std;  ///< [rad/s] about each axis, largest first; 0 when within the noise
  Eigen::Matrix3d axes_M;    ///< columns: the axes in M
};
TurnExcitation MeasureTurns(const PoseTrajectory& trajectory, const ConditionedData& data);

/// "marker z", or "(0.71, 0.00, 0.71) in the marker frame" when no axis is within 20 degrees.
std::string DescribeAxis(const Eigen::Vector3d& axis, const std::string& frame = "marker");

/// Without turns about two axes no solve can tell the lever arm or the rotation: sets status
/// kDegenerate, message and the directions in words. False when the motion suffices.
bool IsMotionDegenerate(const TurnExcitation& turns, Calibration* result);

/// Stage S5: fills covariance, sigmas, observability, split halves, status and message.
void GradeResult(const CalibrationOptions& options,
                 const CalibrationCovariance& covariance,
                 Calibration* result);

/// Adds a warning in words for each sign that the model does not fit the data: correlated
/// residuals, halves that disagree, drifting clocks, wrong scales, a long accel_delay.
void WarnOfMisfit(const CalibrationCovariance& covariance, Calibration* result);

}  // namespace imu_pose_calib
