#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "imu_pose_calib/core/calibration/priors.h"

namespace imu_pose_calib {
namespace {

using Eigen::MatrixXd;
using Eigen::VectorXd;

/// A rig of one IMU and what is calibrated of it that has a peak.
struct Rig {
  Estimate estimate;
  std::vector<Parameter> parameters;
  Eigen::Index n = 0;

  explicit Rig(const std::vector<ParameterKind>& kinds) {
    estimate.imus.resize(1);
    for (const Parameter& p : CalibrationParameters(&estimate))
      for (const ParameterKind kind : kinds)
        if (p.kind == kind) {
          parameters.push_back(p);
          n += p.size;
        }
    estimate.peaks = FirstPeaks(estimate, parameters);
  }

  /// Mean and covariance with the factor that is found where all else says that the parameters are
  /// Gaussian with this mean and covariance.
  void Solve(const VectorXd& mean, const MatrixXd& covariance, VectorXd* found, MatrixXd* own) {
    const MatrixXd rest = covariance.inverse();
    for (int pass = 0; pass < 2; ++pass) {
      const GaussianFactor& peaks = estimate.peaks;
      *own = (rest + peaks.A.transpose() * peaks.A).inverse();
      *found = *own * (rest * mean + peaks.A.transpose() * peaks.b);
      Eigen::Index next = 0;
      for (const Parameter& p : parameters)
        for (int k = 0; k < p.size; ++k) p.data[k] = (*found)[next++];
      if (pass == 0) estimate.peaks = MatchPeaks(estimate, parameters, *own);
    }
  }
};

/// Density of the prior of the documentation, but for a constant.
double Prior(double x, double peak) {
  double sum = 0.0;
  for (int k = 0; k < 4; ++k) {
    const double sigma = std::pow(10.0, k) * peak;
    sum += std::pow(10.0, -k) / sigma * std::exp(-0.5 * x * x / (sigma * sigma));
  }
  return sum;
}

TEST(Peaks, AreIntegratedOver) {
  Rig rig({ParameterKind::kPoseSmoothing});
  const double w = kSmoothingPeak;
  // Wide, at and off the peak; between spike and tail; far out.
  for (const auto& [mean, std] : std::vector<std::pair<double, double>>{
           {0.0, 10.0 * w}, {1.5 * w, 0.3 * w}, {20.0 * w, 8.0 * w}, {100.0 * w, w}}) {
    SCOPED_TRACE(mean / w);
    double sum = 0.0, first = 0.0, second = 0.0;
    for (int k = -200000; k <= 200000; ++k) {
      const double x = mean + 1e-4 * k * std;
      const double density = Prior(x, w) * std::exp(-0.5 * std::pow((x - mean) / std, 2));
      sum += density;
      first += density * x;
      second += density * x * x;
    }
    first /= sum;
    const double variance = second / sum - first * first;
    VectorXd found;
    MatrixXd own;
    rig.Solve(VectorXd::Constant(1, mean), MatrixXd::Constant(1, 1, std * std), &found, &own);
    EXPECT_NEAR(found[0], first, 1e-3 * w);
    // No factor makes what is known less.
    EXPECT_NEAR(own(0, 0), std::min(variance, std * std), 1e-3 * own(0, 0));
  }
}

TEST(Peaks, OfTwoThatExplainTheSameOneIsNothing) {
  Rig rig({ParameterKind::kPositionSmoothing, ParameterKind::kMountCompliance});
  // Known: position_smoothing + 2 mount_compliance; and the mount, roughly.
  const double sum = 4e-4;
  const auto rest = [](double mount_std) {
    MatrixXd information = MatrixXd::Zero(2, 2);
    const Eigen::Vector2d both(1.0, 2.0);
    information += both * both.transpose() / (5e-6 * 5e-6);
    information(1, 1) += 1.0 / (mount_std * mount_std);
    return MatrixXd(information.inverse());
  };
  VectorXd found;
  MatrixXd own;
  for (const double mount : {0.0, 0.5 * sum}) {
    SCOPED_TRACE(mount);
    rig.Solve(Eigen::Vector2d(sum - 2.0 * mount, mount), rest(3e-5), &found, &own);
    EXPECT_NEAR(found[0], sum - 2.0 * mount, 2e-5);
    EXPECT_NEAR(found[1], mount, 1e-5);
    EXPECT_LT(std::sqrt(own(1, 1)), 1.5e-5);  // less than the rest knows
  }
  // What nothing tells may be either.
  rig.Solve(Eigen::Vector2d(0.5 * sum, 0.25 * sum), rest(1e-4), &found, &own);
  EXPECT_GT(std::sqrt(own(1, 1)), 5e-5);
}

TEST(Peaks, NoMountGivesWayUpwards) {
  Rig rig({ParameterKind::kMountCompliance});
  VectorXd found;
  MatrixXd own;
  const double std = 1e-4;
  rig.Solve(VectorXd::Constant(1, -2e-4), MatrixXd::Constant(1, 1, std * std), &found, &own);
  EXPECT_LT(std::abs(found[0]), kCompliancePeak);
}

TEST(Peaks, OfALateAccelerometerIsWide) {
  Rig rig({ParameterKind::kAccelSmoothing});
  const double smoothing = 2e-4, std = 1e-4;
  VectorXd early, late;
  MatrixXd own;
  const auto solve = [&](VectorXd* found) {
    rig.Solve(VectorXd::Constant(1, smoothing), MatrixXd::Constant(1, 1, std * std), found, &own);
  };
  solve(&early);
  rig.estimate.imus[0].accel_delay = 0.014;
  rig.estimate.peaks = FirstPeaks(rig.estimate, rig.parameters);
  solve(&late);
  EXPECT_LT(early[0], 0.5 * smoothing);
  EXPECT_GT(late[0], 0.6 * smoothing);
}

TEST(Peaks, JacobianOfTheFactor) {
  Rig rig({ParameterKind::kPoseSmoothing, ParameterKind::kPoseCumulants});
  GaussianFactor factor;
  factor.A = MatrixXd::Random(3, 3);
  factor.b = VectorXd::Random(3);
  const auto cost = PeakPriors(rig.parameters, factor);
  Eigen::Vector3d x(0.3, -0.2, 0.7), r;
  const double* const blocks[] = {&x[0], &x[1]};
  Eigen::Matrix<double, 3, 1> of_first;
  Eigen::Matrix<double, 3, 2, Eigen::RowMajor> of_second;
  double* jacobians[] = {of_first.data(), of_second.data()};
  ASSERT_TRUE(cost->Evaluate(blocks, r.data(), jacobians));
  EXPECT_LT((r - (factor.A * x - factor.b)).norm(), 1e-15);
  MatrixXd J(3, 3), numeric(3, 3);
  J << of_first, of_second;
  for (Eigen::Index k = 0; k < 3; ++k) {
    Eigen::Vector3d moved;
    x[k] += 1e-3;
    ASSERT_TRUE(cost->Evaluate(blocks, moved.data(), nullptr));
    x[k] -= 1e-3;
    numeric.col(k) = (moved - r) / 1e-3;
  }
  EXPECT_LT((J - numeric).norm(), 1e-10);
}

}  // namespace
}  // namespace imu_pose_calib
