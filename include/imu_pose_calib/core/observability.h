#pragma once

#include <string>

#include "imu_pose_calib/core/conditioning.h"
#include "imu_pose_calib/core/marginals.h"
#include "imu_pose_calib/core/options.h"
#include "imu_pose_calib/core/pose_trajectory.h"
#include "imu_pose_calib/core/result.h"

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

/// Without turns about two axes no solve can tell the lever arm or the rotation.
class DegenerateMotion : public DataError {
 public:
  DegenerateMotion(const std::string& message, const std::string& unobservable)
      : DataError(message), unobservable(unobservable) {}
  std::string unobservable;  ///< the direction in words
};

/// Throws DegenerateMotion unless the motion suffices.
void CheckTurns(const TurnExcitation& turns);

/// Stage S5: fills covariances, sigmas, observability, split halves, status and message.
void GradeResult(const CalibrationOptions& options,
                 const Marginals& marginals,
                 Calibration* result);

/// Adds a warning in words for each sign that the model does not fit the data: correlated
/// residuals, drifting clocks, wrong scales, a long accel_delay.
void WarnOfMisfit(const Marginals& marginals, Calibration* result);

/// "123.4 mm", "0.1234 deg" or "0.1234 ms" of a value in m, rad or s.
std::string InWords(double value, const std::string& unit);
/// By a format of printf for one double, such as "%.1f".
std::string Number(double value, const char* format);

}  // namespace imu_pose_calib
