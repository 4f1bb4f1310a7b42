#include <ceres/gradient_checker.h>
#include <gtest/gtest.h>

#include <cmath>
#include <memory>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibration/estimate.h"
#include "imu_pose_calib/core/calibration/residuals.h"
#include "imu_pose_calib/core/solver/problem.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using Eigen::Quaterniond;
using Eigen::Vector3d;

/// Noise-free recording of 8 s with its trajectory; the clocks are 0.02 s apart.
class Residuals : public ::testing::Test {
 protected:
  static void SetUpTestSuite() {
    SimulatorOptions options;
    options.duration_s = 8.0;
    options.motion = Motion::kTumble;
    options.accel_delay_s = 0.004;
    options = WithoutNoise(options);
    truth_ = new SimulatorOptions(options);
    CalibrationOptions calibration;
    data_ = new ConditionedData(ConditionData(calibration, Simulate(options)));
    trajectory_ = new PoseTrajectory(FitTrajectory(calibration, data_));
  }
  static void TearDownTestSuite() {
    delete trajectory_;
    delete data_;
    delete truth_;
  }

  Residuals()
      : q_MI(truth_->T_MI.q),
        p_MI(truth_->T_MI.p),
        g_W(truth_->g_W),
        time_shift(truth_->time_shift_s -
                   1e-9 * static_cast<double>(data_->pose_epoch_ns - data_->imus[0].epoch_ns)),
        accel_delay(truth_->accel_delay_s) {}

  std::vector<double*> GyroBlocks() {
    return {q_MI.coeffs().data(), knot_0.data(), knot_1.data(), &time_shift};
  }
  std::vector<double*> AccelBlocks() {
    return {q_MI.coeffs().data(), p_MI.data(), g_W.data(),  knot_0.data(),
            knot_1.data(),        &time_shift, &accel_delay};
  }
  static GyroResidual Gyro(size_t i, double sigma) {
    return {trajectory_, data_->imus[0].gyro[i].t, data_->imus[0].gyro[i].value, 0.3, sigma};
  }
  static AccelResidual Accel(size_t i, double sigma) {
    return {trajectory_, data_->imus[0].accel[i].t, data_->imus[0].accel[i].value, 0.3, sigma};
  }

  /// Value of a residual at the parameters of this test.
  template <typename Residual>
  static Vector3d Value(const Residual& residual, const std::vector<double*>& blocks) {
    const std::unique_ptr<ceres::CostFunction> cost(residual.Create());
    Vector3d r = Vector3d::Constant(std::nan(""));
    EXPECT_TRUE(cost->Evaluate(blocks.data(), r.data(), nullptr));
    return r;
  }

  static SimulatorOptions* truth_;
  static ConditionedData* data_;
  static PoseTrajectory* trajectory_;

  Quaterniond q_MI;
  Vector3d p_MI, g_W;
  Vector3d knot_0 = Vector3d::Zero(), knot_1 = Vector3d::Zero();
  double time_shift, accel_delay;
};
SimulatorOptions* Residuals::truth_ = nullptr;
ConditionedData* Residuals::data_ = nullptr;
PoseTrajectory* Residuals::trajectory_ = nullptr;

/// Of numeric derivatives: by Ridders' method, and by central differences in Ceres 1.14.
constexpr double kNumericError = IMU_POSE_CALIB_CERES_HAS_MANIFOLDS ? 1e-8 : 1e-6;

/// Compares autodiff with numeric derivatives in the tangent space.
void ExpectGradientsAgree(const ceres::CostFunction& cost,
                          const std::vector<const Manifold*>* manifolds,
                          const std::vector<double*>& blocks) {
  const ceres::GradientChecker checker(&cost, manifolds, ceres::NumericDiffOptions());
  ceres::GradientChecker::ProbeResults results;
  checker.Probe(blocks.data(), 1e-6, &results);  // its verdict calls 1e-15 different from 0
  ASSERT_TRUE(results.return_value) << results.error_log;
  for (size_t k = 0; k < blocks.size(); ++k) {
    const auto& J = results.local_jacobians[k];
    ASSERT_GT(J.size(), 0);
    EXPECT_LT((J - results.local_numeric_jacobians[k]).norm(),
              kNumericError * std::max(1.0, J.norm()))
        << "block " << k << "\n"
        << results.error_log;
  }
}

/// Norm of the change of a residual when coordinate i of a block moves by `step`.
template <typename Residual>
double Change(const Residual& residual, const std::vector<double*>& blocks, double* coordinate,
              double step) {
  const std::unique_ptr<ceres::CostFunction> cost(residual.Create());
  const double saved = *coordinate;
  Vector3d before, after;
  cost->Evaluate(blocks.data(), before.data(), nullptr);
  *coordinate = saved + step;
  cost->Evaluate(blocks.data(), after.data(), nullptr);
  *coordinate = saved;
  return (after - before).norm();
}

TEST_F(Residuals, GyroIsZeroAtTheTruth) {
  for (size_t i = 60; i < data_->imus[0].gyro.size() - 60; i += 23)
    EXPECT_LT(Value(Gyro(i, 1.0), GyroBlocks()).norm(), 1e-3) << i;
}

TEST_F(Residuals, AccelIsZeroAtTheTruth) {
  for (size_t i = 60; i < data_->imus[0].accel.size() - 60; i += 23)
    EXPECT_LT(Value(Accel(i, 1.0), AccelBlocks()).norm(), 5e-3) << i;
}

TEST_F(Residuals, AreTheEquationsInSigmaForArbitraryValues) {
  q_MI = Quaterniond(0.3, -0.2, 0.7, 0.1).normalized();
  p_MI << 0.3, -0.5, 0.2;
  g_W << 1.0, -2.0, -9.0;
  knot_0 << 0.1, 0.2, -0.3;
  knot_1 << -0.2, 0.4, 0.5;
  time_shift += 0.37;
  accel_delay = 0.11;
  const Vector3d b = 0.7 * knot_0 + 0.3 * knot_1;
  MarkerState<double> s;
  const GyroResidual gyro = Gyro(500, 0.25);
  ASSERT_TRUE(trajectory_->Evaluate(gyro.t + time_shift, &s));
  const Vector3d r_gyro = (gyro.w - b - q_MI.conjugate() * s.omega_M) / 0.25;
  EXPECT_LT((Value(gyro, GyroBlocks()) - r_gyro).norm(), 1e-12);

  const AccelResidual accel = Accel(600, 0.5);
  ASSERT_TRUE(trajectory_->Evaluate(accel.t + time_shift - accel_delay, &s));
  // The matrix of the lever arm, written out another way than the residual does.
  const Eigen::Matrix3d lever = Hat(s.alpha_M) + s.omega_M * s.omega_M.transpose() -
                                s.omega_M.squaredNorm() * Eigen::Matrix3d::Identity();
  const Vector3d f_M = s.q_WM.toRotationMatrix().transpose() * (s.a_W - g_W) + lever * p_MI;
  const Vector3d r_accel = (accel.f - b - q_MI.toRotationMatrix().transpose() * f_M) / 0.5;
  EXPECT_LT((Value(accel, AccelBlocks()) - r_accel).norm(), 1e-10);
}

TEST_F(Residuals, EveryParameterMatters) {
  const GyroResidual gyro = Gyro(700, 1.0);
  const AccelResidual accel = Accel(700, 1.0);
  // Step of each block [its unit] and the change that it must cause at least.
  for (int i = 0; i < 4; ++i) {
    EXPECT_GT(Change(gyro, GyroBlocks(), &q_MI.coeffs()[i], 0.1), 0.05) << "q_MI " << i;
    EXPECT_GT(Change(accel, AccelBlocks(), &q_MI.coeffs()[i], 0.1), 0.05) << "q_MI " << i;
  }
  for (int i = 0; i < 3; ++i) {
    EXPECT_NEAR(Change(gyro, GyroBlocks(), &knot_0[i], 0.1), 0.07, 1e-12);
    EXPECT_NEAR(Change(gyro, GyroBlocks(), &knot_1[i], 0.1), 0.03, 1e-12);
    EXPECT_NEAR(Change(accel, AccelBlocks(), &knot_0[i], 0.1), 0.07, 1e-12);
    EXPECT_NEAR(Change(accel, AccelBlocks(), &knot_1[i], 0.1), 0.03, 1e-12);
    EXPECT_GT(Change(accel, AccelBlocks(), &p_MI[i], 0.1), 0.05) << "p_MI " << i;
    EXPECT_NEAR(Change(accel, AccelBlocks(), &g_W[i], 0.1), 0.1, 1e-9) << "g_W " << i;
  }
  EXPECT_GT(Change(gyro, GyroBlocks(), &time_shift, 0.01), 0.01);
  EXPECT_GT(Change(accel, AccelBlocks(), &time_shift, 0.01), 0.01);
  EXPECT_GT(Change(accel, AccelBlocks(), &accel_delay, 0.01), 0.01);
}

TEST_F(Residuals, GyroHasExactDerivatives) {
  const QuaternionManifold quaternion;
  const std::vector<const Manifold*> manifolds = {&quaternion, nullptr, nullptr, nullptr};
  knot_0 << 0.01, 0.02, -0.03;
  for (size_t i = 250; i < 1350; i += 193) {  // far from the ends: numeric steps start long
    SCOPED_TRACE(i);
    const std::unique_ptr<ceres::CostFunction> cost(Gyro(i, 1.0).Create());
    ExpectGradientsAgree(*cost, &manifolds, GyroBlocks());
  }
}

TEST_F(Residuals, AccelHasExactDerivatives) {
  const QuaternionManifold quaternion;
  const std::vector<const Manifold*> manifolds = {&quaternion, nullptr, nullptr, nullptr,
                                                  nullptr,     nullptr, nullptr};
  knot_1 << 0.1, 0.2, -0.3;
  for (size_t i = 250; i < 1350; i += 193) {  // far from the ends: numeric steps start long
    SCOPED_TRACE(i);
    const std::unique_ptr<ceres::CostFunction> cost(Accel(i, 1.0).Create());
    ExpectGradientsAgree(*cost, &manifolds, AccelBlocks());
  }
}

TEST_F(Residuals, DerivativesByTimeAreTheSlopesAndOpposite) {
  const std::unique_ptr<ceres::CostFunction> cost(Accel(800, 1.0).Create());
  std::vector<double*> blocks = AccelBlocks();
  Vector3d r, by_shift, by_delay;
  double* jacobians[] = {nullptr, nullptr,         nullptr,        nullptr,
                         nullptr, by_shift.data(), by_delay.data()};
  ASSERT_TRUE(cost->Evaluate(blocks.data(), r.data(), jacobians));
  const auto at_shift = [&](double shift) {
    blocks[5] = &shift;
    Vector3d moved;
    EXPECT_TRUE(cost->Evaluate(blocks.data(), moved.data(), nullptr));
    return moved;
  };
  EXPECT_LT((by_shift - NumericRate(at_shift, time_shift, 1e-4)).norm(), 1e-5 * by_shift.norm());
  EXPECT_LT((by_shift + by_delay).norm(), 1e-12 * by_shift.norm());
  EXPECT_GT(by_shift.norm(), 1.0);  // [m/s^3]
}

TEST_F(Residuals, FailOutsideOfTheTrajectory) {
  const std::unique_ptr<ceres::CostFunction> gyro(Gyro(100, 1.0).Create());
  const std::unique_ptr<ceres::CostFunction> accel(Accel(100, 1.0).Create());
  Vector3d r;
  EXPECT_TRUE(gyro->Evaluate(GyroBlocks().data(), r.data(), nullptr));
  EXPECT_TRUE(accel->Evaluate(AccelBlocks().data(), r.data(), nullptr));
  const double inside = time_shift;
  for (const double off : {-100.0, -1.0, 8.0, 100.0}) {
    time_shift = inside + off;
    EXPECT_FALSE(gyro->Evaluate(GyroBlocks().data(), r.data(), nullptr)) << off;
    EXPECT_FALSE(accel->Evaluate(AccelBlocks().data(), r.data(), nullptr)) << off;
  }
  time_shift = inside;
  accel_delay = 1.0;
  EXPECT_FALSE(accel->Evaluate(AccelBlocks().data(), r.data(), nullptr));
}

TEST(WalkResidual, IsTheStepInSigmaWithExactDerivatives) {
  const std::unique_ptr<ceres::CostFunction> cost(WalkResidual<3>{0.2}.Create());
  Vector3d knot_0(1.0, 2.0, 3.0), knot_1(1.1, 1.8, 3.0), r;
  const std::vector<double*> blocks = {knot_0.data(), knot_1.data()};
  ASSERT_TRUE(cost->Evaluate(blocks.data(), r.data(), nullptr));
  EXPECT_LT((r - Vector3d(0.5, -1.0, 0.0)).norm(), 1e-14);
  const std::vector<const Manifold*> manifolds = {nullptr, nullptr};
  ExpectGradientsAgree(*cost, &manifolds, blocks);
}

TEST(WalkResidual, OfADecayIsWhatIsNewInSigmaWithExactDerivatives) {
  const std::unique_ptr<ceres::CostFunction> cost(WalkResidual<3>{0.2, 0.8}.Create());
  const Eigen::Vector3d knot_0(1.0, 2.0, 3.0), knot_1(1.2, 1.5, 3.3);
  const double* knots[] = {knot_0.data(), knot_1.data()};
  Eigen::Vector3d residual;
  Eigen::Matrix<double, 3, 3, Eigen::RowMajor> by_0, by_1;
  double* jacobians[] = {by_0.data(), by_1.data()};
  ASSERT_TRUE(cost->Evaluate(knots, residual.data(), jacobians));
  EXPECT_NEAR((residual - Eigen::Vector3d(2.0, -0.5, 4.5)).norm(), 0.0, 1e-12);
  EXPECT_NEAR((by_0 + 4.0 * Eigen::Matrix3d::Identity()).norm(), 0.0, 1e-12);
  EXPECT_NEAR((by_1 - 5.0 * Eigen::Matrix3d::Identity()).norm(), 0.0, 1e-12);
}

TEST(JerkResidual, IsTheThirdDifferenceInSigmaWithExactDerivatives) {
  const std::unique_ptr<ceres::CostFunction> cost(JerkResidual{0.1}.Create());
  // Of a parabola, a cubic and what swings from one point to the next.
  Vector3d points[] = {{0.0, 0.0, 1.0}, {1.0, 1.0, -1.0}, {4.0, 8.0, 1.0}, {9.0, 27.0, -1.0}}, r;
  const std::vector<double*> blocks = {points[0].data(), points[1].data(), points[2].data(),
                                       points[3].data()};
  ASSERT_TRUE(cost->Evaluate(blocks.data(), r.data(), nullptr));
  EXPECT_LT((r - Vector3d(0.0, 60.0, -80.0)).norm(), 1e-12);
  const std::vector<const Manifold*> manifolds(4, nullptr);
  ExpectGradientsAgree(*cost, &manifolds, blocks);
}

TEST(WalkResidual, OfAClockHasOneRow) {
  const std::unique_ptr<ceres::CostFunction> cost(WalkResidual<1>{1e-3}.Create());
  double knot_0 = 2e-3, knot_1 = 5e-3, r;
  const std::vector<double*> blocks = {&knot_0, &knot_1};
  ASSERT_TRUE(cost->Evaluate(blocks.data(), &r, nullptr));
  EXPECT_NEAR(r, 3.0, 1e-12);
  const std::vector<const Manifold*> manifolds = {nullptr, nullptr};
  ExpectGradientsAgree(*cost, &manifolds, blocks);
}

TEST(GravityPrior, IsTheExcessInSigmaWithExactDerivatives) {
  const std::unique_ptr<ceres::CostFunction> cost(GravityPrior{9.8, 0.03}.Create());
  Vector3d g_W = 9.86 * Vector3d(0.3, -0.4, -2.0).normalized();
  double r;
  const std::vector<double*> blocks = {g_W.data()};
  ASSERT_TRUE(cost->Evaluate(blocks.data(), &r, nullptr));
  EXPECT_NEAR(r, 2.0, 1e-9);
  const std::vector<const Manifold*> manifolds = {nullptr};
  ExpectGradientsAgree(*cost, &manifolds, blocks);
}

std::vector<TimedSample> SamplesAt(const std::vector<double>& times) {
  std::vector<TimedSample> samples;
  for (const double t : times) samples.push_back({t, Vector3d::Zero()});
  return samples;
}

TEST(BiasKnots, AreEquidistantOverTheSamplesAndNotFurtherApartThanAsked) {
  const Vector3d initial(1.0, 2.0, 3.0);
  const BiasKnots knots(SamplesAt({2.0, 5.0, 14.0}), 5.0, initial);
  ASSERT_EQ(knots.t.size(), 4u);
  ASSERT_EQ(knots.values.size(), 4u);
  for (size_t k = 0; k < 4; ++k) {
    EXPECT_DOUBLE_EQ(knots.t[k], 2.0 + 4.0 * static_cast<double>(k));
    EXPECT_EQ(knots.values[k], initial);
  }
  EXPECT_EQ(knots.Mean(), initial);
  EXPECT_EQ(BiasKnots(SamplesAt({0.0, 1.0}), 5.0, initial).t.size(), 2u);
}

TEST(BiasKnots, LocateInterpolatesBetweenKnots) {
  BiasKnots knots(SamplesAt({0.0, 10.0}), 5.0, Vector3d::Zero());
  const auto expect_at = [&knots](double t, size_t k, double u) {
    const auto place = knots.Locate(t);
    EXPECT_EQ(place.first, k) << t;
    EXPECT_NEAR(place.second, u, 1e-12) << t;
  };
  expect_at(0.0, 0, 0.0);
  expect_at(2.0, 0, 0.4);
  expect_at(5.0, 1, 0.0);
  expect_at(7.5, 1, 0.5);
  expect_at(10.0, 1, 1.0);
  expect_at(-3.0, 0, 0.0);
  expect_at(13.0, 1, 1.0);
}

TEST(BiasKnots, CanSitAtEverySample) {
  const std::vector<double> times = {0.0, 0.01, 0.03, 0.031, 0.05};
  const BiasKnots knots(SamplesAt(times), 0.0, Vector3d::Zero());
  EXPECT_EQ(knots.t, times);
  for (size_t i = 0; i < times.size(); ++i) {
    const auto place = knots.Locate(times[i]);
    ASSERT_LT(place.first, times.size() - 1);
    // The bias at a sample is the value of its own knot.
    EXPECT_NEAR(static_cast<double>(place.first) + place.second, static_cast<double>(i), 1e-12);
  }
}

}  // namespace
}  // namespace imu_pose_calib
