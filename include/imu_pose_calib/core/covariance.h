#pragma once

#include <ceres/crs_matrix.h>

#include <Eigen/Core>
#include <vector>

namespace imu_pose_calib {

/// Covariance of the leading parameters of a least squares problem, the others marginalised.
struct MarginalCovariance {
  Eigen::MatrixXd model;   ///< leading block of H^-1, H = J^T J
  Eigen::MatrixXd robust;  ///< leading block of H^-1 (sum_w g_w g_w^T) H^-1, g_w = sum_w J^T r
};

/// `J` and `residuals` at the minimum, weighted and robustified; `cluster[i]` is the time block of
/// row i. Parameters without information get a variance of infinity.
MarginalCovariance ComputeMarginalCovariance(const ceres::CRSMatrix& J,
                                             const std::vector<double>& residuals,
                                             const std::vector<int>& cluster,
                                             int leading);

}  // namespace imu_pose_calib
