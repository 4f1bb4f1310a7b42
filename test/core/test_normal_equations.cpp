#include <ceres/autodiff_cost_function.h>
#include <ceres/crs_matrix.h>
#include <ceres/loss_function.h>
#include <ceres/normal_prior.h>
#include <ceres/solver.h>
#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <random>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/least_squares.h"
#include "imu_pose_calib/core/manifolds.h"
#include "imu_pose_calib/core/normal_equations.h"

namespace imu_pose_calib {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Something curved of a quaternion, a direction, a scale and a control point each side.
struct Curved {
  Eigen::Vector3d y;
  template <typename T>
  bool operator()(const T* q, const T* g, const T* s, const T* a, const T* b, T* r) const {
    using Vector = Eigen::Matrix<T, 3, 1>;
    const Vector turned =
        Eigen::Map<const Eigen::Quaternion<T>>(q) *
        Vector(Eigen::Map<const Vector>(g) * exp(s[0]) + Eigen::Map<const Vector>(a).cwiseAbs2());
    Eigen::Map<Vector> residual(r);
    residual = turned - Eigen::Map<const Vector>(b) - y.cast<T>();
    return true;
  }
};

class NormalEquationsTest : public testing::Test {
 protected:
  NormalEquationsTest() {
    std::mt19937 random(3);
    std::normal_distribution<double> normal;
    const auto vector = [&] {
      return Eigen::Vector3d(normal(random), normal(random), normal(random));
    };
    q_ = Eigen::Quaterniond(0.5, -0.1, 0.7, 0.3).normalized();
    g_ = vector();
    for (Eigen::Vector3d& point : points_) point = vector();
    problem_.AddParameterBlock(q_.coeffs().data(), 4);
    SetUnitQuaternion(q_.coeffs().data(), &problem_);
    problem_.AddParameterBlock(g_.data(), 3);
    SetSphere(g_.data(), &problem_);
    for (size_t k = 0; k + 1 < points_.size(); ++k) {
      const auto block = problem_.AddResidualBlock(
          new ceres::AutoDiffCostFunction<Curved, 3, 4, 3, 1, 3, 3>(new Curved{vector()}),
          k % 3 == 0 ? new ceres::CauchyLoss(0.7) : nullptr,
          q_.coeffs().data(),
          g_.data(),
          &s_,
          points_[k].data(),
          points_[k + 1].data());
      equations_.push_back({block, k < 12 ? 0u : 1u, 0.1 * static_cast<double>((7 * k) % 12)});
    }
    for (size_t k = 0; k < points_.size(); ++k)
      equations_.push_back(
          {problem_.AddResidualBlock(
               new ceres::NormalPrior(Eigen::Matrix3d::Identity(), Eigen::Vector3d::Ones()),
               nullptr,
               points_[k].data()),
           k < 12 ? 0u : 1u,
           0.1 * static_cast<double>((7 * k) % 12)});
    problem_.SetParameterBlockConstant(points_[5].data());
    border_ = {q_.coeffs().data(), g_.data(), &s_};
    for (Eigen::Vector3d& point : points_)
      if (point.data() != points_[5].data()) inner_.push_back(point.data());
  }

  /// J, with the loss as Ceres applies it, in the order of border and inner, and r.
  void Dense(MatrixXd* J, VectorXd* r, const std::vector<Equation>& equations) {
    ceres::Problem::EvaluateOptions options;
    options.parameter_blocks = border_;
    options.parameter_blocks.insert(options.parameter_blocks.end(), inner_.begin(), inner_.end());
    for (const Equation& equation : equations) options.residual_blocks.push_back(equation.block);
    std::vector<double> residuals;
    ceres::CRSMatrix sparse;
    ASSERT_TRUE(problem_.Evaluate(options, nullptr, &residuals, nullptr, &sparse));
    *J = MatrixXd::Zero(sparse.num_rows, sparse.num_cols);
    for (int i = 0; i < sparse.num_rows; ++i)
      for (int k = sparse.rows[static_cast<size_t>(i)]; k < sparse.rows[static_cast<size_t>(i) + 1];
           ++k)
        (*J)(i, sparse.cols[static_cast<size_t>(k)]) = sparse.values[static_cast<size_t>(k)];
    *r = Eigen::Map<VectorXd>(residuals.data(), sparse.num_rows);
  }

  Eigen::Quaterniond q_;
  Eigen::Vector3d g_;
  double s_ = 0.2;
  std::vector<Eigen::Vector3d> points_ = std::vector<Eigen::Vector3d>(24);
  ceres::Problem problem_;
  std::vector<Equation> equations_;
  std::vector<double*> border_, inner_;
};

TEST_F(NormalEquationsTest, AreThoseOfCeresWhereverTheParametersStand) {
  const NormalEquations equations(problem_, border_, inner_, equations_, 2);
  for (const double step : {0.0, 0.3}) {
    SCOPED_TRACE(step);
    const VectorXd moved = VectorXd::Constant(equations.elimination()->columns(), step);
    MoveBlocks(problem_, equations.blocks(), moved);
    MatrixXd J;
    VectorXd r;
    Dense(&J, &r, equations_);
    std::vector<Panels> panels = equations.Assemble(1, {});
    const Reduced reduced =
        EliminateAll(*equations.elimination(), VectorXd::Ones(1), false, 1, &panels);
    const MatrixXd H = J.transpose() * J;
    const MatrixXd b = J.transpose() * r;
    const MatrixXd expected = b.transpose() * H.llt().solve(b);
    EXPECT_NEAR(reduced.Products()(0, 0), expected(0, 0), 1e-9 * expected(0, 0));
    const MatrixXd C = H.llt().solve(MatrixXd::Identity(H.rows(), H.rows()));
    EXPECT_LT((reduced.H * C.topLeftCorner(6, 6) - MatrixXd::Identity(6, 6)).norm(), 1e-8);
  }
}

TEST_F(NormalEquationsTest, KeepTheScoresOfClustersApart) {
  std::vector<Equation> clustered = equations_;
  for (Equation& equation : clustered) equation.cluster = static_cast<int>(equation.session);
  const NormalEquations equations(problem_, border_, inner_, clustered, 2);
  std::vector<Panels> panels = equations.Assemble(2, {});
  Elimination::Merge(std::move(panels[1]), &panels[0]);  // a point acts in both
  const Reduced reduced = equations.elimination()->Eliminate(VectorXd::Ones(2), false, &panels[0]);
  MatrixXd J;
  VectorXd r;
  Dense(&J, &r, equations_);
  MatrixXd B(J.cols(), 2);
  for (const int w : {0, 1}) {
    VectorXd own = r;
    for (size_t k = 0; k < equations_.size(); ++k)
      if (static_cast<int>(equations_[k].session) != w)
        own.segment<3>(3 * static_cast<Eigen::Index>(k)).setZero();
    B.col(w) = J.transpose() * own;
  }
  const MatrixXd products = B.transpose() * (J.transpose() * J).llt().solve(B);
  EXPECT_LT((reduced.Products() - products).norm(), 1e-9 * products.norm());
}

TEST_F(NormalEquationsTest, RefuseWhatIsNotFinite) {
  const NormalEquations equations(problem_, border_, inner_, equations_, 2);
  points_[3][1] = std::numeric_limits<double>::quiet_NaN();
  EXPECT_THROW(equations.Assemble(1, {}), DataError);
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

TEST(ExactColumn, IsTheSecondDerivativeThatGaussNewtonLeavesOut) {
  std::mt19937 random(5);
  std::normal_distribution<double> normal;
  double a = 1.3, w = 2.1;
  ceres::Problem problem;
  std::vector<Equation> all;
  double aw = 0.0, ww = 0.0;  // sum of r d^2 r / da dw and r d^2 r / dw^2
  for (int i = 0; i < 20; ++i) {
    const double t = 0.1 * i, y = normal(random);
    all.push_back(
        {problem.AddResidualBlock(
             new ceres::AutoDiffCostFunction<Wave, 1, 1, 1>(new Wave{t, y}), nullptr, &a, &w),
         0,
         t});
    const double r = y - a * std::sin(w * t);
    aw -= r * t * std::cos(w * t);
    ww += r * a * t * t * std::sin(w * t);
  }
  const NormalEquations equations(problem, {&a, &w}, {}, all, 1);
  std::vector<Panels> panels = equations.Assemble(1, {{&w, 1e-6, 1}});
  const Reduced reduced = equations.elimination()->Eliminate(VectorXd::Ones(2), false, &panels[0]);
  EXPECT_NEAR(reduced.B(0, 1), aw, 1e-4);
  EXPECT_NEAR(reduced.B(1, 1), ww, 1e-4);
  EXPECT_EQ(w, 2.1);
}

/// Rosenbrock's valley: from (-1.2, 1) the full first step climbs by a factor of a hundred.
struct Valley {
  template <typename T>
  bool operator()(const T* x, T* r) const {
    r[0] = 10.0 * (x[1] - x[0] * x[0]);
    r[1] = 1.0 - x[0];
    return true;
  }
};

/// A solve of residuals of its own.
class SolveTest : public testing::Test {
 protected:
  void Add(ceres::CostFunction* cost, ceres::LossFunction* loss, double* parameters) {
    if (!least_squares_) {
      sessions_.resize(1);
      estimate_.sessions.resize(1);
      least_squares_.emplace(options_, sessions_, models_, &estimate_);
    }
    const auto block = least_squares_->problem.AddResidualBlock(cost, loss, parameters);
    least_squares_->priors.push_back({block, 0, 0.0});
    std::vector<double*>& blocks = least_squares_->trajectory_blocks;
    if (std::find(blocks.begin(), blocks.end(), parameters) == blocks.end())
      blocks.push_back(parameters);
  }

  CalibrationOptions options_;
  std::vector<PreparedSession> sessions_;
  std::vector<SensorModel> models_;
  Estimate estimate_;
  std::optional<LeastSquares> least_squares_;
};

TEST_F(SolveTest, IsDampedWhereAFullStepClimbs) {
  double x[] = {-1.2, 1.0};
  Add(new ceres::AutoDiffCostFunction<Valley, 2, 2>(new Valley), nullptr, x);
  EXPECT_GT(least_squares_->Solve(1e-12), 2);
  EXPECT_NEAR(x[0], 1.0, 1e-6);
  EXPECT_NEAR(x[1], 1.0, 1e-6);
}

TEST_F(SolveTest, ThrowsWhenItDoesNotConverge) {
  double x[] = {-1.2, 1.0};
  options_.max_iterations = 3;
  Add(new ceres::AutoDiffCostFunction<Valley, 2, 2>(new Valley), nullptr, x);
  EXPECT_THROW(least_squares_->Solve(1e-12), DataError);
}

TEST_F(SolveTest, ThrowsWhereTheResidualsAreNotDefined) {
  double x[] = {std::numeric_limits<double>::quiet_NaN(), 1.0};
  Add(new ceres::AutoDiffCostFunction<Valley, 2, 2>(new Valley), nullptr, x);
  EXPECT_THROW(least_squares_->Solve(1e-12), DataError);
}

TEST_F(SolveTest, FindsTheMinimumThatCeresFinds) {
  std::mt19937 random(11);
  std::normal_distribution<double> normal;
  double x[] = {0.0, 0.0}, expected[] = {0.0, 0.0};
  ceres::Problem problem;
  for (int k = 0; k < 50; ++k) {
    const Eigen::Vector2d y(normal(random) + (k % 7 == 0 ? 8.0 : 0.0), normal(random));
    const Eigen::Matrix2d A = Eigen::Matrix2d::NullaryExpr([&] { return normal(random); });
    Add(new ceres::NormalPrior(A, y), new ceres::CauchyLoss(1.0), x);
    problem.AddResidualBlock(new ceres::NormalPrior(A, y), new ceres::CauchyLoss(1.0), expected);
  }
  least_squares_->Solve(1e-14);
  ceres::Solver::Options options;
  options.function_tolerance = options.parameter_tolerance = 1e-14;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  EXPECT_NEAR(x[0], expected[0], 1e-5);
  EXPECT_NEAR(x[1], expected[1], 1e-5);
  EXPECT_GT(std::abs(x[0]), 1e-3);
}

}  // namespace
}  // namespace imu_pose_calib
