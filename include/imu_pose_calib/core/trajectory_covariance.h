#pragma once

#include <memory>
#include <vector>

#include "imu_pose_calib/core/solution.h"

namespace imu_pose_calib {

/// Covariance of parameters that act at one instant, from the normal equations of a joint solve;
/// what is held is without error. Making it takes about as long as a pass of the solve.
class TrajectoryCovariance {
 public:
  /// Throws DataError when the trajectory is not determined.
  explicit TrajectoryCovariance(const std::shared_ptr<const Solution>& solution);

  /// Columns of the parameters, one for each degree of freedom; -1 for what is held.
  using Columns = std::vector<int>;
  /// The kSplineOrder control points of d from `first` on, then those of phi.
  Columns ControlPoints(size_t session, size_t first) const;
  /// What is calibrated, `size` degrees of freedom. q_MI turns on the left by twice the step.
  Columns Calibrated(ParameterKind kind, size_t imu, int size) const;
  /// time_shift and clock_drift.
  Columns Clock(size_t session, size_t imu) const;
  /// Two, in the tangent space of Ceres' sphere.
  Columns Gravity(size_t session) const;
  /// The bias knots `knot` and `knot` + 1 of one sensor.
  Columns BiasKnotPair(size_t session, size_t imu, bool is_accel, size_t knot) const;

  /// Covariance of parameters that share a residual, and at the ends of runs of all that act there:
  /// control points, the bias knots around them and what is calibrated. Of others it has zeros.
  Eigen::MatrixXd At(const Columns& columns) const;

 private:
  Columns Kept(int first, int count) const;

  std::shared_ptr<const Solution> solution_;
  // First columns, of each session:
  std::vector<int> d_, gravity_;
  std::vector<std::vector<int>> gyro_knots_, accel_knots_;  ///< of each IMU
  Panels inverse_;  ///< elements of H^-1, what is held being known
};

}  // namespace imu_pose_calib
