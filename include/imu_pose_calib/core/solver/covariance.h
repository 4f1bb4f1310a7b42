#pragma once

#include <Eigen/Core>
#include <vector>

#include "imu_pose_calib/core/solver/elimination.h"

namespace imu_pose_calib {

/// Some linear functionals of the parameters of a least squares problem, most of them parameters
/// themselves; all others are marginalised.
struct MarginalEstimate {
  Eigen::MatrixXd covariance;  ///< L^T H^-1 L, H = J^T J
  /// Column k: -L^T H^-1 G_k, what the scores G_k = sum_k J^T r of cluster k add to the
  /// Gauss-Newton step. At the minimum the columns add up to 0.
  Eigen::MatrixXd influence;
  /// Share of each functional that is known beforehand, diagonal of H_prior H^-1.
  Eigen::VectorXd known;

  /// How many of the functionals the scores tell, those that are known beforehand in part.
  double Told() const;
  Eigen::VectorXd Step() const { return influence.rowwise().sum(); }
};

/// From B^T H^-1 B, where B holds the scores of the clusters, then the functionals. Infinite when
/// it is not finite.
MarginalEstimate EstimateMarginals(const Eigen::MatrixXd& products, int clusters, int functionals);
/// Of columns of the border, all others of it being known, with the influence of these clusters.
MarginalEstimate EstimateBorder(const Reduced& reduced, const std::vector<int>& columns,
                                const std::vector<int>& clusters);

/// The functionals at `places`, whatever the others are.
MarginalEstimate Select(const MarginalEstimate& estimate, const std::vector<int>& places);

/// Largest share of the scores' degrees of freedom that a fit is taken to have used up.
constexpr double kLargestFittedShare = 0.5;

/// Cluster-robust (sandwich) covariance H^-1 (sum_k G_k G_k^T) H^-1 from the influences of the
/// clusters, doc/math.md Eq. (16): for the degrees of freedom that the fit took from the scores
/// (share `fitted`, 0..kLargestFittedShare), drawn towards a multiple of H^-1, by how much the
/// functionals scatter that the clusters tell, as far as these are too few to tell it from that,
/// and larger as a whole when errors last longer than a cluster.
Eigen::MatrixXd ClusterRobustCovariance(const MarginalEstimate& estimate, double fitted);

}  // namespace imu_pose_calib
