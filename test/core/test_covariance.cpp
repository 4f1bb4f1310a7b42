#include <ceres/autodiff_cost_function.h>
#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <limits>
#include <random>

#include "imu_pose_calib/core/covariance.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;
using SparseMatrix = Eigen::SparseMatrix<double>;

ceres::CRSMatrix ToCrs(const MatrixXd& dense) {
  ceres::CRSMatrix sparse;
  sparse.num_rows = static_cast<int>(dense.rows());
  sparse.num_cols = static_cast<int>(dense.cols());
  sparse.rows.push_back(0);
  for (int i = 0; i < sparse.num_rows; ++i) {
    for (int j = 0; j < sparse.num_cols; ++j) {
      if (dense(i, j) == 0.0) continue;
      sparse.cols.push_back(j);
      sparse.values.push_back(dense(i, j));
    }
    sparse.rows.push_back(static_cast<int>(sparse.cols.size()));
  }
  return sparse;
}

/// Random Jacobian of which a third is not zero.
MatrixXd RandomJacobian(int rows, int cols, std::mt19937* random) {
  std::normal_distribution<double> normal;
  return MatrixXd::NullaryExpr(
      rows, cols, [&] { return (*random)() % 3 == 0 ? normal(*random) : 0.0; });
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

/// The first `count` of `size` parameters.
SparseMatrix Leading(Eigen::Index size, int count) {
  return MatrixXd::Identity(size, count).sparseView();
}

/// In two portions; the clusters from `second_half` on are part 1.
MarginalEstimator Estimator(const MatrixXd& J,
                            const std::vector<double>& residuals,
                            const std::vector<int>& cluster,
                            int leading,
                            int second_half = 3) {
  std::vector<int> part_of_cluster;
  for (int w = 0; w <= *std::max_element(cluster.begin(), cluster.end()); ++w)
    part_of_cluster.push_back(w < second_half ? 0 : 1);
  MarginalEstimator estimator(static_cast<int>(J.cols()), leading, part_of_cluster);
  const auto rows = static_cast<ptrdiff_t>(J.rows()), half = rows / 2;
  const auto part = [](const auto& all, ptrdiff_t begin, ptrdiff_t end) {
    return std::decay_t<decltype(all)>(all.begin() + begin, all.begin() + end);
  };
  estimator.Add(ToCrs(J.topRows(half)), part(residuals, 0, half), part(cluster, 0, half));
  estimator.Add(
      ToCrs(J.bottomRows(rows - half)), part(residuals, half, rows), part(cluster, half, rows));
  return estimator;
}

MarginalEstimate Marginal(const MatrixXd& J,
                          const std::vector<double>& residuals,
                          const std::vector<int>& cluster,
                          int leading) {
  return Estimator(J, residuals, cluster, leading).Solve(Leading(J.cols(), leading)).gauss_newton;
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

  const MarginalEstimates estimates = Estimator(J, residuals, cluster, 3).Solve(L.sparseView());
  const MarginalEstimate& marginal = estimates.gauss_newton;
  EXPECT_LT((estimates.gain - gain).norm(), 1e-10 * gain.norm());
  EXPECT_LT((marginal.covariance - L.transpose() * gain).norm(), 1e-10 * H.inverse().norm());
  const MatrixXd influence = -gain.transpose() * scores;
  EXPECT_LT((marginal.influence - influence).norm(), 1e-10 * influence.norm());
  const VectorXd step = -H.inverse() * scores.rowwise().sum();
  EXPECT_LT((estimates.step - step).norm(), 1e-10 * step.norm());
  EXPECT_LT((marginal.Step() - L.transpose() * step).norm(), 1e-10 * step.norm());
  const MatrixXd lower = H.triangularView<Eigen::Lower>();
  EXPECT_LT((MatrixXd(estimates.H) - lower).norm(), 1e-12 * H.norm());
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

TEST(MarginalCovariance, GivenOthersEqualsAProblemWithoutTheOtherColumns) {
  std::mt19937 random(11);
  const int rows = 60, cols = 12;
  const MatrixXd J = RandomJacobian(rows, cols, &random);
  const std::vector<double> residuals = RandomResiduals(rows, &random);
  const MarginalEstimate conditioned =
      GivenOthers(Marginal(J, residuals, Blocks(rows, 6), 5), 3);  // columns 3 and 4 known
  MatrixXd without(rows, cols - 2);
  without << J.leftCols(3), J.rightCols(cols - 5);
  const MarginalEstimate expected = Marginal(without, residuals, Blocks(rows, 6), 3);
  EXPECT_LT((conditioned.covariance - expected.covariance).norm(),
            1e-10 * expected.covariance.norm());
  EXPECT_LT((conditioned.influence - expected.influence).norm(), 1e-10 * expected.influence.norm());
}

TEST(MarginalCovariance, PartsAreTheProblemsOfTheirRows) {
  // The last columns are known to one half only, like a trajectory.
  std::mt19937 random(12);
  const int rows = 60, cols = 12;
  MatrixXd J = RandomJacobian(rows, cols, &random);
  J.block(0, 9, 30, 3).setZero();
  J.block(30, 6, 30, 3).setZero();
  const std::vector<double> residuals = RandomResiduals(rows, &random);
  const MarginalEstimator estimator = Estimator(J, residuals, Blocks(rows, 6), 4, 5);
  for (const int half : {0, 1}) {
    MatrixXd part(30, 9);
    part << J.block(30 * half, 0, 30, 6), J.block(30 * half, half == 0 ? 6 : 9, 30, 3);
    const auto begin = residuals.begin() + 30 * half;
    const MarginalEstimate expected =
        Marginal(part, std::vector<double>(begin, begin + 30), Blocks(30, 6), 4);
    const MarginalEstimate estimate = estimator.SolveParts({half}, {0, 1, 2, 3});
    EXPECT_LT((estimate.covariance - expected.covariance).norm(),
              1e-10 * expected.covariance.norm());
    EXPECT_LT((estimate.Step() - expected.Step()).norm(), 1e-10 * expected.Step().norm());
  }
  const MarginalEstimate whole = Marginal(J, residuals, Blocks(rows, 6), 4);
  const MarginalEstimate both = estimator.SolveParts({0, 1}, {0, 1, 2, 3});
  EXPECT_LT((both.covariance - whole.covariance).norm(), 1e-10 * whole.covariance.norm());
  EXPECT_LT((both.Step() - whole.Step()).norm(), 1e-10 * whole.Step().norm());
}

TEST(MarginalCovariance, PartsLeaveOutWhatActsElsewhereOnly) {
  // Leading columns 1 and 2 act in one half each.
  std::mt19937 random(16);
  const int rows = 60, cols = 10;
  MatrixXd J = RandomJacobian(rows, cols, &random);
  J.block(30, 1, 30, 1).setZero();
  J.block(0, 2, 30, 1).setZero();
  const std::vector<double> residuals = RandomResiduals(rows, &random);
  const MarginalEstimator estimator = Estimator(J, residuals, Blocks(rows, 6), 4, 5);
  ASSERT_EQ(estimator.parts(), 2u);
  EXPECT_EQ(estimator.ActingIn({0}), (std::vector<int>{0, 1, 3}));
  EXPECT_EQ(estimator.ActingIn({1}), (std::vector<int>{0, 2, 3}));
  EXPECT_EQ(estimator.ActingIn({0, 1}), (std::vector<int>{0, 1, 2, 3}));
  MatrixXd part(30, cols - 1);
  part << J.topLeftCorner(30, 2), J.topRightCorner(30, cols - 3);
  const MarginalEstimate expected =
      Marginal(part, {residuals.begin(), residuals.begin() + 30}, Blocks(30, 6), 3);
  const MarginalEstimate estimate = estimator.SolveParts({0}, estimator.ActingIn({0}));
  EXPECT_LT((estimate.covariance - expected.covariance).norm(), 1e-10 * expected.covariance.norm());
  EXPECT_LT((estimate.influence - expected.influence).norm(), 1e-10 * expected.influence.norm());
}

TEST(MarginalCovariance, ExactColumnsEqualTheDenseFormulas) {
  std::mt19937 random(23);
  const int rows = 60, cols = 12, leading = 5;
  const MatrixXd J = RandomJacobian(rows, cols, &random);
  const std::vector<double> residuals = RandomResiduals(rows, &random);
  const std::vector<int> cluster = Blocks(rows, 6);
  MatrixXd S = 0.3 * MatrixXd::Random(cols, cols);  // second derivatives by columns 1 and 4
  S = (S + S.transpose()).eval();
  MatrixXd H = J.transpose() * J;
  MarginalEstimator estimator = Estimator(J, residuals, cluster, leading);
  for (const int column : {1, 4}) {
    estimator.AddCurvature(column, 0.25 * S.col(column));  // in two portions
    estimator.AddCurvature(column, 0.75 * S.col(column));
    for (int i = 0; i < cols; ++i) {
      if (i == 1 && column == 4) continue;  // is there
      H(i, column) += S(i, column);
      if (i != column) H(column, i) += S(i, column);
    }
  }
  const MarginalEstimates estimates = estimator.Solve(Leading(cols, leading));
  const MatrixXd expected = H.inverse().topLeftCorner(leading, leading);
  ASSERT_TRUE(expected.llt().info() == Eigen::Success);
  EXPECT_LT((estimates.exact.covariance - expected).norm(), 1e-10 * expected.norm());
  const MarginalEstimate plain = Marginal(J, residuals, cluster, leading);
  EXPECT_EQ((estimates.gauss_newton.covariance - plain.covariance).norm(), 0.0);
  EXPECT_GT((estimates.exact.covariance - plain.covariance).norm(), 1e-3 * expected.norm());
  VectorXd g = VectorXd::Zero(cols);
  for (int i = 0; i < rows; ++i) g += residuals[static_cast<size_t>(i)] * J.row(i).transpose();
  const VectorXd step = -(H.inverse() * g).head(leading);
  EXPECT_LT((estimates.exact.Step() - step).norm(), 1e-10 * step.norm());
}

TEST(MarginalCovariance, ExactColumnsAreLeftOutWhereTheyWouldTakeAllInformation) {
  const MatrixXd J = MatrixXd::Identity(6, 6);
  MarginalEstimator estimator = Estimator(J, std::vector<double>(6, 1.0), Blocks(6, 1), 2);
  estimator.AddCurvature(0, -2.0 * VectorXd::Unit(6, 0));
  const MarginalEstimates estimates = estimator.Solve(Leading(6, 2));
  EXPECT_TRUE(estimates.exact.covariance.isApprox(estimates.gauss_newton.covariance));
}

/// r_i = y_i - a sin(w t_i).
struct Wave {
  double t, y;
  template <typename T>
  bool operator()(const T* a, const T* w, T* residual) const {
    *residual = y - *a * sin(*w * t);
    return true;
  }
};

TEST(Curvature, IsTheSecondDerivativeThatGaussNewtonLeavesOut) {
  std::mt19937 random(5);
  std::normal_distribution<double> normal;
  double a = 1.3, w = 2.1;
  ceres::Problem problem;
  double aw = 0.0, ww = 0.0;  // sum of r d^2 r / da dw and r d^2 r / dw^2
  for (int i = 0; i < 20; ++i) {
    const double t = 0.1 * i, y = normal(random);
    problem.AddResidualBlock(
        new ceres::AutoDiffCostFunction<Wave, 1, 1, 1>(new Wave{t, y}), nullptr, &a, &w);
    const double r = y - a * std::sin(w * t);
    aw -= r * t * std::cos(w * t);
    ww += r * a * t * t * std::sin(w * t);
  }
  ceres::Problem::EvaluateOptions options;
  options.parameter_blocks = {&a, &w};
  std::vector<double> residuals;
  ceres::CRSMatrix J;
  problem.Evaluate(options, nullptr, &residuals, nullptr, &J);
  const VectorXd curvature = Curvature(&problem, options, J, residuals, &w, 1, 1e-6);
  ASSERT_EQ(curvature.size(), 2);
  EXPECT_NEAR(curvature[0], aw, 1e-4);
  EXPECT_NEAR(curvature[1], ww, 1e-4);
  EXPECT_EQ(w, 2.1);
}

TEST(MarginalCovariance, IsInfiniteForAParameterWithoutInformation) {
  std::mt19937 random(2);
  MatrixXd J = RandomJacobian(40, 6, &random);
  J.col(4).setZero();
  const MarginalEstimate c = Marginal(J, RandomResiduals(40, &random), Blocks(40, 4), 3);
  const double infinity = std::numeric_limits<double>::infinity();
  EXPECT_TRUE((c.covariance.diagonal().array() == infinity).all());
  EXPECT_TRUE((ClusterRobustCovariance(c, 0.0).diagonal().array() == infinity).all());
}

TEST(MarginalCovariance, IsNotSpoiltByAnUnseenParameterWithAPrior) {
  std::mt19937 random(13);
  MatrixXd J = RandomJacobian(40, 6, &random);
  J.col(4).setZero();
  const std::vector<double> residuals = RandomResiduals(40, &random);
  MarginalEstimator estimator = Estimator(J, residuals, Blocks(40, 4), 3);
  estimator.AddPrior(4, 1e-9);
  MatrixXd seen(40, 5);
  seen << J.leftCols(4), J.col(5);
  const MatrixXd expected = Marginal(seen, residuals, Blocks(40, 4), 3).covariance;
  EXPECT_LT((estimator.Solve(Leading(6, 3)).gauss_newton.covariance - expected).norm(),
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
  EXPECT_NEAR(ClusterRobustCovariance(c, 0.0)(0, 0) / c.covariance(0, 0),
              5.0,
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

}  // namespace
}  // namespace imu_pose_calib
