#include <gtest/gtest.h>

#include <Eigen/QR>
#include <cmath>
#include <random>
#include <set>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using Eigen::MatrixXd;
using Eigen::Quaterniond;
using Eigen::Vector3d;

SimulatorOptions Clean(double duration_s) {
  SimulatorOptions options;
  options.duration_s = duration_s;
  options.seed = 31;
  options = WithoutNoise(options);
  options.position_std = options.rotation_std = 0.0;
  return options;
}

double Rms(const MatrixXd& x) { return std::sqrt(x.squaredNorm() / static_cast<double>(x.size())); }

std::vector<double> LatenessOf(const std::vector<int64_t>& stamps, double rate_hz) {
  std::vector<double> lateness;
  for (size_t k = 0; k < stamps.size(); ++k)
    lateness.push_back(1e-9 * static_cast<double>(stamps[k]) - static_cast<double>(k) / rate_hz);
  return lateness;
}

// --- Poses ---

TEST(PoseScale, MultipliesPositions) {
  SimulatorOptions options = Clean(1.0);
  const SessionData exact = Simulate(options);
  options.effects.pose_scale = -0.01;
  const SessionData data = Simulate(options);
  for (size_t k = 0; k < data.poses.size(); ++k)
    EXPECT_LT((data.poses[k].p_WM - 0.99 * exact.poses[k].p_WM).norm(), 1e-15);
}

TEST(SlowErrors, HaveTheirSigmaAndForgetWithinSeconds) {
  SimulatorOptions options = Clean(6000.0);
  options.motion = Motion::kStatic;
  options.pose_rate_hz = options.gyro_rate_hz = options.accel_rate_hz = 10.0;
  options.effects.slow_errors = 2e-3;
  std::vector<Vector3d> errors;  // of a body that rests at 0
  for (const PoseSample& pose : Simulate(options).poses) errors.push_back(pose.p_WM);
  ASSERT_EQ(errors.size(), 60000u);
  double variance = 0.0, covariance = 0.0;
  for (size_t k = 30; k < errors.size(); ++k) {
    variance += errors[k].squaredNorm() / 3.0 / static_cast<double>(errors.size() - 30);
    covariance += errors[k].dot(errors[k - 30]) / 3.0 / static_cast<double>(errors.size() - 30);
  }
  EXPECT_NEAR(std::sqrt(variance), 2e-3, 0.1e-3);
  EXPECT_NEAR(covariance / variance, std::exp(-1.0), 0.05);
}

TEST(SlowErrors, AreInPositionsAndRotationsApart) {
  SimulatorOptions options = Clean(300.0);
  options.motion = Motion::kStatic;
  options.pose_rate_hz = options.gyro_rate_hz = options.accel_rate_hz = 10.0;
  const SessionData exact = Simulate(options);
  options.effects.slow_errors = 1e-3;
  const SessionData data = Simulate(options);
  MatrixXd p(3, 3000), r(3, 3000);
  for (size_t k = 0; k < 3000; ++k) {
    p.col(static_cast<Eigen::Index>(k)) = data.poses[k].p_WM - exact.poses[k].p_WM;
    r.col(static_cast<Eigen::Index>(k)) =
        Log(Quaterniond(exact.poses[k].q_WM.conjugate() * data.poses[k].q_WM));
  }
  EXPECT_NEAR(Rms(p), 1e-3, 0.2e-3);
  EXPECT_NEAR(Rms(r), 1e-3, 0.2e-3);
  EXPECT_LT(std::abs((p.array() * r.array()).mean()), 0.3e-6);
}

TEST(MarkerOffset, CarriesErrorsOfRotationIntoThePosition) {
  SimulatorOptions options = Clean(2.0);
  options.rotation_std = 2e-3;
  const SessionData exact = Simulate(options);
  options.effects.marker_offset = 0.15;
  const SessionData data = Simulate(options);
  const TrueTrajectory truth(options);
  MatrixXd A(600, 3), b(600, 1);
  for (size_t k = 0; k < 200; ++k) {
    EXPECT_EQ(data.poses[k].q_WM.coeffs(), exact.poses[k].q_WM.coeffs());
    const auto row = static_cast<Eigen::Index>(3 * k);
    A.middleRows<3>(row) =
        data.poses[k].q_WM.toRotationMatrix() - truth.At(0.01 * static_cast<double>(k)).R_WM;
    b.middleRows<3>(row) = data.poses[k].p_WM - exact.poses[k].p_WM;
  }
  const Vector3d origin = A.colPivHouseholderQr().solve(b);
  EXPECT_NEAR(origin.norm(), 0.15, 1e-9);
  EXPECT_LT((A * origin - b).norm(), 1e-10);
}

/// Errors of rotations [rad] and positions [m], columns over time.
struct PoseErrors {
  MatrixXd rotation, position;

  PoseErrors(const SimulatorOptions& options, const std::vector<PoseSample>& poses)
      : rotation(3, poses.size()), position(3, poses.size()) {
    const TrueTrajectory truth(options);
    for (size_t k = 0; k < poses.size(); ++k) {
      const TrueState s = truth.At(static_cast<double>(k) / options.pose_rate_hz);
      rotation.col(static_cast<Eigen::Index>(k)) =
          Log(Quaterniond(Quaterniond(s.R_WM).conjugate() * poses[k].q_WM));
      position.col(static_cast<Eigen::Index>(k)) = poses[k].p_WM - s.p_WM;
    }
  }
};

/// Rms of the steps of white noise is 1.41 times its own.
double Steps(const MatrixXd& x) {
  return Rms(x.rightCols(x.cols() - 1) - x.leftCols(x.cols() - 1)) / Rms(x);
}

TEST(FusedPoses, AreMeansOverTheirTime) {
  // White noise of the tracker, and an IMU without.
  SimulatorOptions options = Clean(20.0);
  options.motion = Motion::kStatic;
  options.position_std = options.rotation_std = 1e-3;
  options.effects.fused_poses_s = 0.1;
  const PoseErrors errors(options, Simulate(options).poses);
  // Gaussian weights of sigma s leave 1 / sqrt(2 sqrt(pi) s rate) of it.
  const double left = 1e-3 / std::sqrt(2.0 * std::sqrt(M_PI) * 0.1 / std::sqrt(12.0) * 100.0);
  EXPECT_NEAR(Rms(errors.position), left, 0.05 * left);
  EXPECT_NEAR(Rms(errors.rotation), left, 0.05 * left);
  EXPECT_LT(Steps(errors.position), 0.4);
  EXPECT_LT(Steps(errors.rotation), 0.4);
}

TEST(FusedPoses, FollowTheGyroscopeInRotationAndAreSmoothInPosition) {
  SimulatorOptions options = Clean(20.0);
  options.effects.fused_poses_s = 0.1;
  options.effects.gyro_filter_hz = 50.0;  // its delay is known
  options.gyro_rate_hz = 400.0;
  options.motion = Motion::kTumble;
  options.gyro_bias_walk = 0.0;
  options.gyro_bias << 0.01, 0.02, -0.03;
  const PoseErrors quiet(options, Simulate(options).poses);
  EXPECT_LT(Rms(quiet.rotation), 2e-4);  // fast turns stay
  EXPECT_GT(Rms(quiet.position), 5e-4);  // smoothed
  options.gyro_std = 0.1;
  const PoseErrors noisy(options, Simulate(options).poses);
  // Noise of the rate, integrated over a few hundredths of a second: 0.1 / sqrt(400) sqrt(0.03).
  EXPECT_GT(Rms(noisy.rotation), 3e-4);
  EXPECT_LT(Rms(noisy.rotation), 2e-3);
  EXPECT_GT(Steps(noisy.rotation), 0.5);
  EXPECT_EQ(noisy.position, quiet.position);
}

// --- Stamps ---

constexpr double kRate = 200.0;

Stream StreamOf(const StreamEffects& effects, double duration_s = 100.0) {
  return {effects, 0, kRate, duration_s, std::mt19937(3), std::mt19937(4)};
}

TEST(Stamps, JitterHasItsSigma) {
  StreamEffects effects;
  effects.jitter_s = 0.3e-3;
  double squares = 0.0, sum = 0.0;
  for (const double late : LatenessOf(StreamOf(effects).Stamps(), kRate)) {
    squares += late * late / 20000.0;
    sum += late / 20000.0;
  }
  EXPECT_NEAR(std::sqrt(squares), 0.3e-3, 0.01e-3);
  EXPECT_NEAR(sum, 0.0, 0.02e-3);
}

TEST(Stamps, LatencyIsExponentialAndKeepsTheOrder) {
  StreamEffects effects;
  effects.latency_s = 1e-3;
  const std::vector<int64_t> stamps = StreamOf(effects).Stamps();
  for (size_t k = 1; k < stamps.size(); ++k) ASSERT_GT(stamps[k], stamps[k - 1]);
  int beyond = 0;
  for (const double late : LatenessOf(stamps, kRate)) {
    ASSERT_GE(late, 0.0);
    beyond += late > 1e-3 ? 1 : 0;
  }
  EXPECT_NEAR(beyond / 20000.0, std::exp(-1.0), 0.01);
  EXPECT_NEAR(StreamOf(effects).MeanLateness(), 1e-3, 0.03e-3);
}

TEST(Stamps, BurstsComeWhenTheLastSampleIsThere) {
  StreamEffects effects;
  effects.burst = 4.0;
  const std::vector<int64_t> stamps = StreamOf(effects, 0.05).Stamps();
  ASSERT_EQ(stamps.size(), 10u);
  for (const size_t first : {0u, 4u}) {
    EXPECT_EQ(stamps[first], 5'000'000 * static_cast<int64_t>(first + 3));
    for (size_t k = first + 1; k < first + 4; ++k) EXPECT_LT(stamps[k] - stamps[k - 1], 50'000);
  }
  EXPECT_EQ(stamps[8], 45'000'000);
}

TEST(Stamps, CutAreMultiplesOfTheStep) {
  StreamEffects effects;
  effects.step_s = 4e-3;
  effects.jitter_s = 1e-3;
  Stream stream = StreamOf(effects, 5.0);
  stream.first_ns = -7;
  const std::vector<int64_t> cut = stream.Stamps();
  effects.step_s = 0.0;
  const std::vector<int64_t> whole = stream.Stamps();
  ASSERT_EQ(cut.size(), 1000u);
  for (size_t k = 0; k < cut.size(); ++k) {
    EXPECT_EQ(cut[k] % 4'000'000, 0);
    EXPECT_LE(cut[k], whole[k]);
    EXPECT_GT(cut[k] + 4'000'000, whole[k]);
  }
}

TEST(Stamps, MoveTheTrueClockByTheirMeanLateness) {
  SimulatorOptions options = Clean(20.0);
  options.effects.pose_stream.latency_s = 3e-3;
  options.effects.imu_stream.burst = 5.0;
  const TrueClock clock(options);
  // Four periods late, three, ..., none.
  EXPECT_NEAR(clock.time_shift_s, options.time_shift_s + 3e-3 - 0.010, 0.3e-3);
  EXPECT_NEAR(clock.accel_delay_s, 0.0, 1e-12);
  options.accel_rate_hz = 100.0;
  EXPECT_NEAR(TrueClock(options).accel_delay_s, 0.010, 0.1e-3);
  // Of every imu with the same poses.
  const double pose_late = clock.time_shift_s - options.time_shift_s + 0.010;
  const SimulatorOptions further = FurtherImu(options, 1);
  EXPECT_NEAR(TrueClock(further).time_shift_s, further.time_shift_s + pose_late - 0.010, 0.1e-3);
}

TEST(Drops, LeaveOutTheirShareOfTheSamples) {
  SimulatorOptions options = Clean(50.0);
  options.effects.pose_stream.drops = 5.0;
  options.effects.imu_stream.drops = 10.0;
  const SessionData data = Simulate(options);
  EXPECT_NEAR(static_cast<double>(data.poses.size()), 4750.0, 60.0);
  EXPECT_NEAR(static_cast<double>(data.imus[0].gyro.size()), 9000.0, 120.0);
  std::set<int64_t> periods;
  for (size_t k = 1; k < data.poses.size(); ++k)
    periods.insert((data.poses[k].t_ns - data.poses[k - 1].t_ns) / 10'000'000);
  EXPECT_EQ(*periods.begin(), 1);
  EXPECT_GE(*periods.rbegin(), 2);
}

}  // namespace
}  // namespace imu_pose_calib
