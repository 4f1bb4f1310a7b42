#include <ceres/jet.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <random>
#include <set>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/trajectory/pose_trajectory.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using Eigen::Quaterniond;
using Eigen::Vector3d;

SimulatorOptions Recording(Motion motion, double duration_s, uint32_t seed) {
  SimulatorOptions options;
  options.motion = motion;
  options.duration_s = duration_s;
  options.seed = seed;
  return options;
}

/// Trajectory of the given poses and the conditioned data, outliers removed.
struct Fitted {
  ConditionedData data;
  PoseTrajectory trajectory;

  explicit Fitted(const SessionData& recording)
      : data(ConditionData(CalibrationOptions(), recording)),
        trajectory(FitTrajectory(CalibrationOptions(), &data)) {}
};

/// Error of the trajectory at t against the truth.
struct Errors {
  Vector3d rotation, omega, alpha, accel;

  Errors(const PoseTrajectory& trajectory, const TrueTrajectory& truth, double t) {
    MarkerState<double> state;
    EXPECT_TRUE(trajectory.Evaluate(t, &state));
    const TrueState at = truth.At(t);
    rotation = Log(Quaterniond(Quaterniond(at.R_WM).conjugate() * state.q_WM));
    omega = state.omega_M - at.omega_M;
    alpha = state.alpha_M - at.alpha_M;
    accel = state.a_W - at.a_W;
  }
};

/// Mean squared normalised error per axis over the whole log, and the largest of all.
struct NormalisedErrors {
  double rotation = 0.0, omega = 0.0, alpha = 0.0, accel = 0.0, largest = 0.0;

  NormalisedErrors(const CalibrationOptions& calibration, const SimulatorOptions& options) {
    ConditionedData data = ConditionData(calibration, Simulate(options));
    const PoseTrajectory trajectory = FitTrajectory(calibration, &data);
    EXPECT_EQ(data.pose_report.outlier, 0u);
    const TrueTrajectory truth(options);
    const double end = data.poses.back().t;
    const int n = static_cast<int>(30.0 * end);
    for (int i = 0; i < n; ++i) {
      const double t = end * (i + 0.3) / n;
      const Errors e(trajectory, truth, t);
      const MarkerVariance v = trajectory.Variance(t);
      const auto add = [&](const Vector3d& error, double variance, double* mean) {
        *mean += error.squaredNorm() / variance / (3.0 * n);
        largest = std::max(largest, error.cwiseAbs().maxCoeff() / std::sqrt(variance));
      };
      add(e.rotation, v.rotation, &rotation);
      add(e.omega, v.omega, &omega);
      add(e.alpha, v.alpha, &alpha);
      add(e.accel, v.accel, &accel);
    }
  }
};

// With the right prior the means would be 1. Instants a length scale apart are independent: 20 s
// hold some 70 of them on three axes, so that sampling moves a mean by 10 %, at the ends of the log
// some more. The truth is a sum of sines and not a draw from the prior, hence a factor of two on
// top; the wrong factor in a variance (an angle is twice its half: 4, a second derivative over a
// first: 1 / l^2 > 4) is outside of [0.3, 2].

TEST(PoseTrajectory, ErrorsAgreeWithTheVarianceAtALengthScaleThatSuitsTheMotion) {
  for (const Motion motion : {Motion::kHandheld, Motion::kTumble}) {
    for (const double noise : {1e-3, 1e-2}) {
      SCOPED_TRACE(std::string(ToString(motion)) + ", noise " + std::to_string(noise));
      SimulatorOptions options = Recording(motion, 20.0, 1);
      options.position_std = options.rotation_std = noise;
      CalibrationOptions calibration;  // a third of the shortest period, 1 / 1.4 Hz
      calibration.position_lengthscale_s = 0.25;
      calibration.rotation_lengthscale_s = motion == Motion::kTumble ? 0.2 : 0.25;
      const NormalisedErrors errors(calibration, options);
      for (const double mean : {errors.rotation, errors.omega, errors.alpha, errors.accel}) {
        EXPECT_GT(mean, 0.3);
        EXPECT_LT(mean, 2.0);
      }
      EXPECT_LT(errors.largest, 6.0);
    }
  }
}

TEST(PoseTrajectory, ErrorsStayWithinTwiceTheSigmaAtTheLikelihoodsLengthScale) {
  // The likelihood of the square-exponential prior favours smooth trajectories: its length scale
  // is up to 20 % longer than the one at which the errors of rotation match their variance, which
  // shows in alpha, the second derivative, first.
  for (const Motion motion : {Motion::kHandheld, Motion::kTumble}) {
    for (uint32_t seed = 1; seed <= 2; ++seed) {
      SCOPED_TRACE(std::string(ToString(motion)) + ", seed " + std::to_string(seed));
      const NormalisedErrors errors(CalibrationOptions(), Recording(motion, 20.0, seed));
      for (const double mean : {errors.rotation, errors.accel}) {
        EXPECT_GT(mean, 0.3);
        EXPECT_LT(mean, 2.0);
      }
      for (const double mean : {errors.omega, errors.alpha}) {
        EXPECT_GT(mean, 0.3);
        EXPECT_LT(mean, 4.0);
      }
      EXPECT_LT(errors.largest, 9.0);
    }
  }
}

TEST(PoseTrajectory, ConvergesToTheTruthWhenPosesAreGood) {
  for (const Motion motion : {Motion::kHandheld, Motion::kTumble}) {
    // The variance of the smoothed poses of seeds 2 and 4 is rounded to more than the noise.
    const uint32_t seed = motion == Motion::kTumble ? 4 : 2;
    SCOPED_TRACE(ToString(motion));
    SimulatorOptions options = Recording(motion, 8.0, seed);
    options.position_std = options.rotation_std = 1e-6;
    const Fitted fitted(Simulate(options));
    EXPECT_EQ(fitted.data.pose_report.outlier, 0u);
    const TrueTrajectory truth(options);
    for (double t = 0.3; t < 7.6; t += 0.0517) {
      const Errors e(fitted.trajectory, truth, t);
      EXPECT_LT(e.rotation.norm(), 1e-5) << t;
      EXPECT_LT(e.omega.norm(), 1e-4) << t;
      EXPECT_LT(e.alpha.norm(), 1e-2) << t;
      EXPECT_LT(e.accel.norm(), 1e-2) << t;
    }
  }
}

TEST(PoseTrajectory, PoseAtIsTheSmoothedPose) {
  const SimulatorOptions options = Recording(Motion::kTumble, 10.0, 6);
  const Fitted fitted(Simulate(options));
  const TrueTrajectory truth(options);
  double position2 = 0.0, rotation2 = 0.0, count = 0.0;
  for (double t = 0.3; t < 9.6; t += 0.0317) {
    const MarkerVariance variance = fitted.trajectory.Variance(t);
    const Rigid3 pose = fitted.trajectory.PoseAt(t);
    const TrueState at = truth.At(t);
    position2 += (pose.p - at.p_WM).squaredNorm() / variance.position;
    rotation2 += Log(Quaterniond(Quaterniond(at.R_WM).conjugate() * pose.q)).squaredNorm() /
                 variance.rotation;
    count += 3.0;
    EXPECT_LT(std::sqrt(variance.position), options.position_std) << "no smoothing";
    EXPECT_LT(std::sqrt(variance.rotation), options.rotation_std) << "no smoothing";
  }
  EXPECT_GT(position2 / count, 0.3);
  EXPECT_LT(position2 / count, 2.0);
  EXPECT_GT(rotation2 / count, 0.3);
  EXPECT_LT(rotation2 / count, 2.0);
}

TEST(PoseTrajectory, JetsCarryTheSlopeOfTheValues) {
  for (const Motion motion : {Motion::kHandheld, Motion::kTumble}) {
    SCOPED_TRACE(ToString(motion));
    const Fitted fitted(Simulate(Recording(motion, 8.0, 7)));
    using Jet = ceres::Jet<double, 2>;
    for (double t = 0.3; t < 7.6; t += 0.217) {
      MarkerState<Jet> jets;
      Jet at(t);
      at.v << 1.0, -3.0;
      ASSERT_TRUE(fitted.trajectory.Evaluate(at, &jets));
      MarkerState<double> state;
      ASSERT_TRUE(fitted.trajectory.Evaluate(t, &state));
      const auto expect_slope = [&](const auto& jet, const auto& value, const auto& of) {
        const auto numeric = NumericRate(
            [&](double time) {
              MarkerState<double> moved;
              fitted.trajectory.Evaluate(time, &moved);
              return of(moved);
            },
            t, 1e-4);
        for (int i = 0; i < static_cast<int>(value.size()); ++i) {
          EXPECT_EQ(jet[i].a, value[i]);
          EXPECT_NEAR(jet[i].v[0], numeric[i], 1e-5 * std::max(1.0, numeric.norm())) << t;
          EXPECT_EQ(jet[i].v[1], -3.0 * jet[i].v[0]);
        }
      };
      using State = MarkerState<double>;
      expect_slope(jets.q_WM.coeffs(), state.q_WM.coeffs(),
                   [](const State& s) { return Eigen::Vector4d(s.q_WM.coeffs()); });
      expect_slope(jets.omega_M, state.omega_M, [](const State& s) { return s.omega_M; });
      expect_slope(jets.alpha_M, state.alpha_M, [](const State& s) { return s.alpha_M; });
      expect_slope(jets.a_W, state.a_W, [](const State& s) { return s.a_W; });
    }
  }
}

TEST(PoseTrajectory, AngularVelocityIsTheSlopeOfTheAttitude) {
  const Fitted fitted(Simulate(Recording(Motion::kTumble, 8.0, 8)));
  for (double t = 0.3; t < 7.6; t += 0.217) {
    MarkerState<double> state;
    ASSERT_TRUE(fitted.trajectory.Evaluate(t, &state));
    const auto turned = [&](double h) {
      MarkerState<double> moved;
      fitted.trajectory.Evaluate(t + h, &moved);
      return Log(Quaterniond(state.q_WM.conjugate() * moved.q_WM));
    };
    EXPECT_LT((state.omega_M - NumericRate(turned, 0.0, 1e-3)).norm(), 1e-5) << t;
  }
}

TEST(PoseTrajectory, ContainsWhatLiesBetweenPosesWithoutAGap) {
  SessionData recording = Simulate(Recording(Motion::kHandheld, 10.0, 9));
  recording.poses.erase(recording.poses.begin() + 401, recording.poses.begin() + 500);
  const Fitted fitted(recording);
  const PoseTrajectory& trajectory = fitted.trajectory;
  ASSERT_EQ(fitted.data.segments.size(), 2u);
  MarkerState<double> state;
  MarkerState<ceres::Jet<double, 1>> jets;
  const auto evaluates = [&](double t) {
    const bool plain = trajectory.Evaluate(t, &state);
    EXPECT_EQ(trajectory.Evaluate(ceres::Jet<double, 1>(t, 0), &jets), plain) << t;
    EXPECT_EQ(trajectory.Contains(t), plain) << t;
    return plain;
  };
  for (const double t : {0.0, 0.005, 3.999, 4.0, 5.0, 5.001, 9.99}) EXPECT_TRUE(evaluates(t)) << t;
  for (const double t : {-1e3, -1e-6, 4.001, 4.5, 4.999, 9.991, 1e3})
    EXPECT_FALSE(evaluates(t)) << t;
  EXPECT_FALSE(evaluates(std::nan("")));

  EXPECT_TRUE(trajectory.Covers(3.0, 4.0));
  EXPECT_TRUE(trajectory.Covers(5.0, 6.0));
  EXPECT_FALSE(trajectory.Covers(3.0, 6.0));  // both ends are on it, the gap is not
  EXPECT_FALSE(trajectory.Covers(3.0, 4.5));
  EXPECT_FALSE(trajectory.Covers(4.5, 6.0));
}

TEST(PoseTrajectory, IsTheSameForFlippedQuaternions) {
  SessionData recording = Simulate(Recording(Motion::kTumble, 8.0, 10));
  const Fitted plain(recording);
  std::mt19937 random(10);
  for (PoseSample& pose : recording.poses)
    if (random() % 2 == 0) pose.q_WM.coeffs() *= -1.0;
  const Fitted flipped(recording);
  for (double t = 0.1; t < 7.9; t += 0.117) {
    MarkerState<double> a, b;
    ASSERT_TRUE(plain.trajectory.Evaluate(t, &a));
    ASSERT_TRUE(flipped.trajectory.Evaluate(t, &b));
    EXPECT_LT(Log(Quaterniond(a.q_WM.conjugate() * b.q_WM)).norm(), 1e-9);
    EXPECT_LT((a.omega_M - b.omega_M).norm(), 1e-8);
    EXPECT_LT((a.alpha_M - b.alpha_M).norm(), 1e-6);
  }
}

TEST(FitTrajectory, TakesGivenHyperparameters) {
  CalibrationOptions options;
  options.position_lengthscale_s = 0.21;
  options.position_noise_std = 2e-3;
  options.rotation_lengthscale_s = 0.17;
  options.rotation_signal_std = 1.1;
  ConditionedData data = ConditionData(options, Simulate(Recording(Motion::kHandheld, 8.0, 11)));
  const PoseTrajectory trajectory = FitTrajectory(options, &data);
  EXPECT_DOUBLE_EQ(trajectory.position_hyperparameters().lengthscale_s, 0.21);
  EXPECT_DOUBLE_EQ(trajectory.position_hyperparameters().noise_std, 2e-3);
  EXPECT_GT(trajectory.position_hyperparameters().signal_std, 0.0);
  EXPECT_DOUBLE_EQ(trajectory.rotation_hyperparameters().lengthscale_s, 0.17);
  EXPECT_DOUBLE_EQ(trajectory.rotation_hyperparameters().signal_std, 1.1);
}

TEST(FitTrajectory, FindsTheNoiseOfThePoses) {
  SimulatorOptions options = Recording(Motion::kTumble, 20.0, 12);
  options.position_std = 3e-3;
  options.rotation_std = 5e-3;
  const Fitted fitted(Simulate(options));
  EXPECT_NEAR(fitted.trajectory.position_hyperparameters().noise_std, 3e-3, 0.05 * 3e-3);
  EXPECT_NEAR(fitted.trajectory.rotation_hyperparameters().noise_std, 5e-3, 0.05 * 5e-3);
}

TEST(FitTrajectory, RemovesAllGrossOutliersAndHardlyAnythingElse) {
  SessionData recording = Simulate(Recording(Motion::kTumble, 8.0, 13));
  std::mt19937 random(13);
  std::set<size_t> moved;
  while (moved.size() < recording.poses.size() / 100)
    moved.insert(std::uniform_int_distribution<size_t>(0, recording.poses.size() - 1)(random));
  std::set<double> outlier_times;
  int kind = 0;
  for (const size_t i : moved) {
    PoseSample& pose = recording.poses[i];
    if (kind % 3 != 0) pose.p_WM += 0.1 * RandomAxis(&random);
    if (kind % 3 != 1) pose.q_WM = pose.q_WM * Exp(Vector3d(M_PI / 9.0 * RandomAxis(&random)));
    outlier_times.insert(1e-9 * static_cast<double>(pose.t_ns - recording.poses[0].t_ns));
    ++kind;
  }
  const Fitted fitted(recording);
  EXPECT_GE(fitted.data.pose_report.outlier, moved.size());
  EXPECT_LE(fitted.data.pose_report.outlier, moved.size() + 2);
  EXPECT_EQ(fitted.data.pose_report.used, fitted.data.poses.size());
  EXPECT_EQ(fitted.data.poses.size() + fitted.data.pose_report.outlier, recording.poses.size());
  for (const TimedPose& pose : fitted.data.poses)
    EXPECT_EQ(outlier_times.count(pose.t), 0u) << "outlier kept at " << pose.t;
  EXPECT_EQ(fitted.data.segments.front().begin, 0u);
  EXPECT_EQ(fitted.data.segments.back().end, fitted.data.poses.size());
}

TEST(FitTrajectory, KeepsEveryGoodPose) {
  const Fitted fitted(Simulate(Recording(Motion::kTumble, 10.0, 14)));
  EXPECT_EQ(fitted.data.pose_report.outlier, 0u);
  EXPECT_EQ(fitted.data.poses.size(), 1000u);
}

}  // namespace
}  // namespace imu_pose_calib
