#include <gtest/gtest.h>

#include <random>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/verdict/comparison.h"

namespace imu_pose_calib {
namespace {

const std::vector<ComparedQuantity> kAll = {
    ComparedQuantity::kTranslation, ComparedQuantity::kRotation, ComparedQuantity::kAccelDelay,
    ComparedQuantity::kTimeShift};

/// Covariance whose components are correlated within translation and rotation.
Matrix6d Correlated() {
  Eigen::Matrix3d A;
  A << 1.0, 0.0, 0.0, 0.7, 0.6, 0.0, -0.3, 0.2, 1.5;
  Matrix6d covariance = Matrix6d::Zero();
  covariance.topLeftCorner<3, 3>() = 1e-6 * A * A.transpose();
  covariance.bottomRightCorner<3, 3>() = 1e-8 * A.transpose() * A;
  return covariance;
}

Comparable Example() {
  Comparable calibration;
  calibration.T_MI = {Exp(Eigen::Vector3d(0.7, -0.4, 1.9)), {0.1, -0.2, 0.3}};
  calibration.covariance = Correlated();
  calibration.accel_delay = 0.003;
  calibration.accel_delay_std = 1e-5;
  calibration.time_shift = -1034771.5;
  calibration.time_shift_std = 2e-5;
  return calibration;
}

TEST(Comparison, OfTheSameIsNone) {
  const Comparison comparison = Compare(Example(), Example(), kAll);
  ASSERT_EQ(comparison.components.size(), 8u);
  EXPECT_EQ(comparison.dof, 8);
  EXPECT_EQ(comparison.chi2, 0.0);
  EXPECT_EQ(comparison.Worst()->sigmas, 0.0);
}

TEST(Comparison, SaysSecondLessFirstAndTheSigmaOfBoth) {
  const Comparable first = Example();
  Comparable second = first;
  second.T_MI.p += Eigen::Vector3d(0.001, -0.002, 0.003);
  second.T_MI.q = first.T_MI.q * Exp(Eigen::Vector3d(0.01, 0.0, -0.02));
  second.covariance *= 3.0;
  second.accel_delay += 1e-4;
  second.time_shift += 5e-4;
  second.time_shift_std = 0.0;  // given
  const Comparison comparison = Compare(first, second, kAll);
  const Eigen::Matrix3d C_p = first.covariance.topLeftCorner<3, 3>();
  EXPECT_NEAR(comparison.components[1].value, -0.002, 1e-15);
  EXPECT_NEAR(comparison.components[1].sigma, 2.0 * std::sqrt(C_p(1, 1)), 1e-12);
  EXPECT_NEAR(comparison.components[3].value, 0.01, 1e-12);
  EXPECT_NEAR(comparison.components[5].value, -0.02, 1e-12);
  EXPECT_EQ(comparison.components[5].axis, 2);
  EXPECT_NEAR(comparison.components[6].value, 1e-4, 1e-15);
  EXPECT_NEAR(comparison.components[6].sigma, std::sqrt(2.0) * 1e-5, 1e-15);
  EXPECT_NEAR(comparison.components[7].value, 5e-4, 1e-9);
  EXPECT_NEAR(comparison.components[7].sigma, 2e-5, 1e-15);
  EXPECT_NEAR(comparison.components[7].sigmas, 25.0, 1e-4);
  EXPECT_NEAR(comparison.distance, std::sqrt(14.0) * 1e-3, 1e-12);
  EXPECT_NEAR(comparison.angle, std::hypot(0.01, 0.02), 1e-12);
}

/// A small turn of the IMU's axes says the same whichever of the two is first.
TEST(Comparison, TakesCovariancesOfRotationsInOneFrame) {
  Comparable first = Example(), second = first;
  first.covariance.setZero();
  second.T_MI.q =
      first.T_MI.q * Exp(Eigen::Vector3d(0.0, 0.0, M_PI / 2));  // x of second is y of first
  second.covariance.bottomRightCorner<3, 3>() = Eigen::Vector3d(1e-8, 4e-8, 9e-8).asDiagonal();
  const Comparison comparison = Compare(first, second, {ComparedQuantity::kRotation});
  EXPECT_NEAR(comparison.components[0].sigma, 2e-4, 1e-12);
  EXPECT_NEAR(comparison.components[1].sigma, 1e-4, 1e-12);
  EXPECT_NEAR(comparison.components[2].sigma, 3e-4, 1e-12);
}

TEST(Comparison, JudgesNothingThatIsNotEstimated) {
  Comparable first = Example(), second = first;
  first.covariance.setZero();
  second.covariance.setZero();
  second.T_MI.p.x() += 1.0;
  const Comparison comparison = Compare(first, second, {ComparedQuantity::kTranslation});
  EXPECT_EQ(comparison.Worst(), nullptr);
  EXPECT_EQ(comparison.dof, 0);
  EXPECT_EQ(comparison.components[0].value, 1.0);
}

/// Calibrations that scatter as their covariances say.
std::vector<Comparable> Draw(size_t count, uint32_t seed, double scale) {
  std::mt19937 generator(seed);
  std::normal_distribution<double> normal;
  const Comparable truth = Example();
  std::vector<Comparable> drawn;
  for (size_t i = 0; i < count; ++i) {
    Comparable one = truth;
    const double size = 1.0 + static_cast<double>(i % 3);  // some are better than others
    one.covariance *= size * size;
    one.accel_delay_std *= size;
    one.time_shift_std *= size;
    Vector6d noise;
    for (int k = 0; k < 6; ++k) noise[k] = normal(generator);
    const Matrix6d root = one.covariance.llt().matrixL();
    const Vector6d error = scale * root * noise;
    one.T_MI.p += error.head<3>();
    one.T_MI.q = one.T_MI.q * Exp(Eigen::Vector3d(error.tail<3>()));
    one.accel_delay += scale * one.accel_delay_std * normal(generator);
    one.time_shift += scale * one.time_shift_std * normal(generator);
    drawn.push_back(one);
  }
  return drawn;
}

TEST(Repeatability, ChiSquareIsThatOfTheScatter) {
  Eigen::Vector4d chi2 = Eigen::Vector4d::Zero(), dof = chi2;
  double covered = 0.0;
  const int trials = 200;
  for (uint32_t seed = 0; seed < trials; ++seed) {
    const Repeatability repeatability = Repeat(Draw(6, seed, 1.0), kAll);
    ASSERT_EQ(repeatability.scatters.size(), 4u);
    for (Eigen::Index k = 0; k < 4; ++k) {
      chi2[k] += repeatability.scatters[static_cast<size_t>(k)].chi2;
      dof[k] += repeatability.scatters[static_cast<size_t>(k)].dof;
    }
    covered += Compare(Example(), repeatability.mean, {ComparedQuantity::kTranslation}).chi2;
  }
  EXPECT_EQ(dof, Eigen::Vector4d(15.0, 15.0, 5.0, 5.0) * trials);
  for (Eigen::Index k = 0; k < 4; ++k)
    EXPECT_NEAR(chi2[k] / dof[k], 1.0, 4.0 * std::sqrt(2.0 / dof[k])) << k;
  // The truth's own covariance is in the comparison, so less than 3 a trial.
  EXPECT_LT(covered / trials, 3.0);
}

TEST(Repeatability, ScatterBeyondTheSigmasShows) {
  const Repeatability repeatability = Repeat(Draw(12, 5, 4.0), kAll);
  for (const Scatter& scatter : repeatability.scatters) {
    EXPECT_GT(scatter.chi2 / scatter.dof, 5.0) << ToString(scatter.quantity);
    for (Eigen::Index k = 0; k < scatter.deviation.size(); ++k)
      EXPECT_GT(scatter.deviation[k], 2.0 * scatter.sigma[k]);
  }
}

TEST(Repeatability, TheOddOneStandsOutFromTheOthers) {
  std::vector<Comparable> calibrations = Draw(5, 7, 1.0);
  calibrations[3].T_MI.q = calibrations[3].T_MI.q * Exp(Eigen::Vector3d(0.0, 0.01, 0.0));
  const Repeatability repeatability = Repeat(calibrations, kAll);
  ASSERT_EQ(repeatability.from_others.size(), 5u);
  const Difference* odd = repeatability.from_others[3].Worst();
  EXPECT_EQ(odd->quantity, ComparedQuantity::kRotation);
  EXPECT_EQ(odd->axis, 1);
  EXPECT_GT(odd->value, 0.009);
  for (const size_t other : {0u, 1u, 2u, 4u})
    EXPECT_LT(repeatability.from_others[other].Worst()->sigmas, odd->sigmas);
}

TEST(Repeatability, MeanWeighsByInverseVariance) {
  Comparable good = Example(), bad = good;
  good.covariance = Matrix6d::Identity() * 1e-8;
  bad.covariance = Matrix6d::Identity() * 3e-8;
  bad.T_MI.p.x() += 0.004;
  bad.T_MI.q = good.T_MI.q * Exp(Eigen::Vector3d(0.0, 0.0, 0.008));
  bad.time_shift += 0.004;
  bad.time_shift_std = good.time_shift_std;
  const Comparable mean = Mean({good, bad});
  EXPECT_NEAR(mean.T_MI.p.x(), good.T_MI.p.x() + 0.001, 1e-12);
  EXPECT_NEAR(mean.covariance(0, 0), 0.75e-8, 1e-15);
  EXPECT_NEAR(Log(Eigen::Quaterniond(good.T_MI.q.conjugate() * mean.T_MI.q)).z(), 0.002, 1e-9);
  EXPECT_NEAR(mean.time_shift, good.time_shift + 0.002, 1e-9);
  EXPECT_NEAR(mean.time_shift_std, good.time_shift_std / std::sqrt(2.0), 1e-12);
}

}  // namespace
}  // namespace imu_pose_calib
