#pragma once

#include <ceres/crs_matrix.h>
#include <ceres/problem.h>

#include <Eigen/Core>
#include <Eigen/SparseCore>
#include <map>
#include <vector>

namespace imu_pose_calib {

/// Some linear functionals of the parameters of a least squares problem, most of them parameters
/// themselves; all others are marginalised.
struct MarginalEstimate {
  Eigen::MatrixXd covariance;  ///< L^T H^-1 L, H = J^T J
  /// Column w: -L^T H^-1 g_w, what the scores g_w = sum_w J^T r of cluster w add to the
  /// Gauss-Newton step. At the minimum the columns add up to 0.
  Eigen::MatrixXd influence;

  Eigen::VectorXd Step() const { return influence.rowwise().sum(); }
};

/// By the Gauss-Newton Hessian J^T J and by one whose columns of some parameters are exact.
struct MarginalEstimates {
  MarginalEstimate gauss_newton;
  MarginalEstimate exact;  ///< the same as gauss_newton when it would not be positive definite
  Eigen::VectorXd step;    ///< Gauss-Newton step of all parameters
  Eigen::MatrixXd gain;    ///< H^-1 L
  Eigen::SparseMatrix<double> H;  ///< lower triangle
};

/// The first `count` functionals, as if the others were known to be right.
MarginalEstimate GivenOthers(const MarginalEstimate& estimate, int count);
/// The functionals at `places`, whatever the others are.
MarginalEstimate Select(const MarginalEstimate& estimate, const std::vector<int>& places);

/// Gathers H and the scores of the clusters from portions of the Jacobian, so that it need not be
/// held as a whole. Clusters belong to parts of the data, which can be looked at alone.
class MarginalEstimator {
 public:
  /// The first `leading` parameters are those that parts are asked for.
  MarginalEstimator(int parameters, int leading, const std::vector<int>& part_of_cluster);

  /// Rows of the weighted and robustified Jacobian and residuals at the minimum; `cluster[i]` is
  /// the time block of row i.
  void Add(const ceres::CRSMatrix& J,
           const std::vector<double>& residuals,
           const std::vector<int>& cluster);

  /// sum_i r_i d^2 r_i / (dx_column dx) of rows that were added, see Curvature(): what column
  /// `column`, a leading one, of the Hessian has beyond J^T J. Once per portion and column.
  void AddCurvature(int column, const Eigen::VectorXd& curvature);

  /// `information` on each parameter from `first` on, beside what the rows say: keeps those that no
  /// sample sees determined.
  void AddPrior(int first, double information);

  /// Functionals are the columns of L. Infinite when some parameter has no information.
  MarginalEstimates Solve(const Eigen::SparseMatrix<double>& L) const;
  /// What some parts say alone, by J^T J, of the leading parameters at `wanted`, which must act in
  /// them.
  MarginalEstimate SolveParts(const std::vector<int>& parts, const std::vector<int>& wanted) const;
  /// Leading parameters of which these parts say anything.
  std::vector<int> ActingIn(const std::vector<int>& parts) const;

  size_t parts() const { return H_.size(); }

 private:
  Eigen::SparseMatrix<double> Sum(const std::vector<int>& parts) const;

  const int leading_;
  const std::vector<int> part_of_cluster_;
  std::vector<Eigen::SparseMatrix<double>> H_;  ///< lower triangles, of each part
  std::map<int, Eigen::VectorXd> curvature_;    ///< by column
  std::vector<Eigen::Triplet<double>> scores_;  ///< (parameter, cluster, g)
};

/// sum_i r_i d^2 r_i / (dp dx) for every column x of J, from the gradient `step` further in the
/// scalar p, whose column in J is `column`. J and `residuals` are what `problem` evaluates to with
/// `options`.
Eigen::VectorXd Curvature(ceres::Problem* problem,
                          const ceres::Problem::EvaluateOptions& options,
                          const ceres::CRSMatrix& J,
                          const std::vector<double>& residuals,
                          double* p,
                          int column,
                          double step);

/// Largest share of the scores' degrees of freedom that a fit is taken to have used up.
constexpr double kLargestFittedShare = 0.5;

/// Cluster-robust (sandwich) covariance H^-1 (sum_w g_w g_w^T) H^-1 from the influences of the
/// clusters, doc/math.md Eq. (16): for the degrees of freedom that the fit took from the scores
/// (share `fitted`, 0..kLargestFittedShare), drawn towards a multiple of H^-1 as far as the
/// clusters are too few to tell it from that, and larger as a whole when errors last longer than a
/// cluster.
Eigen::MatrixXd ClusterRobustCovariance(const MarginalEstimate& estimate, double fitted);

}  // namespace imu_pose_calib
