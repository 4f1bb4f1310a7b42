#include <gtest/gtest.h>

#include <cmath>
#include <random>
#include <vector>

#include "imu_pose_calib/core/joint_noise.h"

namespace imu_pose_calib {
namespace {

constexpr double kPeriod = 0.01;  // [s]

struct Series {
  std::vector<double> t;
  std::vector<Eigen::Vector3d> x;
};

/// x_k = phi x_(k-1) + e_k with white e of `sigma`; phi = 0: white.
Series Autoregressive(double phi, double sigma, size_t count) {
  std::mt19937 random(5);
  std::normal_distribution<double> normal(0.0, sigma);
  Series s;
  Eigen::Vector3d x = Eigen::Vector3d::Zero();
  for (size_t k = 0; k < count; ++k) {
    x = phi * x + Eigen::Vector3d(normal(random), normal(random), normal(random));
    s.t.push_back(kPeriod * static_cast<double>(k));
    s.x.push_back(x);
  }
  return s;
}

TEST(AllanNoise, IsTheSameAtEveryTimeWhenWhite) {
  const Series s = Autoregressive(0.0, 0.2, 40000);
  for (const double tau : {0.05, 0.2, 1.0})
    EXPECT_NEAR(AllanNoise(s.t, s.x, tau), 0.2, 0.012) << tau;
}

TEST(AllanNoise, DoesNotDependOnRounding) {
  // Steady stamps, and stamps that arrive in bunches of three.
  for (const double bunching : {0.0, 0.3}) {
    Series s = Autoregressive(0.5, 0.2, 20000);
    for (size_t k = 0; k < s.t.size(); ++k)
      s.t[k] -= bunching * kPeriod * static_cast<double>(k % 3);
    for (const double tau : {0.02, 0.05, 0.37, 1.0}) {
      const double noise = AllanNoise(s.t, s.x, tau);
      ASSERT_GT(noise, 0.1) << tau;
      for (const double change : {-1e-6, -1e-9, 1e-9, 1e-6})
        EXPECT_NEAR(AllanNoise(s.t, s.x, tau * (1.0 + change)) / noise, 1.0, 1e-4) << tau;
      for (const double shift : {-7.0 / 3.0, 0.004, 1.0, 12345.678}) {
        std::vector<double> t = s.t;
        for (double& stamp : t) stamp += shift;
        EXPECT_NEAR(AllanNoise(t, s.x, tau) / noise, 1.0, 1e-4) << tau << " " << shift;
      }
    }
  }
}

TEST(AllanNoise, IsUnbiasedForWindowsOfAFewSamples) {
  const Series s = Autoregressive(0.0, 0.2, 100000);
  for (double tau = 0.3 * kPeriod; tau < 5.0 * kPeriod; tau += 0.17 * kPeriod)
    EXPECT_NEAR(AllanNoise(s.t, s.x, tau), 0.2, 0.002) << tau;
}

TEST(AllanNoise, ShowsTheSlowPartOfColouredNoise) {
  const Series s = Autoregressive(0.8, 0.2, 40000);
  // A density of sigma^2 / (1 - phi)^2 at low frequencies.
  EXPECT_NEAR(AllanNoise(s.t, s.x, 1.0), 0.2 / (1.0 - 0.8), 0.08);
  EXPECT_LT(AllanNoise(s.t, s.x, 0.02), 0.5);
}

TEST(AllanNoise, IgnoresOutliers) {
  Series s = Autoregressive(0.0, 0.2, 40000);
  for (size_t k = 0; k < s.x.size(); k += 200) s.x[k] *= 1000.0;
  EXPECT_NEAR(AllanNoise(s.t, s.x, 0.1), 0.2, 0.04);
}

TEST(AllanNoise, ComparesNothingAcrossGaps) {
  // One second of samples, two seconds without, each run with an offset of its own.
  Series s = Autoregressive(0.0, 0.2, 40000), parts;
  for (size_t k = 0; k < s.t.size(); ++k) {
    const auto second = static_cast<int>(std::floor(s.t[k] + 1e-9));
    if (second % 3 != 0) continue;
    parts.t.push_back(s.t[k] + 1e-9);
    parts.x.push_back(s.x[k] + Eigen::Vector3d::Constant(10.0 * second));
  }
  EXPECT_NEAR(AllanNoise(parts.t, parts.x, 0.25), 0.2, 0.02);
  EXPECT_EQ(AllanNoise(parts.t, parts.x, 1.0), 0.0);  // no two means are neighbours
}

TEST(AllanNoise, IsNothingForTooFewMeans) {
  const Series s = Autoregressive(0.0, 0.2, 190);
  EXPECT_EQ(AllanNoise(s.t, s.x, 0.1), 0.0);
  EXPECT_GT(AllanNoise(s.t, s.x, 0.05), 0.0);
  EXPECT_EQ(AllanNoise({}, {}, 0.1), 0.0);
}

}  // namespace
}  // namespace imu_pose_calib
