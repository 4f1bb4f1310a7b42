#pragma once

#include <ceres/crs_matrix.h>

#include <Eigen/Core>
#include <Eigen/SparseCore>
#include <vector>

namespace imu_pose_calib {

/// Covariance of the leading parameters of a least squares problem, the others marginalised.
struct MarginalCovariance {
  Eigen::MatrixXd model;   ///< leading block of H^-1, H = J^T J
  Eigen::MatrixXd robust;  ///< leading block of H^-1 (sum_w g_w g_w^T) H^-1, g_w = sum_w J^T r
};

/// Gathers H and the scores g_w of the clusters w from portions of the Jacobian, so that it need
/// not be held as a whole.
class MarginalCovarianceEstimator {
 public:
  MarginalCovarianceEstimator(int parameters, int leading);

  /// Rows of the weighted and robustified Jacobian and residuals at the minimum; `cluster[i]` is
  /// the time block of row i, -1 when it belongs to none.
  void Add(const ceres::CRSMatrix& J,
           const std::vector<double>& residuals,
           const std::vector<int>& cluster);

  /// Parameters without information get a variance of infinity.
  MarginalCovariance Compute() const;

 private:
  const int leading_;
  Eigen::SparseMatrix<double> H_;               ///< lower triangle
  std::vector<Eigen::Triplet<double>> scores_;  ///< (parameter, cluster, g)
  int clusters_ = 0;
};

}  // namespace imu_pose_calib
