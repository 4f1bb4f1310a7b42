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
#include <memory>
#include <optional>
#include <random>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/calibration/least_squares.h"
#include "imu_pose_calib/core/solver/normal_equations.h"

namespace imu_pose_calib {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Something curved of a quaternion, a vector, a scale and a control point each side.
struct Curved {
  Eigen::Vector3d y;
  template <typename T>
  bool operator()(const T* q, const T* g, const T* s, const T* a, const T* b, T* r) const {
    using Vector = Eigen::Matrix<T, 3, 1>;
    const Vector turned =
        Eigen::Map<const Eigen::Quaternion<T>>(q) *
        Vector(Eigen::Map<const Vector>(g) + Eigen::Map<const Vector>(a).cwiseAbs2() * exp(s[0]));
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
    border_ = {problem_.AddParameters(q_.coeffs().data(), 4), problem_.AddParameters(g_.data(), 3),
               problem_.AddParameters(&s_, 1)};
    ceres_.AddParameterBlock(q_.coeffs().data(), 4);
    ceres_.AddParameterBlock(g_.data(), 3);
#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
    ceres_.SetManifold(q_.coeffs().data(), new QuaternionManifold);
#else
    ceres_.SetParameterization(q_.coeffs().data(), new QuaternionManifold);
#endif
    for (size_t k = 0; k + 1 < points_.size(); ++k) {
      const Curved curved{vector()};
      const auto create = [&curved] {
        return std::make_unique<ceres::AutoDiffCostFunction<Curved, 3, 4, 3, 1, 3, 3>>(
            new Curved(curved));
      };
      const std::vector<double*> parameters = {q_.coeffs().data(), g_.data(), &s_,
                                               points_[k].data(), points_[k + 1].data()};
      const bool is_robust = k % 3 == 0;
      Add(problem_.AddResidualsOf(parameters, create(), is_robust ? 0.7 : 0.0),
          ceres_.AddResidualBlock(create().release(),
                                  is_robust ? new ceres::CauchyLoss(0.7) : nullptr, parameters),
          k);
    }
    const auto prior = [] {
      return std::make_unique<ceres::NormalPrior>(Eigen::Matrix3d::Identity(),
                                                  Eigen::Vector3d::Ones());
    };
    for (size_t k = 0; k < points_.size(); ++k)
      Add(problem_.AddResidualsOf({points_[k].data()}, prior()),
          ceres_.AddResidualBlock(prior().release(), nullptr, points_[k].data()), k);
    problem_.SetHeld(points_[5].data(), true);
    for (Eigen::Vector3d& point : points_)
      if (problem_.IsEstimated(point.data())) inner_.push_back(problem_.Find(point.data()));
  }

  void Add(int block, ceres::ResidualBlockId same, size_t k) {
    const size_t session = k < 12 ? 0 : 1;
    equations_.push_back(
        {block, session, 0.1 * static_cast<double>((7 * k) % 12), static_cast<int>(session)});
    same_.push_back(same);
  }

  static EliminatedWindows Eliminate(const NormalEquations& equations, double max_factor_mb) {
    return {equations.elimination(), VectorXd::Ones(2), max_factor_mb, 2,
            [&](size_t window) { return equations.Assemble(window); }};
  }
  static Reduced Reduce(const NormalEquations& equations) {
    return Eliminate(equations, 0.0).ReduceAll({});
  }

  /// J, with the loss as Ceres applies it, in the order of border and inner, and r.
  void Dense(MatrixXd* J, VectorXd* r) {
    ceres::Problem::EvaluateOptions options;
    for (const std::vector<int>* blocks : {&border_, &inner_})
      for (const int block : *blocks) options.parameter_blocks.push_back(problem_.data(block));
    options.residual_blocks = same_;
    std::vector<double> residuals;
    ceres::CRSMatrix sparse;
    ASSERT_TRUE(ceres_.Evaluate(options, nullptr, &residuals, nullptr, &sparse));
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
  Problem problem_;
  std::vector<Equation> equations_;
  std::vector<int> border_, inner_;
  ceres::Problem ceres_;  ///< the same
  std::vector<ceres::ResidualBlockId> same_;
};

TEST_F(NormalEquationsTest, AreThoseOfCeresWhereverTheParametersStand) {
  const NormalEquations equations(problem_, border_, inner_, equations_, 2);
  for (const double step : {0.0, 0.3}) {
    SCOPED_TRACE(step);
    const VectorXd moved = VectorXd::Constant(equations.elimination()->columns(), step);
    problem_.Move(equations.blocks(), moved);
    MatrixXd J;
    VectorXd r;
    Dense(&J, &r);
    const Reduced reduced = Reduce(equations);
    const MatrixXd H = J.transpose() * J;
    const MatrixXd b = J.transpose() * r;
    const MatrixXd expected = b.transpose() * H.llt().solve(b);
    EXPECT_NEAR(reduced.Products().sum(), expected(0, 0), 1e-9 * expected(0, 0));
    const MatrixXd C = H.llt().solve(MatrixXd::Identity(H.rows(), H.rows()));
    EXPECT_LT((reduced.H * C.topLeftCorner(7, 7) - MatrixXd::Identity(7, 7)).norm(), 1e-8);
  }
}

TEST_F(NormalEquationsTest, KeepTheScoresOfWindowsApart) {
  const NormalEquations equations(problem_, border_, inner_, equations_, 2);
  const Reduced reduced = Reduce(equations);  // a point acts in both
  MatrixXd J;
  VectorXd r;
  Dense(&J, &r);
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

TEST_F(NormalEquationsTest, AreSolvedByFactorsThatAreKeptOrFoundAgain) {
  const NormalEquations equations(problem_, border_, inner_, equations_, 2);
  MatrixXd J;
  VectorXd r;
  Dense(&J, &r);
  const VectorXd expected = -(J.transpose() * J).llt().solve(J.transpose() * r);
  for (const double max_factor_mb : {0.0, 1.0}) {
    SCOPED_TRACE(max_factor_mb);
    EliminatedWindows windows = Eliminate(equations, max_factor_mb);
    const Reduced reduced = windows.ReduceAll({});
    VectorXd x = VectorXd::Zero(expected.size());
    x.head(reduced.H.rows()) = -reduced.H.llt().solve(reduced.B.rowwise().sum());
    windows.SubstituteBack([&](size_t window) { return equations.Assemble(window); }, &x);
    EXPECT_LT((x - expected).norm(), 1e-9 * expected.norm());
    EXPECT_EQ(windows.TakeFactor().empty(), max_factor_mb == 0.0);
  }
}

TEST_F(NormalEquationsTest, RefuseWhatIsNotFinite) {
  const NormalEquations equations(problem_, border_, inner_, equations_, 2);
  points_[3][1] = std::numeric_limits<double>::quiet_NaN();
  EXPECT_THROW(equations.Assemble(0), DataError);
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
  void Add(std::unique_ptr<ceres::CostFunction> cost, double* parameters,
           double cauchy_scale = 0.0) {
    if (!least_squares_) {
      sessions_.resize(1);
      estimate_.sessions.resize(1);
      least_squares_.emplace(options_, sessions_, models_, &estimate_);
    }
    Problem& problem = least_squares_->problem;
    const int block = problem.AddResidualsOf({parameters}, std::move(cost), cauchy_scale);
    least_squares_->Add(block, 0, 0.0);
    least_squares_->trajectory_blocks = {problem.Find(parameters)};
  }

  CalibrationOptions options_;
  std::vector<PreparedSession> sessions_;
  std::vector<SensorModel> models_;
  Estimate estimate_;
  std::optional<LeastSquares> least_squares_;
};

TEST_F(SolveTest, IsDampedWhereAFullStepClimbs) {
  double x[] = {-1.2, 1.0};
  Add(std::make_unique<ceres::AutoDiffCostFunction<Valley, 2, 2>>(new Valley), x);
  const StepSummary first = least_squares_->Step();
  EXPECT_FALSE(first.is_whole);
  EXPECT_GT(first.iterations, 1);
  for (int step = 0; step < 30; ++step) least_squares_->Step();
  EXPECT_TRUE(least_squares_->Step().is_whole);
  EXPECT_NEAR(x[0], 1.0, 1e-6);
  EXPECT_NEAR(x[1], 1.0, 1e-6);
}

TEST_F(SolveTest, ReturnsNothingWhenItDoesNotConverge) {
  double x[] = {-1.2, 1.0};
  options_.max_iterations = 3;
  Add(std::make_unique<ceres::AutoDiffCostFunction<Valley, 2, 2>>(new Valley), x);
  const StepSummary refused = least_squares_->Step();
  EXPECT_FALSE(refused.is_whole);
  EXPECT_TRUE(std::isinf(refused.moved));
  EXPECT_EQ(x[0], -1.2);
  EXPECT_FALSE(least_squares_->SolveWithCeres(1e-12));
}

TEST_F(SolveTest, ThrowsWhereTheResidualsAreNotDefined) {
  double x[] = {std::numeric_limits<double>::quiet_NaN(), 1.0};
  Add(std::make_unique<ceres::AutoDiffCostFunction<Valley, 2, 2>>(new Valley), x);
  EXPECT_THROW(least_squares_->Step(), DataError);
}

TEST_F(SolveTest, FindsTheMinimumThatCeresFinds) {
  std::mt19937 random(11);
  std::normal_distribution<double> normal;
  double x[] = {0.0, 0.0}, expected[] = {0.0, 0.0};
  ceres::Problem problem;
  for (int k = 0; k < 50; ++k) {
    const Eigen::Vector2d y(normal(random) + (k % 7 == 0 ? 8.0 : 0.0), normal(random));
    const Eigen::Matrix2d A = Eigen::Matrix2d::NullaryExpr([&] { return normal(random); });
    Add(std::make_unique<ceres::NormalPrior>(A, y), x, 1.0);
    problem.AddResidualBlock(new ceres::NormalPrior(A, y), new ceres::CauchyLoss(1.0), expected);
  }
  for (int step = 0; step < 50; ++step) least_squares_->Step();
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
