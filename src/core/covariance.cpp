#include "imu_pose_calib/core/covariance.h"

#include <Eigen/SparseCholesky>
#include <algorithm>
#include <limits>

namespace imu_pose_calib {

MarginalCovarianceEstimator::MarginalCovarianceEstimator(int parameters, int leading)
    : leading_(leading), H_(parameters, parameters) {}

void MarginalCovarianceEstimator::Add(const ceres::CRSMatrix& J,
                                      const std::vector<double>& residuals,
                                      const std::vector<int>& cluster) {
  using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  const auto columns = [&J](int row) { return J.cols.begin() + J.rows[static_cast<size_t>(row)]; };
  std::vector<Eigen::Triplet<double>> triplets;
  for (int begin = 0, end = 0; begin < J.num_rows; begin = end) {
    // Rows of one residual block have the same columns: a dense block.
    const auto size = static_cast<int>(columns(begin + 1) - columns(begin));
    const int block_cluster = cluster[static_cast<size_t>(begin)];
    while (end < J.num_rows && cluster[static_cast<size_t>(end)] == block_cluster &&
           columns(end + 1) - columns(end) == size &&
           std::equal(columns(begin), columns(begin + 1), columns(end)))
      ++end;
    const Eigen::Map<const RowMajor> block(
        &J.values[static_cast<size_t>(J.rows[static_cast<size_t>(begin)])], end - begin, size);
    const Eigen::MatrixXd product = block.transpose() * block;
    const Eigen::VectorXd score =
        block.transpose() *
        Eigen::Map<const Eigen::VectorXd>(&residuals[static_cast<size_t>(begin)], end - begin);
    for (int i = 0; i < size; ++i) {
      const int column_i = columns(begin)[i];
      for (int j = 0; j < size; ++j)
        if (columns(begin)[j] <= column_i)
          triplets.emplace_back(column_i, columns(begin)[j], product(i, j));
      if (block_cluster >= 0) scores_.emplace_back(column_i, block_cluster, score[i]);
    }
    clusters_ = std::max(clusters_, block_cluster + 1);
  }
  Eigen::SparseMatrix<double> part(H_.rows(), H_.cols());
  part.setFromTriplets(triplets.begin(), triplets.end());
  H_ += part;
}

MarginalCovariance MarginalCovarianceEstimator::Compute() const {
  const Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>> solver(H_);
  MarginalCovariance covariance;
  if (solver.info() != Eigen::Success || (solver.vectorD().array() <= 0.0).any()) {
    covariance.model =
        std::numeric_limits<double>::infinity() * Eigen::MatrixXd::Ones(leading_, leading_);
    covariance.robust = covariance.model;
    return covariance;
  }
  const Eigen::MatrixXd X = solver.solve(Eigen::MatrixXd::Identity(H_.cols(), leading_));
  covariance.model = X.topRows(leading_);

  Eigen::SparseMatrix<double> G(H_.rows(), clusters_);
  G.setFromTriplets(scores_.begin(), scores_.end());
  const Eigen::MatrixXd influence = X.transpose() * G;  // of each cluster
  const double correction = clusters_ > 1 ? clusters_ / (clusters_ - 1.0) : 1.0;
  covariance.robust = correction * influence * influence.transpose();
  return covariance;
}

}  // namespace imu_pose_calib
