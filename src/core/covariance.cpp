#include "imu_pose_calib/core/covariance.h"

#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>
#include <algorithm>
#include <limits>

namespace imu_pose_calib {

MarginalCovariance ComputeMarginalCovariance(const ceres::CRSMatrix& J,
                                             const std::vector<double>& residuals,
                                             const std::vector<int>& cluster,
                                             int leading) {
  using RowMajor = Eigen::SparseMatrix<double, Eigen::RowMajor>;
  const Eigen::Map<const RowMajor> A(J.num_rows,
                                     J.num_cols,
                                     static_cast<Eigen::Index>(J.values.size()),
                                     J.rows.data(),
                                     J.cols.data(),
                                     J.values.data());
  const Eigen::SparseMatrix<double> H = A.transpose() * A;
  const Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>> solver(H);
  MarginalCovariance covariance;
  if (solver.info() != Eigen::Success || (solver.vectorD().array() <= 0.0).any()) {
    covariance.model =
        std::numeric_limits<double>::infinity() * Eigen::MatrixXd::Ones(leading, leading);
    covariance.robust = covariance.model;
    return covariance;
  }
  const Eigen::MatrixXd X = solver.solve(Eigen::MatrixXd::Identity(J.num_cols, leading));
  covariance.model = X.topRows(leading);

  const Eigen::MatrixXd influence = A * X;  // of each residual on the leading parameters
  const int clusters = 1 + *std::max_element(cluster.begin(), cluster.end());
  Eigen::MatrixXd sums = Eigen::MatrixXd::Zero(leading, clusters);
  for (Eigen::Index i = 0; i < influence.rows(); ++i)
    sums.col(cluster[static_cast<size_t>(i)]) +=
        residuals[static_cast<size_t>(i)] * influence.row(i).transpose();
  const double correction = clusters > 1 ? clusters / (clusters - 1.0) : 1.0;
  covariance.robust = correction * sums * sums.transpose();
  return covariance;
}

}  // namespace imu_pose_calib
