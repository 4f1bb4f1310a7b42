#pragma once

#include <string>

#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/core/trajectory/pose_trajectory.h"

namespace imu_pose_calib {

/// "marker z", or "(0.71, 0.00, 0.71) in the marker frame" when no axis is within 20 degrees.
std::string DescribeAxis(const Eigen::Vector3d& direction, const std::string& frame);

/// What to do about motion that does not suffice.
constexpr const char* kTurnAdvice = "turn the marker about at least two axes";

/// How the marker turns: principal axes of its mean-free rate, the trajectory's own variance
/// subtracted.
struct TurnExcitation {
  Eigen::Vector3d rate_std;  ///< [rad/s] about each axis, largest first; 0 when within the noise
  Eigen::Matrix3d axes_M;    ///< columns: the axes in M
};
TurnExcitation MeasureTurns(const PoseTrajectory& trajectory, const ConditionedData& data);

/// Without turns about two axes no solve can tell the lever arm or the rotation.
class DegenerateMotion : public DataError {
 public:
  DegenerateMotion(const std::string& message, const std::string& unobservable)
      : DataError(message), unobservable(unobservable) {}
  std::string unobservable;  ///< the direction in words
};

/// Throws DegenerateMotion unless the motion suffices.
void CheckTurns(const TurnExcitation& turns);

}  // namespace imu_pose_calib
