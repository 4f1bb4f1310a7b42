#pragma once

#include <Eigen/Core>
#include <vector>

namespace imu_pose_calib {

/// Student's t distribution of 3-vectors about 0, doc/math.md, S4, "Noise": normal with tails as
/// heavy as `dof` is low.
struct StudentT {
  double scale = 0.0;  ///< per axis, in the unit of the vectors
  double dof = 0.0;    ///< degrees of freedom

  /// Of a vector in the weighted least squares whose minimum is the likeliest; 1 in the mean.
  double Weight(double squared_norm) const {
    return (dof + 3.0) / (dof + squared_norm / (scale * scale));
  }
};

/// By what the residual of a sample of a weight is multiplied to be that of weight 1, where its
/// leverage (its element of the hat matrix) is `leverage`, doc/math.md, S4, "Outliers".
inline double ToUsualWeight(double leverage, double weight) {
  return 1.0 - leverage * (1.0 - weight);
}

/// The likeliest of 1 to 100 degrees of freedom. x: at least one vector; the scale is 1e-6 at
/// least.
StudentT FitStudentT(const std::vector<Eigen::Vector3d>& x);

}  // namespace imu_pose_calib
