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
    at_.gp.q_WM = Exp<double>(Random(1.0));
    at_.gp.omega_M = Random(2.0);
    at_.gp.alpha_M = Random(8.0);
    at_.gp.p_WM = Random(1.0);
    at_.gp.v_W = Random(1.0);
    at_.gp.a_W = Random(5.0);
    at_.place = {0, 0.4, 0.03};
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

  /// Two poses of one span, close to the trajectory.
  std::vector<JointPoseSample> Poses() {
    std::vector<JointPoseSample> poses;
    for (const double u : {0.4, 0.7}) {
      at_.place.u = u;
      const Eigen::Quaterniond q_WM = at_.gp.q_WM * Exp<double>(Random(0.5));
      const Vector3d p_WM = at_.gp.p_WM + Random(0.01);
      poses.push_back({at_, q_WM, p_WM, 0.0213, 1e-6, 0.0008, -0.5, 0.01});
    }
    return poses;
  }

  /// Two IMU samples of one span.
  std::vector<JointImuSample> Imu() {
    JointImuSample sample{at_, Random(3.0), 0.3, 0.0008, 0.05};
    JointImuSample next{at_, Random(3.0), 0.4, 0.0008, 0.03};
    next.at.place.u += 0.2;
    next.at.gp.omega_M += Random(0.1);
    return {sample, next};
  }

  std::vector<double*> PoseBlocks(std::vector<Vector3d>* spline) {
    std::vector<double*> blocks = Points({spline});
    for (double* block : {&time_shift_, &clock_drift_, &accel_delay_, &pose_smoothing_})
      blocks.push_back(block);
    return blocks;
  }

  std::vector<double*> GyroBlocks() {
    std::vector<double*> blocks = Points({&phi_});
    for (double* block : {q_MI_.coeffs().data(),
                          gyro_intrinsics_.data(),
                          knot_0_.data(),
                          knot_1_.data(),
                          &accel_delay_})
      blocks.push_back(block);
    return blocks;
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
  TrajectoryPoint at_;
  Eigen::Quaterniond q_MI_ = Exp<double>(Vector3d(0.3, -1.2, 0.8));
  Vector3d p_MI_{0.1, -0.05, 0.2}, g_W_{0.3, -0.2, -9.8};
  Vector3d knot_0_{0.01, 0.02, -0.01}, knot_1_{-0.02, 0.01, 0.03};
  Vector6d gyro_intrinsics_ = (Vector6d() << 0.02, -0.01, 0.03, 0.01, 0.02, -0.02).finished();
  Vector9d accel_intrinsics_ =
      (Vector9d() << 0.01, 0.02, -0.03, 0.01, -0.02, 0.02, 0.03, -0.01, 0.02).finished();
  double time_shift_ = 0.0213, accel_delay_ = 0.0008, clock_drift_ = 1e-6;
  double pose_smoothing_ = 3e-4;
};

TEST_F(JointResiduals, PositionJacobian) {
  for (const double shift : {0.0213, 0.021, 0.005}) {  // at, near and beyond the span of the sample
    time_shift_ = shift;
    ExpectJacobiansMatch(CreateJointPositionResidual(Poses()), PoseBlocks(&d_), -1);
  }
}

TEST_F(JointResiduals, RotationJacobian) {
  for (const double shift : {0.0213, 0.021, 0.005}) {
    time_shift_ = shift;
    ExpectJacobiansMatch(CreateJointRotationResidual(Poses()), PoseBlocks(&phi_), -1);
  }
}

TEST_F(JointResiduals, GyroJacobian) {
  for (const double delay : {0.0008, 0.0011, 0.017}) {
    accel_delay_ = delay;
    ExpectJacobiansMatch(CreateJointGyroResidual(Imu()), GyroBlocks(), kSplineOrder);
  }
}

TEST_F(JointResiduals, AccelJacobian) {
  std::vector<double*> blocks = Points({&d_, &phi_});
  for (double* block : {q_MI_.coeffs().data(),
                        p_MI_.data(),
                        g_W_.data(),
                        accel_intrinsics_.data(),
                        knot_0_.data(),
                        knot_1_.data()})
    blocks.push_back(block);
  ExpectJacobiansMatch(CreateJointAccelResidual(Imu()), blocks, 2 * kSplineOrder);
}

TEST_F(JointResiduals, FollowTheDifferentiatedCorrectedRotation) {
  // The gyro residual's model rate against Log(R(tau - h)^T R(tau + h)) / 2h of R_gp Exp(phi).
  at_.gp.alpha_M = Vector3d::Zero();
  const auto rotation = [&](double dt) {
    const SplineWeights w = CubicWeights(at_.place.u + dt / at_.place.spacing, at_.place.spacing);
    Vector3d phi = Vector3d::Zero();
    for (int j = 0; j < kSplineOrder; ++j) phi += w(0, j) * phi_[static_cast<size_t>(j)];
    return Eigen::Quaterniond(at_.gp.q_WM * Exp<double>(dt * at_.gp.omega_M) * Exp<double>(phi));
  };
  q_MI_.setIdentity();
  knot_0_ = knot_1_ = Vector3d::Zero();
  gyro_intrinsics_.setZero();
  Vector3d residual;
  const std::unique_ptr<ceres::CostFunction> cost(
      CreateJointGyroResidual({{at_, Vector3d::Zero(), 0.0, 0.0, 1.0}}));
  ASSERT_TRUE(cost->Evaluate(GyroBlocks().data(), residual.data(), nullptr));
  const double h = 1e-6;
  const Vector3d rate =
      Log(Eigen::Quaterniond(rotation(accel_delay_ - h).conjugate() * rotation(accel_delay_ + h))) /
      (2.0 * h);
  EXPECT_LT((-residual - rate).norm(), 1e-6 * rate.norm());
}

TEST_F(JointResiduals, PosesMoveWithTheClocks) {
  // A pose that is stamped later by what the time shift grows is the same pose.
  const std::unique_ptr<ceres::CostFunction> cost(CreateJointPositionResidual(Poses()));
  std::vector<double> before(6), after(6);
  ASSERT_TRUE(cost->Evaluate(PoseBlocks(&d_).data(), before.data(), nullptr));
  time_shift_ += 0.002;
  accel_delay_ += 0.002;
  ASSERT_TRUE(cost->Evaluate(PoseBlocks(&d_).data(), after.data(), nullptr));
  for (size_t i = 0; i < before.size(); ++i) EXPECT_NEAR(after[i], before[i], 1e-9);
}

TEST_F(JointResiduals, FailFarBeyondTheSpan) {
  time_shift_ = accel_delay_ = 0.5;
  Vector3d residual[2];
  const std::unique_ptr<ceres::CostFunction> gyro(CreateJointGyroResidual(Imu()));
  EXPECT_FALSE(gyro->Evaluate(GyroBlocks().data(), residual[0].data(), nullptr));
  accel_delay_ = 0.0;
  const std::unique_ptr<ceres::CostFunction> position(CreateJointPositionResidual(Poses()));
  EXPECT_FALSE(position->Evaluate(PoseBlocks(&d_).data(), residual[0].data(), nullptr));
  const std::unique_ptr<ceres::CostFunction> rotation(CreateJointRotationResidual(Poses()));
  EXPECT_FALSE(rotation->Evaluate(PoseBlocks(&phi_).data(), residual[0].data(), nullptr));
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
