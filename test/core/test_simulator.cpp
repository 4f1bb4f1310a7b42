#include <gtest/gtest.h>

#include <Eigen/Eigenvalues>
#include <cmath>
#include <random>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

SimulatorOptions Recording(Motion motion, double duration_s, uint32_t seed) {
  SimulatorOptions options;
  options.motion = motion;
  options.duration_s = duration_s;
  options.seed = seed;
  return options;
}

/// Mean and standard deviation of all axes together.
struct Moments {
  double mean = 0.0, std = 0.0;

  explicit Moments(const std::vector<Vector3d>& samples) {
    for (const Vector3d& s : samples) mean += s.sum() / (3.0 * static_cast<double>(samples.size()));
    double sum2 = 0.0;
    for (const Vector3d& s : samples) sum2 += (s.array() - mean).square().sum();
    std = std::sqrt(sum2 / (3.0 * static_cast<double>(samples.size())));
  }
};

/// Samples less those of `exact`.
std::vector<Vector3d> Difference(const std::vector<ImuSample>& samples,
                                 const std::vector<ImuSample>& exact) {
  std::vector<Vector3d> difference;
  for (size_t i = 0; i < samples.size(); ++i)
    difference.push_back(samples[i].value - exact[i].value);
  return difference;
}

std::vector<Vector3d> Steps(const std::vector<Vector3d>& x) {
  std::vector<Vector3d> steps;
  for (size_t i = 1; i < x.size(); ++i) steps.push_back(x[i] - x[i - 1]);
  return steps;
}

TEST(TrueTrajectory, EachDerivativeIsTheSlopeOfTheOneBefore) {
  const double step = 1e-3;
  for (const auto& [motion, name] : kMotions) {
    SCOPED_TRACE(name);
    const TrueTrajectory trajectory(Recording(motion, 40.0, 3));
    for (double t = 0.1; t < 40.0; t += 0.737) {
      const auto rate = [&](Vector3d TrueState::*member) {
        return Vector3d(NumericRate([&](double at) { return trajectory.At(at).*member; }, t, step));
      };
      const TrueState at = trajectory.At(t);
      EXPECT_LT((at.v_W - rate(&TrueState::p_WM)).norm(), 1e-7) << t;
      EXPECT_LT((at.a_W - rate(&TrueState::v_W)).norm(), 1e-7) << t;
      EXPECT_LT((at.alpha_M - rate(&TrueState::omega_M)).norm(), 1e-6) << t;
      const auto turned = [&](double h) {
        return Log(Eigen::Quaterniond(Matrix3d(at.R_WM.transpose() * trajectory.At(t + h).R_WM)));
      };
      EXPECT_LT((at.omega_M - NumericRate(turned, 0.0, step)).norm(), 1e-6) << t;
      EXPECT_LT((at.R_WM * at.R_WM.transpose() - Matrix3d::Identity()).norm(), 1e-13) << t;
    }
  }
}

TEST(TrueTrajectory, HandheldMovesAndTurnsOnAllSixAxes) {
  for (uint32_t seed = 1; seed <= 5; ++seed) {
    const TrueTrajectory trajectory(Recording(Motion::kHandheld, 40.0, seed));
    Vector3d low = Vector3d::Constant(1e9), high = -low;
    Matrix3d rates = Matrix3d::Zero();
    double swing = 0.0;
    const int n = 2000;
    for (int i = 0; i < n; ++i) {
      const TrueState s = trajectory.At(40.0 * i / n);
      low = low.cwiseMin(s.p_WM);
      high = high.cwiseMax(s.p_WM);
      rates += s.omega_M * s.omega_M.transpose() / n;
      const TrueState later = trajectory.At(40.0 * i / n + 1.3);
      swing = std::max(swing, Eigen::AngleAxisd(s.R_WM.transpose() * later.R_WM).angle());
    }
    EXPECT_GT((high - low).minCoeff(), 0.2) << "seed " << seed;
    EXPECT_LT((high - low).maxCoeff(), 1.2) << "seed " << seed;
    const Eigen::SelfAdjointEigenSolver<Matrix3d> eigen(rates);
    EXPECT_GT(std::sqrt(eigen.eigenvalues()[0]), 0.5) << "seed " << seed;
    EXPECT_GT(swing, 0.6) << "seed " << seed;
  }
}

TEST(TrueTrajectory, TumbleTurnsManyTimes) {
  const TrueTrajectory trajectory(Recording(Motion::kTumble, 40.0, 1));
  // The mean body rate times duration counts the turns; a swing has no mean rate.
  Vector3d turned = Vector3d::Zero();
  const int n = 4000;
  for (int i = 0; i < n; ++i) turned += trajectory.At(40.0 * i / n).omega_M * (40.0 / n);
  EXPECT_GT(turned.norm(), 20.0 * 2.0 * M_PI);
}

TEST(TrueTrajectory, PlanarStaysInThePlaneAndTurnsAboutItsNormal) {
  const TrueTrajectory trajectory(Recording(Motion::kPlanar, 20.0, 2));
  double turn = 0.0, move = 0.0;
  for (double t = 0.0; t < 20.0; t += 0.1) {
    const TrueState s = trajectory.At(t);
    EXPECT_EQ(s.p_WM.z(), 0.0);
    EXPECT_LT((s.R_WM.col(2) - Vector3d::UnitZ()).norm(), 1e-14);
    EXPECT_LT(s.omega_M.head<2>().norm(), 1e-14);
    turn = std::max(turn, std::abs(s.omega_M.z()));
    move = std::max(move, s.p_WM.norm());
  }
  EXPECT_GT(turn, 0.5);
  EXPECT_GT(move, 0.1);
}

TEST(TrueTrajectory, HingeTurnsAboutOneTiltedAxisWithoutMoving) {
  const TrueTrajectory trajectory(Recording(Motion::kHinge, 20.0, 2));
  const Vector3d axis_W = trajectory.At(0.0).R_WM.col(0);
  EXPECT_LT(axis_W.cwiseAbs().maxCoeff(), 0.98) << "not tilted";
  double turn = 0.0;
  for (double t = 0.0; t < 20.0; t += 0.1) {
    const TrueState s = trajectory.At(t);
    EXPECT_EQ(s.p_WM, Vector3d(Vector3d::Zero()));
    EXPECT_LT((s.R_WM.col(0) - axis_W).norm(), 1e-14);
    EXPECT_LT(s.omega_M.tail<2>().norm(), 1e-14);
    turn = std::max(turn, std::abs(s.omega_M.x()));
  }
  EXPECT_GT(turn, 0.5);
}

TEST(TrueTrajectory, StaticRests) {
  const TrueTrajectory trajectory(Recording(Motion::kStatic, 20.0, 2));
  const TrueState first = trajectory.At(0.0);
  for (double t = 0.0; t < 20.0; t += 0.5) {
    const TrueState s = trajectory.At(t);
    EXPECT_EQ(s.R_WM, first.R_WM);
    EXPECT_EQ(s.p_WM, first.p_WM);
    EXPECT_EQ(s.omega_M.norm() + s.alpha_M.norm() + s.a_W.norm(), 0.0);
  }
}

TEST(Simulate, IsAFunctionOfItsOptions) {
  const SimulatorOptions options = Recording(Motion::kHandheld, 2.0, 7);
  const SessionData a = Simulate(options), b = Simulate(options);
  const SessionData other = Simulate(Recording(Motion::kHandheld, 2.0, 8));
  ASSERT_EQ(a.poses.size(), 200u);
  ASSERT_EQ(a.imus[0].gyro.size(), 400u);
  ASSERT_EQ(a.imus[0].accel.size(), 400u);
  for (size_t i = 0; i < a.poses.size(); ++i) {
    EXPECT_EQ(a.poses[i].p_WM, b.poses[i].p_WM);
    EXPECT_EQ(a.poses[i].q_WM.coeffs(), b.poses[i].q_WM.coeffs());
    EXPECT_NE(a.poses[i].p_WM, other.poses[i].p_WM);
  }
  for (size_t i = 0; i < a.imus[0].gyro.size(); ++i) {
    EXPECT_EQ(a.imus[0].gyro[i].value, b.imus[0].gyro[i].value);
    EXPECT_EQ(a.imus[0].accel[i].value, b.imus[0].accel[i].value);
    EXPECT_NE(a.imus[0].gyro[i].value, other.imus[0].gyro[i].value);
    EXPECT_NE(a.imus[0].accel[i].value, other.imus[0].accel[i].value);
  }
}

TEST(Simulate, NoiseIsWhiteWithTheAskedStandardDeviation) {
  // 12000 values per sensor: their std is known to 0.65 %, their mean and correlation to 0.9 %.
  SimulatorOptions noisy = Recording(Motion::kHandheld, 20.0, 4);
  const SimulatorOptions clean = WithoutNoise(noisy);
  noisy.gyro_bias.setZero();
  noisy.accel_bias.setZero();
  noisy.gyro_bias_walk = noisy.accel_bias_walk = 0.0;
  noisy.pose_rate_hz = 200.0;
  noisy.position_std = 2e-3;
  const SessionData data = Simulate(noisy), exact = Simulate(clean);
  const auto expect_white = [](const std::vector<Vector3d>& noise, double sigma) {
    const Moments moments(noise);
    EXPECT_NEAR(moments.std, sigma, 0.03 * sigma);
    EXPECT_NEAR(moments.mean, 0.0, 0.04 * sigma);
    EXPECT_NEAR(Moments(Steps(noise)).std, std::sqrt(2.0) * sigma, 0.05 * sigma);
  };
  expect_white(Difference(data.imus[0].gyro, exact.imus[0].gyro), noisy.gyro_std);
  expect_white(Difference(data.imus[0].accel, exact.imus[0].accel), noisy.accel_std);

  const TrueTrajectory truth(noisy);
  std::vector<Vector3d> position, rotation;
  for (const PoseSample& pose : data.poses) {
    const TrueState s = truth.At(1e-9 * static_cast<double>(pose.t_ns - noisy.start_ns));
    position.push_back(pose.p_WM - s.p_WM);
    rotation.push_back(Log(Eigen::Quaterniond(s.R_WM).conjugate() * pose.q_WM));
  }
  expect_white(position, noisy.position_std);
  expect_white(rotation, noisy.rotation_std);
}

TEST(Simulate, BiasesStartWhereAskedAndWalk) {
  SimulatorOptions options = WithoutNoise(Recording(Motion::kHandheld, 20.0, 5));
  const SessionData exact = Simulate(options);
  options.gyro_bias << 0.1, -0.2, 0.3;
  options.accel_bias << -1.0, 2.0, 0.5;
  options.gyro_bias_walk = 1e-3;
  options.accel_bias_walk = 5e-3;
  options.gyro_rate_hz = 200.0;
  options.accel_rate_hz = 200.0;
  const SessionData data = Simulate(options);
  const auto gyro = Difference(data.imus[0].gyro, exact.imus[0].gyro);
  const auto accel = Difference(data.imus[0].accel, exact.imus[0].accel);
  EXPECT_LT((gyro.front() - options.gyro_bias).norm(), 1e-12);
  EXPECT_LT((accel.front() - options.accel_bias).norm(), 1e-12);
  // Sigma of a step is walk sqrt(1 / rate).
  EXPECT_NEAR(Moments(Steps(gyro)).std, 1e-3 / std::sqrt(200.0), 0.03e-3 / std::sqrt(200.0));
  EXPECT_NEAR(Moments(Steps(accel)).std, 5e-3 / std::sqrt(200.0), 0.15e-3 / std::sqrt(200.0));
}

TEST(Simulate, SamplesEqualTheModelAtTheShiftedAndDelayedTime) {
  for (const double shift : {0.02, -3.7, 0.5}) {
    for (const double delay : {0.0, 0.045, -0.03}) {
      SimulatorOptions o = WithoutNoise(Recording(Motion::kTumble, 3.0, 6));
      o.time_shift_s = shift;
      o.accel_delay_s = delay;
      const SessionData data = Simulate(o);
      const TrueTrajectory truth(o);
      const Matrix3d R_IM = o.T_MI.q.toRotationMatrix().transpose();
      const auto t_pose = [&](const ImuSample& s) {
        return 1e-9 * static_cast<double>(s.t_ns - o.start_ns) + o.time_shift_s;
      };
      for (size_t i = 0; i < data.imus[0].gyro.size(); i += 37) {
        const TrueState at_gyro = truth.At(t_pose(data.imus[0].gyro[i]));
        EXPECT_LT((data.imus[0].gyro[i].value - R_IM * at_gyro.omega_M).norm(), 1e-6);
        // The acceleration of the IMU's origin by differences of its position.
        const double t = t_pose(data.imus[0].accel[i]) - delay;
        const auto velocity = [&](double at) {
          const TrueState s = truth.At(at);
          return Vector3d(s.v_W + s.R_WM * s.omega_M.cross(o.T_MI.p));
        };
        const Vector3d a_W = NumericRate(velocity, t, 1e-3);
        const Vector3d f_I = R_IM * truth.At(t).R_WM.transpose() * (a_W - o.g_W);
        EXPECT_LT((data.imus[0].accel[i].value - f_I).norm(), 1e-5);
      }
    }
  }
}

TEST(Simulate, StampsKeepNanosecondsWhenTheClocksAreTwelveDaysApart) {
  SimulatorOptions near = Recording(Motion::kHandheld, 2.0, 9), far = near;
  near.time_shift_s = 0.0;
  far.time_shift_s = 12.0 * 86400.0 + 0.123456789;
  const SessionData a = Simulate(near), b = Simulate(far);
  ASSERT_EQ(a.imus[0].gyro.size(), b.imus[0].gyro.size());
  for (size_t i = 0; i < a.imus[0].gyro.size(); ++i) {
    EXPECT_EQ(a.imus[0].gyro[i].t_ns - b.imus[0].gyro[i].t_ns, int64_t{1036800123456789});
    EXPECT_EQ(a.imus[0].accel[i].t_ns - b.imus[0].accel[i].t_ns, int64_t{1036800123456789});
    EXPECT_EQ(a.imus[0].gyro[i].value, b.imus[0].gyro[i].value);
  }
  for (size_t i = 0; i < a.poses.size(); ++i) EXPECT_EQ(a.poses[i].t_ns, b.poses[i].t_ns);
}

TEST(Simulator, PosesAreMeansOverTheExposure) {
  SimulatorOptions options;
  options.duration_s = 2.0;
  options.position_std = options.rotation_std = 0.0;
  options.pose_exposure_s = 0.06;
  const TrueTrajectory trajectory(options);
  const SessionData data = Simulate(options);
  constexpr int kSteps = 2000;  // midpoint rule
  for (const size_t k : {0u, 70u, 199u}) {
    const double t = static_cast<double>(k) / options.pose_rate_hz;
    const Eigen::Matrix3d R = trajectory.At(t).R_WM;
    Eigen::Vector3d p = Eigen::Vector3d::Zero(), turn = Eigen::Vector3d::Zero();
    for (int i = 0; i < kSteps; ++i) {
      const TrueState state =
          trajectory.At(t + options.pose_exposure_s * ((i + 0.5) / kSteps - 0.5));
      p += state.p_WM / kSteps;
      turn += Log(Eigen::Quaterniond(R.transpose() * state.R_WM)) / kSteps;
    }
    EXPECT_LT((data.poses[k].p_WM - p).norm(), 1e-8);
    EXPECT_LT(data.poses[k].q_WM.angularDistance(Eigen::Quaterniond(R) * Exp(turn)), 1e-7);
    EXPECT_GT((trajectory.At(t).p_WM - p).norm(), 1e-5);
  }
}

}  // namespace
}  // namespace imu_pose_calib
