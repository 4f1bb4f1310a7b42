#include "imu_pose_calib/core/covariance.h"

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <Eigen/SparseCholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

namespace imu_pose_calib {
namespace {

using SparseMatrix = Eigen::SparseMatrix<double>;

constexpr Eigen::Index kFewestClusters = 6;  // that tell a variance

MarginalEstimates SolveFor(const SparseMatrix& H,
                           const std::map<int, Eigen::VectorXd>& curvature,
                           const SparseMatrix& scores,
                           const SparseMatrix& L) {
  const Eigen::SimplicialLDLT<SparseMatrix> solver(H);
  if (solver.info() != Eigen::Success || (solver.vectorD().array() <= 0.0).any()) {
    const MarginalEstimate unknown = {
        Eigen::MatrixXd::Constant(L.cols(), L.cols(), std::numeric_limits<double>::infinity()),
        Eigen::MatrixXd::Zero(L.cols(), scores.cols())};
    return {unknown, unknown, Eigen::VectorXd::Zero(H.cols()), {}, {}};
  }
  const auto estimate = [&](const Eigen::MatrixXd& gain) {
    return MarginalEstimate{L.transpose() * gain, -gain.transpose() * scores};
  };
  const Eigen::MatrixXd X = solver.solve(Eigen::MatrixXd(L));
  const MarginalEstimate gauss_newton = estimate(X);
  const Eigen::VectorXd gradient = scores * Eigen::VectorXd::Ones(scores.cols());
  MarginalEstimates result{gauss_newton, gauss_newton, -solver.solve(gradient), X, {}};
  if (curvature.empty()) return result;

  // Exact columns add sum_k e_k c_k^T + c_k e_k^T = U W U^T: Woodbury.
  const auto count = static_cast<Eigen::Index>(curvature.size());
  Eigen::MatrixXd U = Eigen::MatrixXd::Zero(H.cols(), 2 * count);
  Eigen::MatrixXd W = Eigen::MatrixXd::Zero(2 * count, 2 * count);  // its own inverse
  Eigen::Index k = 0;
  for (const auto& [column, c] : curvature) {
    U(column, 2 * k) = 1.0;
    U.col(2 * k + 1) = c;
    for (const auto& [other, unused] : curvature) U(other, 2 * k + 1) *= 0.5;  // comes twice
    W(2 * k, 2 * k + 1) = W(2 * k + 1, 2 * k) = 1.0;
    ++k;
  }
  const Eigen::MatrixXd Y = solver.solve(U);
  const Eigen::MatrixXd inner = W + U.transpose() * Y;
  const MarginalEstimate exact = estimate(X - Y * inner.partialPivLu().solve(U.transpose() * X));
  if (exact.covariance.llt().info() == Eigen::Success) result.exact = exact;
  return result;
}

/// By how much the variance grows when clusters, columns of z in units of the model, are merged two
/// by two, and again while enough of them remain: errors slower than a cluster do that. Less one
/// sigma of what independent clusters scatter, and at least 1.
double SlowErrors(Eigen::MatrixXd z, double fitted) {
  const double parameters = static_cast<double>(z.rows()), clusters = static_cast<double>(z.cols());
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

MarginalEstimate GivenOthers(const MarginalEstimate& estimate, int count) {
  const auto others = estimate.covariance.rows() - count;
  if (others == 0) return estimate;
  const Eigen::MatrixXd& C = estimate.covariance;
  const Eigen::MatrixXd gain = C.bottomRightCorner(others, others)
                                   .ldlt()
                                   .solve(C.bottomLeftCorner(others, count))
                                   .transpose();
  return {C.topLeftCorner(count, count) - gain * C.bottomLeftCorner(others, count),
          estimate.influence.topRows(count) - gain * estimate.influence.bottomRows(others)};
}

MarginalEstimate Select(const MarginalEstimate& estimate, const std::vector<int>& places) {
  const auto count = static_cast<Eigen::Index>(places.size());
  MarginalEstimate selected{Eigen::MatrixXd(count, count),
                            Eigen::MatrixXd(count, estimate.influence.cols())};
  for (Eigen::Index i = 0; i < count; ++i) {
    const int place = places[static_cast<size_t>(i)];
    selected.influence.row(i) = estimate.influence.row(place);
    for (Eigen::Index j = 0; j < count; ++j)
      selected.covariance(i, j) = estimate.covariance(place, places[static_cast<size_t>(j)]);
  }
  return selected;
}

Eigen::VectorXd Curvature(ceres::Problem* problem,
                          const ceres::Problem::EvaluateOptions& options,
                          const ceres::CRSMatrix& J,
                          const std::vector<double>& residuals,
                          double* p,
                          int column,
                          double step) {
  const Eigen::Map<const Eigen::SparseMatrix<double, Eigen::RowMajor>> jacobian(
      J.num_rows,
      J.num_cols,
      static_cast<Eigen::Index>(J.values.size()),
      J.rows.data(),
      J.cols.data(),
      J.values.data());
  const Eigen::VectorXd own = jacobian * Eigen::VectorXd::Unit(J.num_cols, column);
  if (own.isZero(0.0)) return Eigen::VectorXd::Zero(J.num_cols);
  const double value = *p;
  std::vector<double> gradient;
  *p = value + step;
  const bool is_defined = problem->Evaluate(options, nullptr, nullptr, &gradient, nullptr);
  *p = value;
  if (!is_defined) return Eigen::VectorXd::Zero(J.num_cols);
  const Eigen::Map<const Eigen::VectorXd> r(residuals.data(), J.num_rows);
  const Eigen::VectorXd by_first_order = jacobian.transpose() * (r + step * own);
  return (Eigen::Map<const Eigen::VectorXd>(gradient.data(), J.num_cols) - by_first_order) / step;
}

MarginalEstimator::MarginalEstimator(int parameters,
                                     int leading,
                                     const std::vector<int>& part_of_cluster)
    : leading_(leading),
      part_of_cluster_(part_of_cluster),
      H_(static_cast<size_t>(*std::max_element(part_of_cluster.begin(), part_of_cluster.end()) + 1),
         SparseMatrix(parameters, parameters)) {}

void MarginalEstimator::Add(const ceres::CRSMatrix& J,
                            const std::vector<double>& residuals,
                            const std::vector<int>& cluster) {
  using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  const auto columns = [&J](int row) { return J.cols.begin() + J.rows[static_cast<size_t>(row)]; };
  std::vector<std::vector<Eigen::Triplet<double>>> triplets(H_.size());
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
    auto& part =
        triplets[static_cast<size_t>(part_of_cluster_[static_cast<size_t>(block_cluster)])];
    for (int i = 0; i < size; ++i) {
      const int column_i = columns(begin)[i];
      for (int j = 0; j < size; ++j)
        if (columns(begin)[j] <= column_i)
          part.emplace_back(column_i, columns(begin)[j], product(i, j));
      scores_.emplace_back(column_i, block_cluster, score[i]);
    }
  }
  for (size_t k = 0; k < H_.size(); ++k) {
    if (triplets[k].empty()) continue;
    SparseMatrix part(H_[k].rows(), H_[k].cols());
    part.setFromTriplets(triplets[k].begin(), triplets[k].end());
    H_[k] += part;
  }
}

void MarginalEstimator::AddCurvature(int column, const Eigen::VectorXd& curvature) {
  const auto place = curvature_.emplace(column, Eigen::VectorXd::Zero(curvature.size())).first;
  place->second += curvature;
}

void MarginalEstimator::AddPrior(int first, double information) {
  const int size = static_cast<int>(H_[0].rows());
  const double share = information / static_cast<double>(H_.size());
  std::vector<Eigen::Triplet<double>> diagonal;
  for (int i = first; i < size; ++i) diagonal.emplace_back(i, i, share);
  SparseMatrix prior(size, size);
  prior.setFromTriplets(diagonal.begin(), diagonal.end());
  for (SparseMatrix& H : H_) H += prior;
}

SparseMatrix MarginalEstimator::Sum(const std::vector<int>& parts) const {
  SparseMatrix sum = H_[static_cast<size_t>(parts.front())];
  for (size_t k = 1; k < parts.size(); ++k) sum += H_[static_cast<size_t>(parts[k])];
  return sum;
}

MarginalEstimates MarginalEstimator::Solve(const SparseMatrix& L) const {
  SparseMatrix scores(H_[0].rows(), static_cast<Eigen::Index>(part_of_cluster_.size()));
  scores.setFromTriplets(scores_.begin(), scores_.end());
  std::vector<int> all(H_.size());
  std::iota(all.begin(), all.end(), 0);
  SparseMatrix H = Sum(all);
  MarginalEstimates result = SolveFor(H, curvature_, scores, L);
  result.H.swap(H);
  return result;
}

std::vector<int> MarginalEstimator::ActingIn(const std::vector<int>& parts) const {
  const SparseMatrix H = Sum(parts);
  std::vector<int> acting;
  for (int column = 0; column < leading_; ++column) {
    // In the lower triangle a leading column holds its products with the trajectory.
    for (SparseMatrix::InnerIterator it(H, column); it; ++it) {
      if (it.row() < leading_ || it.value() == 0.0) continue;
      acting.push_back(column);
      break;
    }
  }
  return acting;
}

MarginalEstimate MarginalEstimator::SolveParts(const std::vector<int>& parts,
                                               const std::vector<int>& wanted) const {
  // Parameters that act only elsewhere, as most of the trajectory does, are left out.
  const SparseMatrix sum = parts.size() > 1 ? Sum(parts) : SparseMatrix();
  const SparseMatrix& H = parts.size() > 1 ? sum : H_[static_cast<size_t>(parts.front())];
  std::vector<bool> acts(static_cast<size_t>(H.cols()), false);
  for (int column = 0; column < H.cols(); ++column) {
    for (SparseMatrix::InnerIterator it(H, column); it; ++it) {
      if (it.row() == column || it.value() == 0.0) continue;
      acts[static_cast<size_t>(it.row())] = acts[static_cast<size_t>(column)] = true;
    }
  }
  std::fill_n(acts.begin(), leading_, false);
  for (const int i : wanted) acts[static_cast<size_t>(i)] = true;
  std::vector<int> place(acts.size(), -1);
  int size = 0;
  for (size_t i = 0; i < acts.size(); ++i)
    if (acts[i]) place[i] = size++;
  const auto place_of = [&place](Eigen::Index i) { return place[static_cast<size_t>(i)]; };

  std::vector<Eigen::Triplet<double>> kept;
  kept.reserve(static_cast<size_t>(H.nonZeros()));
  for (int column = 0; column < H.cols(); ++column)
    for (SparseMatrix::InnerIterator it(H, column); it; ++it)
      if (place_of(column) >= 0 && place_of(it.row()) >= 0)
        kept.emplace_back(place_of(it.row()), place_of(column), it.value());
  SparseMatrix own(size, size);
  own.setFromTriplets(kept.begin(), kept.end());

  std::vector<int> cluster(part_of_cluster_.size(), -1);
  int clusters = 0;
  for (size_t w = 0; w < cluster.size(); ++w)
    if (std::find(parts.begin(), parts.end(), part_of_cluster_[w]) != parts.end())
      cluster[w] = clusters++;
  kept.clear();
  for (const auto& score : scores_) {
    const int own_cluster = cluster[static_cast<size_t>(score.col())];
    if (own_cluster >= 0 && place_of(score.row()) >= 0)
      kept.emplace_back(place_of(score.row()), own_cluster, score.value());
  }
  SparseMatrix scores(size, clusters);
  scores.setFromTriplets(kept.begin(), kept.end());
  SparseMatrix L(size, static_cast<Eigen::Index>(wanted.size()));
  for (size_t k = 0; k < wanted.size(); ++k)
    L.insert(place_of(wanted[k]), static_cast<Eigen::Index>(k)) = 1.0;
  return SolveFor(own, {}, scores, L).gauss_newton;
}

Eigen::MatrixXd ClusterRobustCovariance(const MarginalEstimate& estimate, double fitted) {
  const Eigen::MatrixXd& model = estimate.covariance;
  if (!model.allFinite()) return model;
  const Eigen::MatrixXd L = model.llt().matrixL();
  // In units of the model's covariance: S = sum_w z_w z_w^T, the model is the identity.
  const Eigen::MatrixXd z =
      L.triangularView<Eigen::Lower>().solve(estimate.influence) / std::sqrt(1.0 - fitted);
  const Eigen::MatrixXd S = z * z.transpose();
  const Eigen::MatrixXd target =
      S.trace() / static_cast<double>(S.rows()) * Eigen::MatrixXd::Identity(S.rows(), S.cols());
  // Ledoit and Wolf: how much of the distance to the target is the scatter of the clusters?
  const auto clusters = static_cast<double>(z.cols());
  double scatter = 0.0;
  for (Eigen::Index w = 0; w < z.cols(); ++w)
    scatter += (clusters * z.col(w) * z.col(w).transpose() - S).squaredNorm();
  scatter /= clusters * clusters;
  const double distance = (S - target).squaredNorm();
  const double shrinkage = distance > scatter ? scatter / distance : 1.0;
  return SlowErrors(z, fitted) * L * (shrinkage * target + (1.0 - shrinkage) * S) * L.transpose();
}

}  // namespace imu_pose_calib
