#include <gtest/gtest.h>

#include <cmath>
#include <random>
#include <vector>

#include "imu_pose_calib/core/base/student_t.h"

namespace imu_pose_calib {
namespace {

/// Vectors of the distribution; 0 degrees of freedom: normal ones.
std::vector<Eigen::Vector3d> Draw(double scale, int dof, size_t count) {
  std::mt19937 random(5);
  std::normal_distribution<double> normal;
  std::vector<Eigen::Vector3d> x;
  for (size_t i = 0; i < count; ++i) {
    double chi2 = 0.0;
    for (int k = 0; k < dof; ++k) chi2 += std::pow(normal(random), 2);
    const double stretch = dof > 0 ? std::sqrt(dof / chi2) : 1.0;
    x.push_back(scale * stretch * Eigen::Vector3d(normal(random), normal(random), normal(random)));
  }
  return x;
}

double MeanWeight(const StudentT& t, const std::vector<Eigen::Vector3d>& x) {
  double sum = 0.0;
  for (const Eigen::Vector3d& v : x) sum += t.Weight(v.squaredNorm());
  return sum / static_cast<double>(x.size());
}

TEST(StudentT, IsNormalForNormalVectors) {
  const StudentT t = FitStudentT(Draw(0.2, 0, 20000));
  EXPECT_NEAR(t.scale, 0.2, 0.003);
  EXPECT_GT(t.dof, 50.0);
  EXPECT_NEAR(t.Weight(0.12), 1.0, 0.05);  // 3 scale^2
}

TEST(StudentT, FindsScaleAndTails) {
  for (const int dof : {2, 4, 8}) {
    const std::vector<Eigen::Vector3d> x = Draw(0.2, dof, 20000);
    const StudentT t = FitStudentT(x);
    EXPECT_NEAR(t.scale, 0.2, 0.008) << dof;
    EXPECT_NEAR(std::log(t.dof / dof), 0.0, 0.25) << dof;
    EXPECT_NEAR(MeanWeight(t, x), 1.0, 0.02) << dof;
  }
}

/// A mean of samples with noise of their own, which makes their leverages: one's weight changes.
TEST(StudentT, IsWhatTheResidualWouldBeAtWeightOne) {
  const Eigen::Vector4d y(0.3, -1.2, 0.8, 2.5), information(1.0, 4.0, 0.5, 2.0);
  const auto residual = [&](double weight) {
    Eigen::Vector4d own = information;
    own[3] *= weight;
    return y[3] - own.dot(y) / own.sum();
  };
  const double leverage = information[3] / information.sum();
  for (const double weight : {0.0, 0.01, 0.3, 2.0})
    EXPECT_NEAR(residual(weight) * ToUsualWeight(leverage, weight), residual(1.0), 1e-14) << weight;
  EXPECT_GT(std::abs(residual(0.01) - residual(1.0)), 0.1);
}

/// Were they of a grid, weights would jump where one value takes over from the next.
TEST(StudentT, DegreesOfFreedomFollowTheTails) {
  const std::vector<Eigen::Vector3d> normal = Draw(1.0, 0, 5000);
  std::vector<double> log_dofs;
  for (int k = 12; k < 38; ++k) {
    std::vector<Eigen::Vector3d> x = normal;
    for (Eigen::Vector3d& v : x) v *= std::pow(v.norm(), 0.025 * k);
    log_dofs.push_back(std::log(FitStudentT(x).dof));
  }
  EXPECT_GT(log_dofs.front() - log_dofs.back(), 1.0);
  for (size_t k = 1; k < log_dofs.size(); ++k) {
    EXPECT_LT(log_dofs[k], log_dofs[k - 1]);
    EXPECT_GT(log_dofs[k], log_dofs[k - 1] - 0.12);
  }
}

TEST(StudentT, HardlySeesOutliers) {
  std::vector<Eigen::Vector3d> x = Draw(0.2, 0, 20000);
  for (size_t i = 0; i < x.size(); i += 100) x[i] *= 1000.0;
  const StudentT t = FitStudentT(x);
  EXPECT_NEAR(t.scale, 0.16, 0.01);  // of heavy tails
  EXPECT_GT(t.Weight(3.0 * 0.2 * 0.2), 0.6);
  EXPECT_LT(t.Weight(std::pow(200.0, 2)), 1e-4);
}

TEST(StudentT, IsOfAsManyVectorsAsThereAre) {
  EXPECT_NEAR(FitStudentT({Eigen::Vector3d(0.1, -0.2, 0.2)}).scale, 0.3 / std::sqrt(3.0), 0.01);
  EXPECT_EQ(FitStudentT({Eigen::Vector3d::Zero(), Eigen::Vector3d::Zero()}).scale, 1e-6);
}

}  // namespace
}  // namespace imu_pose_calib
