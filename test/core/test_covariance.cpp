#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <limits>
#include <random>

#include "eliminate_all.h"
#include "imu_pose_calib/core/solver/covariance.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Random Jacobian of which a third is not zero.
MatrixXd RandomJacobian(int rows, int cols, std::mt19937* random) {
  std::normal_distribution<double> normal;
  return MatrixXd::NullaryExpr(rows, cols,
                               [&] { return (*random)() % 3 == 0 ? normal(*random) : 0.0; });
}

std::vector<double> RandomResiduals(int rows, std::mt19937* random) {
  std::normal_distribution<double> normal;
  std::vector<double> residuals(static_cast<size_t>(rows));
  for (double& r : residuals) r = normal(*random);
  return residuals;
}

/// Clusters of `size` consecutive rows.
std::vector<int> Blocks(int rows, int size) {
  std::vector<int> cluster;
  for (int i = 0; i < rows; ++i) cluster.push_back(i / size);
  return cluster;
}

int Count(const std::vector<int>& cluster) {
  return *std::max_element(cluster.begin(), cluster.end()) + 1;
}

/// J^T J, the scores of the clusters and further right-hand sides, when all but the leading columns
/// is eliminated.
Reduced Reduce(const MatrixXd& J, const std::vector<double>& residuals,
               const std::vector<int>& cluster, int leading, const MatrixXd& rhs,
               double prior = 0.0) {
  std::vector<std::vector<int>> rows;
  for (Eigen::Index i = 0; i < J.rows(); ++i) {
    rows.emplace_back();
    for (int j = 0; j < J.cols(); ++j)
      if (J(i, j) != 0.0) rows.back().push_back(j);
  }
  const Elimination elimination(std::vector<int>(static_cast<size_t>(J.cols()), 1),
                                static_cast<size_t>(leading), rows, {0});
  Panels panels;
  for (size_t r = 0; r < rows.size(); ++r) {
    std::sort(rows[r].begin(), rows[r].end(),
              [&elimination](int a, int b) { return elimination.place(a) < elimination.place(b); });
    std::vector<int> places;
    VectorXd own(static_cast<Eigen::Index>(rows[r].size()));
    for (Eigen::Index k = 0; k < own.size(); ++k) {
      const int column = rows[r][static_cast<size_t>(k)];
      places.push_back(elimination.place(column));
      own[k] = J(static_cast<Eigen::Index>(r), column);
    }
    if (places.empty()) continue;
    elimination.Add(places, own * own.transpose(), &panels);
    elimination.AddRhs(places, cluster[r], residuals[r] * own, &panels);
  }
  for (int k = 0; k < rhs.cols(); ++k)
    for (int i = 0; i < rhs.rows(); ++i)
      elimination.AddRhs({elimination.place(i)}, Count(cluster) + k,
                         VectorXd::Constant(1, rhs(i, k)), &panels);
  elimination.VisitDiagonal([prior](int, auto diagonal) { diagonal.array() += prior; }, &panels);
  std::vector<Panels> windows = {std::move(panels)};
  Panels shared;
  return EliminateAll(elimination, VectorXd::Ones(Count(cluster) + rhs.cols()), false, &windows,
                      &shared);
}

/// Of the leading columns.
MarginalEstimate Marginal(const MatrixXd& J, const std::vector<double>& residuals,
                          const std::vector<int>& cluster, int leading, double prior = 0.0) {
  const Reduced reduced =
      Reduce(J, residuals, cluster, leading, MatrixXd::Identity(J.cols(), leading), prior);
  return EstimateMarginals(reduced.Products(), Count(cluster), leading);
}

TEST(MarginalCovariance, EqualsTheDenseFormulas) {
  std::mt19937 random(1);
  const int rows = 60, cols = 12, clusters = 7;
  for (const int leading : {1, 5, 12}) {
    SCOPED_TRACE(leading);
    const MatrixXd J = RandomJacobian(rows, cols, &random);
    const std::vector<double> residuals = RandomResiduals(rows, &random);
    std::vector<int> cluster;  // not in order
    for (int i = 0; i < rows; ++i) cluster.push_back((5 * i + i / 11) % clusters);

    const MatrixXd H_inv = (J.transpose() * J).inverse();
    MatrixXd scores = MatrixXd::Zero(cols, clusters);
    for (int i = 0; i < rows; ++i)
      scores.col(cluster[static_cast<size_t>(i)]) +=
          residuals[static_cast<size_t>(i)] * J.row(i).transpose();
    const MarginalEstimate marginal = Marginal(J, residuals, cluster, leading);
    const MatrixXd influence = -H_inv.topRows(leading) * scores;
    ASSERT_EQ(marginal.covariance.rows(), leading);
    ASSERT_EQ(marginal.influence.cols(), clusters);
    EXPECT_LT((marginal.covariance - H_inv.topLeftCorner(leading, leading)).norm(),
              1e-10 * H_inv.norm());
    EXPECT_LT((marginal.influence - influence).norm(), 1e-10 * influence.norm());
  }
}

TEST(MarginalCovariance, OfFunctionalsEqualsTheDenseFormulas) {
  std::mt19937 random(14);
  const int rows = 60, cols = 12, clusters = 10;
  const MatrixXd J = RandomJacobian(rows, cols, &random);
  const std::vector<double> residuals = RandomResiduals(rows, &random);
  const std::vector<int> cluster = Blocks(rows, rows / clusters);
  const MatrixXd L = RandomJacobian(cols, 4, &random);
  const MatrixXd H = J.transpose() * J;
  MatrixXd scores = MatrixXd::Zero(cols, clusters);
  for (int i = 0; i < rows; ++i)
    scores.col(cluster[static_cast<size_t>(i)]) +=
        residuals[static_cast<size_t>(i)] * J.row(i).transpose();
  const MatrixXd gain = H.inverse() * L;

  const Reduced reduced = Reduce(J, residuals, cluster, 3, L);
  const MarginalEstimate marginal = EstimateMarginals(reduced.Products(), clusters, 4);
  EXPECT_LT((marginal.covariance - L.transpose() * gain).norm(), 1e-10 * H.inverse().norm());
  const MatrixXd influence = -gain.transpose() * scores;
  EXPECT_LT((marginal.influence - influence).norm(), 1e-10 * influence.norm());
  const VectorXd step = -gain.transpose() * scores.rowwise().sum();
  EXPECT_LT((marginal.Step() - step).norm(), 1e-10 * step.norm());
}

TEST(MarginalCovariance, SelectTakesRowsAndColumns) {
  std::mt19937 random(15);
  const MatrixXd J = RandomJacobian(60, 12, &random);
  const MarginalEstimate all = Marginal(J, RandomResiduals(60, &random), Blocks(60, 6), 5);
  const MarginalEstimate two = Select(all, {4, 1});
  EXPECT_EQ(two.covariance(0, 1), all.covariance(4, 1));
  EXPECT_EQ(two.covariance(1, 1), all.covariance(1, 1));
  EXPECT_EQ(two.influence.row(0), all.influence.row(4));
  EXPECT_EQ(two.influence.row(1), all.influence.row(1));
}

TEST(MarginalCovariance, OfTheBorderLeavesOutItsOtherColumns) {
  std::mt19937 random(16);
  const int rows = 60, cols = 10;
  const MatrixXd J = RandomJacobian(rows, cols, &random);
  const std::vector<double> residuals = RandomResiduals(rows, &random);
  const std::vector<int> cluster = Blocks(rows, 6);
  MatrixXd part(rows, cols - 1);  // column 2 is known
  part << J.leftCols(2), J.rightCols(cols - 3);
  const MarginalEstimate expected = Marginal(part, residuals, cluster, 3);
  const MarginalEstimate estimate =
      EstimateBorder(Reduce(J, residuals, cluster, 4, MatrixXd(cols, 0)), {0, 1, 3},
                     {0, 1, 2, 3, 4, 5, 6, 7, 8, 9});
  EXPECT_LT((estimate.covariance - expected.covariance).norm(), 1e-10 * expected.covariance.norm());
  EXPECT_LT((estimate.influence - expected.influence).norm(), 1e-10 * expected.influence.norm());
}

TEST(MarginalCovariance, OfPartsAddUp) {
  // The last columns are known to one half only, like a trajectory.
  std::mt19937 random(12);
  const int rows = 60, cols = 12;
  MatrixXd J = RandomJacobian(rows, cols, &random);
  J.block(0, 9, 30, 3).setZero();
  J.block(30, 6, 30, 3).setZero();
  const std::vector<double> residuals = RandomResiduals(rows, &random);
  const std::vector<int> cluster = Blocks(rows, 6);
  const MatrixXd none(9, 0);
  MatrixXd first(30, 9), second(30, 9);
  first << J.topLeftCorner(30, 9);
  second << J.bottomLeftCorner(30, 6), J.bottomRightCorner(30, 3);
  const auto middle = residuals.begin() + 30;
  std::vector<int> later = Blocks(30, 6);
  for (int& w : later) w += 5;
  Reduced sum = Reduce(first, {residuals.begin(), middle}, Blocks(30, 6), 6, MatrixXd::Zero(9, 5));
  const Reduced other = Reduce(second, {middle, residuals.end()}, later, 6, none);
  sum.H += other.H;
  sum.B += other.B;
  const MarginalEstimate both =
      EstimateBorder(sum, {0, 1, 2, 3, 4, 5}, {0, 1, 2, 3, 4, 5, 6, 7, 8, 9});
  const MarginalEstimate whole = Marginal(J, residuals, cluster, 6);
  EXPECT_LT((both.covariance - whole.covariance).norm(), 1e-10 * whole.covariance.norm());
  EXPECT_LT((both.influence - whole.influence).norm(), 1e-10 * whole.influence.norm());
}

TEST(MarginalCovariance, IsInfiniteForAParameterWithoutInformation) {
  std::mt19937 random(2);
  MatrixXd J = RandomJacobian(40, 6, &random);
  J.col(1).setZero();
  const MarginalEstimate c = Marginal(J, RandomResiduals(40, &random), Blocks(40, 4), 3);
  const double infinity = std::numeric_limits<double>::infinity();
  EXPECT_TRUE((c.covariance.diagonal().array() == infinity).all());
  EXPECT_TRUE((ClusterRobustCovariance(c, 0.0).diagonal().array() == infinity).all());
}

TEST(MarginalCovariance, IsNotSpoiltByAnUnseenParameterWithOrWithoutAPrior) {
  std::mt19937 random(13);
  MatrixXd J = RandomJacobian(40, 6, &random);
  J.col(4).setZero();
  const std::vector<double> residuals = RandomResiduals(40, &random);
  MatrixXd seen(40, 5);
  seen << J.leftCols(4), J.col(5);
  const MatrixXd expected = Marginal(seen, residuals, Blocks(40, 4), 3).covariance;
  for (const double prior : {0.0, 1e-9})
    EXPECT_LT((Marginal(J, residuals, Blocks(40, 4), 3, prior).covariance - expected).norm(),
              1e-6 * expected.norm());
}

TEST(MarginalCovariance, IsNeverConfidentInParametersThatActAlike) {
  // Rounding may leave a little false information: no variance below 1e8 all the same.
  for (uint32_t seed = 3; seed < 23; ++seed) {
    SCOPED_TRACE(seed);
    std::mt19937 random(seed);
    MatrixXd J = RandomJacobian(40, 6, &random);
    J.col(1) = 0.7 * J.col(3) - 1.3 * J.col(5);
    const MarginalEstimate c = Marginal(J, RandomResiduals(40, &random), Blocks(40, 4), 2);
    EXPECT_GT(c.covariance(1, 1), 1e8);
  }
}

TEST(MarginalCovariance, RobustEqualsModelInTheMeanForIndependentUnitResiduals) {
  std::mt19937 random(4);
  const int rows = 400, cols = 5, draws = 400;
  const MatrixXd J = RandomJacobian(rows, cols, &random);
  const Eigen::LLT<MatrixXd> H(J.transpose() * J);
  MatrixXd sum = MatrixXd::Zero(3, 3);
  MatrixXd model;
  for (int draw = 0; draw < draws; ++draw) {
    const std::vector<double> noise = RandomResiduals(rows, &random);
    const Eigen::Map<const VectorXd> e(noise.data(), rows);
    const VectorXd r = e - J * H.solve(J.transpose() * e);  // at the minimum
    const MarginalEstimate c = Marginal(J, {r.data(), r.data() + rows}, Blocks(rows, 4), 3);
    sum += ClusterRobustCovariance(c, 1.0 / 100.0) / draws;
    model = c.covariance;
  }
  // 100 clusters: one draw scatters by 14 %, the mean of 400 by 0.7 %; 5 of 400 degrees of freedom
  // are lost to the fit and 1 of 100 is given back.
  for (int i = 0; i < 3; ++i) EXPECT_NEAR(sum(i, i) / model(i, i), 1.0, 0.04) << i;
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < i; ++k)
      EXPECT_NEAR(sum(i, k), model(i, k), 0.04 * std::sqrt(model(i, i) * model(k, k)));
}

TEST(MarginalCovariance, RobustGrowsWithTheCorrelationInsideOfClusters) {
  // Residuals equal within clusters of 5 for a constant: the variance of the mean is 5 times that
  // of independent ones.
  std::mt19937 random(5);
  const int rows = 1000;
  const MatrixXd J = MatrixXd::Ones(rows, 1);
  const std::vector<double> noise = RandomResiduals(rows / 5, &random);
  std::vector<double> residuals;
  for (int i = 0; i < rows; ++i) residuals.push_back(noise[static_cast<size_t>(i / 5)]);
  const MarginalEstimate c = Marginal(J, residuals, Blocks(rows, 5), 1);
  EXPECT_NEAR(c.covariance(0, 0), 1e-3, 1e-12);
  EXPECT_NEAR(ClusterRobustCovariance(c, 0.0)(0, 0) / c.covariance(0, 0), 5.0,
              1.5);  // 200 clusters: sigma 0.5
}

TEST(ClusterRobustCovariance, GrowsWithErrorsThatLastLongerThanACluster) {
  const int parameters = 8, clusters = 24, repeats = 20;
  std::mt19937 random(9);
  std::normal_distribution<double> normal;
  double independent = 0.0, slow = 0.0;
  for (int k = 0; k < repeats; ++k) {
    MarginalEstimate estimate;
    estimate.covariance = MatrixXd::Identity(parameters, parameters);
    estimate.influence = MatrixXd::NullaryExpr(
        parameters, clusters, [&] { return normal(random) / std::sqrt(clusters); });
    independent += ClusterRobustCovariance(estimate, 0.0).trace() / (parameters * repeats);
    // Four clusters in a row alike: four times the variance.
    for (int w = 0; w < clusters; ++w)
      estimate.influence.col(w) = estimate.influence.col(w - w % 4).eval();
    slow += ClusterRobustCovariance(estimate, 0.0).trace() / (parameters * repeats);
  }
  EXPECT_GT(independent, 0.9);
  EXPECT_LT(independent, 1.25);
  EXPECT_GT(slow, 3.4);
  EXPECT_LT(slow, 4.6);
}

TEST(ClusterRobustCovariance, IsNotMadeSmallerByWhatIsKnownBeforehand) {
  const int told = 4, known = 8, clusters = 24, repeats = 20;
  std::mt19937 random(9);
  std::normal_distribution<double> normal;
  double alone = 0.0, counted = 0.0, beside = 0.0;  // variances of what is told
  const auto variance = [](const MarginalEstimate& estimate) {
    return ClusterRobustCovariance(estimate, 0.0).diagonal().head(told).mean() / repeats;
  };
  for (int k = 0; k < repeats; ++k) {
    MarginalEstimate estimate;
    estimate.covariance = MatrixXd::Identity(told, told);
    estimate.influence = MatrixXd::NullaryExpr(
        told, clusters, [&] { return 2.0 * normal(random) / std::sqrt(clusters); });
    alone += variance(estimate);
    estimate.influence.conservativeResize(told + known, Eigen::NoChange);
    estimate.influence.bottomRows(known).setZero();
    estimate.covariance = MatrixXd::Identity(told + known, told + known);
    counted += variance(estimate);
    estimate.known = Eigen::VectorXd::Zero(told + known);
    estimate.known.tail(known).setOnes();
    beside += variance(estimate);
  }
  EXPECT_LT(counted, 0.95 * alone);
  EXPECT_GT(beside, 0.95 * alone);
  EXPECT_LT(beside, 1.05 * alone);
}

}  // namespace
}  // namespace imu_pose_calib
