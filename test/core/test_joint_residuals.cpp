#include <ceres/gradient_checker.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <memory>
#include <random>
#include <vector>

#include "imu_pose_calib/core/joint_residuals.h"
#include "imu_pose_calib/core/manifolds.h"
#include "imu_pose_calib/core/so3.h"

namespace imu_pose_calib {
namespace {

using Eigen::Vector3d;

#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
using Manifold = ceres::Manifold;
using QuaternionManifold = ceres::EigenQuaternionManifold;
#else
using Manifold = ceres::LocalParameterization;
using QuaternionManifold = ceres::EigenQuaternionParameterization;
#endif

/// Random blocks of a residual: control points of a lively correction, then the given parameters.
class JointResiduals : public ::testing::Test {
 protected:
  JointResiduals() {
    for (auto& point : d_) point = Random(0.01);
    for (auto& point : phi_) point = Random(0.3);
    sample_.gp.q_WM = Exp<double>(Random(1.0));
    sample_.gp.omega_M = Random(2.0);
    sample_.gp.alpha_M = Random(8.0);
    sample_.gp.a_W = Random(5.0);
    sample_.gp_rate.omega_M = Random(8.0);
    sample_.gp_rate.alpha_M = Random(30.0);
    sample_.gp_rate.a_W = Random(30.0);
    sample_.t = 3.0;
    sample_.t_M = 3.021;
    sample_.t_drift = -0.5;
    sample_.value = Random(3.0);
    sample_.bias_u = 0.3;
    sample_.sigma = 0.05;
    sample_.place = {0, 0.4, 0.03};
  }

  Vector3d Random(double scale) {
    std::uniform_real_distribution<double> uniform(-scale, scale);
    return {uniform(random_), uniform(random_), uniform(random_)};
  }

  std::vector<double*> Points(std::vector<std::vector<Vector3d>*> splines) {
    std::vector<double*> blocks;
    for (auto* points : splines)
      for (Vector3d& point : *points) blocks.push_back(point.data());
    return blocks;
  }

  std::vector<double*> GyroBlocks() {
    return {q_MI_.coeffs().data(),
            gyro_intrinsics_.data(),
            knot_0_.data(),
            knot_1_.data(),
            &time_shift_,
            &clock_drift_};
  }

  /// `sample_` and another one of the same span.
  std::vector<JointImuSample> Batch() {
    JointImuSample next = sample_;
    next.t += 0.005;
    next.t_M += 0.005;
    next.place.u += 0.005 / next.place.spacing;
    next.gp.omega_M += Random(0.1);
    next.value = Random(3.0);
    next.bias_u = 0.4;
    next.sigma = 0.03;
    return {sample_, next};
  }

  /// Analytic Jacobians against numeric ones, in the tangent space.
  static void ExpectJacobiansMatch(ceres::CostFunction* cost_function,
                                   const std::vector<double*>& blocks,
                                   int quaternion) {
    const std::unique_ptr<ceres::CostFunction> cost(cost_function);
    ASSERT_EQ(cost->parameter_block_sizes().size(), blocks.size());
    QuaternionManifold manifold;
    std::vector<const Manifold*> manifolds(blocks.size(), nullptr);
    if (quaternion >= 0) manifolds[static_cast<size_t>(quaternion)] = &manifold;
    ceres::NumericDiffOptions options;
    options.ridders_relative_initial_step_size = 1e-4;  // times 32 at first: stays near the span
    const ceres::GradientChecker checker(cost.get(), &manifolds, options);
    ceres::GradientChecker::ProbeResults results;
    checker.Probe(blocks.data(), 1e-6, &results);  // its verdict calls 1e-15 different from 0
    ASSERT_TRUE(results.return_value) << results.error_log;
    for (size_t k = 0; k < blocks.size(); ++k) {
      const auto& J = results.local_jacobians[k];
      EXPECT_LT((J - results.local_numeric_jacobians[k]).norm(), 1e-6 * std::max(1.0, J.norm()))
          << "block " << k << "\n"
          << J << "\nnumeric\n"
          << results.local_numeric_jacobians[k];
    }
  }

  std::mt19937 random_{17};
  std::vector<Vector3d> d_ = std::vector<Vector3d>(kSplineOrder);
  std::vector<Vector3d> phi_ = std::vector<Vector3d>(kSplineOrder);
  JointImuSample sample_;
  Eigen::Quaterniond q_MI_ = Exp<double>(Vector3d(0.3, -1.2, 0.8));
  Vector3d p_MI_{0.1, -0.05, 0.2}, g_W_{0.3, -0.2, -9.8};
  Vector3d knot_0_{0.01, 0.02, -0.01}, knot_1_{-0.02, 0.01, 0.03};
  Vector6d gyro_intrinsics_ = (Vector6d() << 0.02, -0.01, 0.03, 0.01, 0.02, -0.02).finished();
  Vector9d accel_intrinsics_ =
      (Vector9d() << 0.01, 0.02, -0.03, 0.01, -0.02, 0.02, 0.03, -0.01, 0.02).finished();
  double time_shift_ = 0.0213, accel_delay_ = 0.0008, clock_drift_ = 1e-6;
};

TEST_F(JointResiduals, PositionJacobian) {
  ExpectJacobiansMatch(
      CreatePositionResidual({{Vector3d(0.01, 0.02, 0.03), CubicWeights(0.3, 0.03).row(0), 1e-3},
                              {Vector3d(0.01, -0.01, 0.0), CubicWeights(0.6, 0.03).row(0), 2e-3}}),
      Points({&d_}),
      -1);
}

TEST_F(JointResiduals, RotationJacobian) {
  ExpectJacobiansMatch(
      CreateRotationResidual(
          {{Exp<double>(Vector3d(0.3, -0.4, 0.2)), CubicWeights(0.2, 0.03).row(0), 1e-3},
           {Exp<double>(Vector3d(0.1, 0.2, 0.0)), CubicWeights(0.7, 0.03).row(0), 2e-3}}),
      Points({&phi_}),
      -1);
}

TEST_F(JointResiduals, GyroJacobian) {
  for (const double shift : {0.021, 0.0213, 0.015}) {  // at, near and beyond the span of t_M
    time_shift_ = shift;
    std::vector<double*> blocks = Points({&phi_});
    const int quaternion = static_cast<int>(blocks.size());
    for (double* block : GyroBlocks()) blocks.push_back(block);
    ExpectJacobiansMatch(CreateJointGyroResidual(Batch()), blocks, quaternion);
  }
}

TEST_F(JointResiduals, AccelJacobian) {
  for (const double shift : {0.0218, 0.0213, 0.005}) {
    time_shift_ = shift;
    std::vector<double*> blocks = Points({&d_, &phi_});
    const int quaternion = static_cast<int>(blocks.size());
    for (double* block : {q_MI_.coeffs().data(),
                          p_MI_.data(),
                          g_W_.data(),
                          accel_intrinsics_.data(),
                          knot_0_.data(),
                          knot_1_.data(),
                          &time_shift_,
                          &clock_drift_,
                          &accel_delay_})
      blocks.push_back(block);
    ExpectJacobiansMatch(CreateJointAccelResidual(Batch()), blocks, quaternion);
  }
}

TEST_F(JointResiduals, FollowTheDifferentiatedCorrectedRotation) {
  // The gyro residual's model rate against Log(R(t)^T R(t + h)) / h of R_gp(t) Exp(phi(t)).
  sample_.bias_u = 0.0;
  sample_.sigma = 1.0;
  sample_.value.setZero();
  sample_.gp_rate.omega_M = sample_.gp_rate.alpha_M = sample_.gp.alpha_M = Vector3d::Zero();
  const Eigen::Quaterniond identity = Eigen::Quaterniond::Identity();
  const Vector3d zero = Vector3d::Zero();
  const auto rotation = [&](double shift) {
    const double dt = sample_.t + shift - sample_.t_M;
    const SplineWeights w =
        CubicWeights(sample_.place.u + dt / sample_.place.spacing, sample_.place.spacing);
    Vector3d phi = zero;
    for (int j = 0; j < kSplineOrder; ++j) phi += w(0, j) * phi_[static_cast<size_t>(j)];
    return Eigen::Quaterniond(sample_.gp.q_WM * Exp<double>(dt * sample_.gp.omega_M) *
                              Exp<double>(phi));
  };
  std::vector<const double*> blocks;
  for (const Vector3d& point : phi_) blocks.push_back(point.data());
  const Vector6d calibrated = Vector6d::Zero();
  const double no_drift = 0.0;
  for (const double* block : {identity.coeffs().data(),
                              calibrated.data(),
                              zero.data(),
                              zero.data(),
                              static_cast<const double*>(&time_shift_),
                              &no_drift})
    blocks.push_back(block);
  Vector3d residual;
  const std::unique_ptr<ceres::CostFunction> cost(CreateJointGyroResidual({sample_}));
  ASSERT_TRUE(cost->Evaluate(blocks.data(), residual.data(), nullptr));
  const double h = 1e-6;
  const Vector3d rate =
      Log(Eigen::Quaterniond(rotation(time_shift_ - h).conjugate() * rotation(time_shift_ + h))) /
      (2.0 * h);
  EXPECT_LT((-residual - rate).norm(), 1e-6 * rate.norm());
}

TEST_F(JointResiduals, FailFarBeyondTheSpan) {
  time_shift_ = 0.5;
  std::vector<const double*> blocks;
  for (const Vector3d& point : phi_) blocks.push_back(point.data());
  for (const double* block : GyroBlocks()) blocks.push_back(block);
  Vector3d residual;
  const std::unique_ptr<ceres::CostFunction> cost(CreateJointGyroResidual({sample_}));
  EXPECT_FALSE(cost->Evaluate(blocks.data(), residual.data(), nullptr));
}

TEST(CubicWeights, SumToOneAndEachRowIsTheSlopeOfTheOneBefore) {
  const double spacing = 0.03, step = 1e-5;
  for (double u = 0.1; u < 1.0; u += 0.2) {
    const SplineWeights at = CubicWeights(u, spacing);
    EXPECT_NEAR(at.row(0).sum(), 1.0, 1e-14);
    const SplineWeights slope =
        (CubicWeights(u + step, spacing) - CubicWeights(u - step, spacing)) /
        (2.0 * step * spacing);
    for (int k = 0; k < 3; ++k)
      EXPECT_LT((slope.row(k) - at.row(k + 1)).norm(), 1e-6 * at.row(k + 1).norm()) << k;
  }
}

TEST(CubicWeights, AreTwiceContinuousAcrossKnots) {
  const SplineWeights left = CubicWeights(1.0, 0.03), right = CubicWeights(0.0, 0.03);
  for (int k = 0; k < 3; ++k) {
    EXPECT_NEAR(left(k, 0), 0.0, 1e-9);
    for (int j = 0; j + 1 < kSplineOrder; ++j) EXPECT_NEAR(left(k, j + 1), right(k, j), 1e-9);
    EXPECT_NEAR(right(k, kSplineOrder - 1), 0.0, 1e-9);
  }
}

}  // namespace
}  // namespace imu_pose_calib
