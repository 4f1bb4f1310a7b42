#include "imu_pose_calib/core/solver/covariance.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/solver/normal_equations.h"

namespace imu_pose_calib {
namespace {

constexpr Eigen::Index kFewestClusters = 6;  // that tell a variance

/// By how much the variance grows when clusters, columns of z in units of the model, are merged two
/// by two, and again while enough of them remain: errors slower than a cluster do that. Less one
/// sigma of what independent clusters scatter, and at least 1.
double SlowErrors(Eigen::MatrixXd z, double parameters, double fitted) {
  const auto clusters = static_cast<double>(z.cols());
  const double variance = z.squaredNorm();
  double growth = 1.0;
  for (double share = fitted; z.cols() >= 2 * kFewestClusters;) {
    const Eigen::Index count = (z.cols() + 1) / 2;
    Eigen::MatrixXd merged = Eigen::MatrixXd::Zero(z.rows(), count);
    for (Eigen::Index w = 0; w < z.cols(); ++w) merged.col(w / 2) += z.col(w);
    z = merged;
    share =
        std::min(kLargestFittedShare, 2.0 * share);  // the fit sets as many of fewer scores to 0
    const double scatter =
        std::sqrt(2.0 / parameters * (1.0 / static_cast<double>(count) - 1.0 / clusters));
    growth =
        std::max(growth, z.squaredNorm() / variance * (1.0 - fitted) / (1.0 - share) - scatter);
  }
  return growth;
}

}  // namespace

double MarginalEstimate::Told() const {
  return std::max(1.0, static_cast<double>(covariance.rows()) - known.sum());
}

MarginalEstimate EstimateBorder(const Reduced& reduced, const std::vector<int>& columns,
                                const std::vector<int>& clusters) {
  const auto count = static_cast<Eigen::Index>(columns.size());
  const auto scores = static_cast<Eigen::Index>(clusters.size());
  Reduced kept{Gather(reduced.H, columns, columns), Eigen::MatrixXd(count, scores + count),
               Eigen::MatrixXd::Zero(scores + count, scores + count)};
  kept.B << Gather(reduced.B, columns, clusters), Eigen::MatrixXd::Identity(count, count);
  return EstimateMarginals(kept.Products(), static_cast<int>(scores), static_cast<int>(count));
}

MarginalEstimate EstimateMarginals(const Eigen::MatrixXd& products, int clusters, int functionals) {
  if (!products.allFinite())
    return {Eigen::MatrixXd::Constant(functionals, functionals,
                                      std::numeric_limits<double>::infinity()),
            Eigen::MatrixXd::Zero(functionals, clusters), Eigen::VectorXd::Zero(functionals)};
  const auto rows = products.middleRows(clusters, functionals);
  return {rows.middleCols(clusters, functionals), -rows.leftCols(clusters),
          Eigen::VectorXd::Zero(functionals)};
}

MarginalEstimate Select(const MarginalEstimate& estimate, const std::vector<int>& places) {
  const std::vector<int> clusters = Counted(static_cast<size_t>(estimate.influence.cols()));
  return {Gather(estimate.covariance, places, places), Gather(estimate.influence, places, clusters),
          Gather(estimate.known, places, {0})};
}

Eigen::MatrixXd ClusterRobustCovariance(const MarginalEstimate& estimate, double fitted) {
  const Eigen::MatrixXd& model = estimate.covariance;
  if (!model.allFinite()) return model;
  Eigen::MatrixXd L = model, z_T = estimate.influence.transpose() / std::sqrt(1.0 - fitted);
  Factor(L, z_T);
  L.triangularView<Eigen::StrictlyUpper>().setZero();
  // In units of the model's covariance: S = sum_w z_w z_w^T, the model is the identity.
  const Eigen::MatrixXd z = z_T.transpose(), S = Product(z, z_T);
  const Eigen::MatrixXd target =
      S.trace() / estimate.Told() * Eigen::MatrixXd::Identity(S.rows(), S.cols());
  // Ledoit and Wolf: how much of the distance to the target is the scatter of the clusters?
  const auto clusters = static_cast<double>(z.cols());
  double scatter = 0.0;
  for (Eigen::Index w = 0; w < z.cols(); ++w)
    scatter += (clusters * z.col(w) * z.col(w).transpose() - S).squaredNorm();
  scatter /= clusters * clusters;
  const double distance = (S - target).squaredNorm();
  const double shrinkage = distance > scatter ? scatter / distance : 1.0;
  return SlowErrors(z, estimate.Told(), fitted) *
         Propagate(L, shrinkage * target + (1.0 - shrinkage) * S);
}

}  // namespace imu_pose_calib
