#include <gtest/gtest.h>

#include "imu_pose_calib/core/calibration/knot_spacing.h"
#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

double Choose(const SimulatorOptions& truth, double given = 0.0) {
  CalibrationOptions options;
  options.knot_spacing_s = given;
  return ChooseKnotSpacing(options, ConditionData(options, Simulate(truth)));
}

SimulatorOptions Recording(Motion motion) {
  SimulatorOptions truth;
  truth.duration_s = 30.0;
  truth.motion = motion;
  truth.seed = 5;
  return truth;
}

TEST(KnotSpacing, IsThatWhichIsGiven) { EXPECT_EQ(Choose(Recording(Motion::kArm), 0.07), 0.07); }

TEST(KnotSpacing, FollowsTheMotionDownToTheNoise) {
  SimulatorOptions tumble = Recording(Motion::kTumble);
  tumble.gyro_rate_hz = tumble.accel_rate_hz = 500.0;
  const double ordinary = Choose(tumble);
  tumble.gyro_std *= 0.1;
  tumble.accel_std *= 0.1;
  EXPECT_LT(Choose(tumble), ordinary);
  EXPECT_EQ(Choose(Recording(Motion::kStatic)), 0.064);  // the coarsest
}

TEST(KnotSpacing, DoesNotFollowNoise) {
  for (const uint32_t seed : {1u, 2u, 5u}) {
    SimulatorOptions arm = Recording(Motion::kArm);
    arm.seed = seed;
    arm.gyro_std = 0.05;
    EXPECT_EQ(Choose(arm), 0.032) << seed;  // as its accelerations ask for
  }
}

TEST(KnotSpacing, LeavesThreeSamplesToASpan) {
  SimulatorOptions tumble = Recording(Motion::kTumble);
  tumble.gyro_std = tumble.accel_std = 1e-6;
  tumble.gyro_rate_hz = tumble.accel_rate_hz = 100.0;
  EXPECT_EQ(Choose(tumble), 0.032);  // half of it has 1.6
  tumble.gyro_rate_hz = tumble.accel_rate_hz = 40.0;
  EXPECT_NEAR(Choose(tumble), 0.075, 1e-3);
}

/// Rests take most of the time, and none of the power.
TEST(KnotSpacing, IsThatOfTheLivelySeconds) {
  SimulatorOptions lively = Recording(Motion::kTumble);
  SessionData data = Simulate(lively);
  const double alone = ChooseKnotSpacing({}, ConditionData({}, data));
  lively.motion = Motion::kStatic;
  lively.duration_s = 600.0;
  const SessionData rest = Simulate(lively);
  const int64_t behind_ns =
      data.imus[0].gyro.back().t_ns + 3'000'000'000 - rest.imus[0].gyro[0].t_ns;
  const auto append = [behind_ns](const auto& from, auto* to) {
    for (auto sample : from) {
      sample.t_ns += behind_ns;
      to->push_back(sample);
    }
  };
  append(rest.poses, &data.poses);
  append(rest.imus[0].gyro, &data.imus[0].gyro);
  append(rest.imus[0].accel, &data.imus[0].accel);
  EXPECT_EQ(ChooseKnotSpacing({}, ConditionData({}, data)), alone);
}

/// Of the body at 20 to 80 Hz, beyond what knots for 200 Hz can hold.
TEST(KnotSpacing, DoesNotRunAfterVibration) {
  SimulatorOptions shaken = Recording(Motion::kHandheld);
  const double calm = Choose(shaken);
  shaken.effects.vibration = 2.0;
  EXPECT_GE(Choose(shaken), calm);
}

}  // namespace
}  // namespace imu_pose_calib
