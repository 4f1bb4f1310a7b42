#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

SimulatorOptions Recording(double pose_rate_hz, uint32_t seed) {
  SimulatorOptions options;
  options.duration_s = 40.0;
  options.pose_rate_hz = pose_rate_hz;
  options.seed = seed;
  return options;
}

/// Poses that are linear interpolations between every `period`-th of them.
void Interpolate(size_t period, std::vector<PoseSample>* poses) {
  for (size_t k = 0; k + period < poses->size(); k += period) {
    const PoseSample from = (*poses)[k], to = (*poses)[k + period];
    for (size_t i = 1; i < period; ++i) {
      const double u = static_cast<double>(i) / static_cast<double>(period);
      (*poses)[k + i].p_WM = (1.0 - u) * from.p_WM + u * to.p_WM;
      (*poses)[k + i].q_WM = from.q_WM.slerp(u, to.q_WM);
    }
  }
}

TEST(PoseUpdates, TheirBeatIsFound) {
  for (const double rate_hz : {75.0, 82.0, 90.0, 100.0, 200.0, 400.0}) {
    SimulatorOptions options = Recording(rate_hz, 41);
    options.effects.pose_updates = 2e-3;
    EXPECT_NEAR(rate_hz / FindUpdatePeriod(Simulate(options).poses), 20.0, 0.3) << rate_hz;
  }
  SessionData data = Simulate(Recording(200.0, 42));
  Interpolate(8, &data.poses);
  EXPECT_EQ(FindUpdatePeriod(data.poses), 8.0);
  data.poses[777].p_WM.x() = 1e308;
  EXPECT_EQ(FindUpdatePeriod(data.poses), 8.0);
}

TEST(PoseUpdates, TheirBeatIsFoundInVibration) {
  for (uint32_t seed = 48; seed < 52; ++seed) {
    SimulatorOptions options = Recording(103.0, seed);
    options.motion = Motion::kTumble;
    options.effects.vibration = 1.6;
    options.effects.slow_errors = 4e-4;
    options.effects.pose_updates = 9e-4;
    EXPECT_NEAR(FindUpdatePeriod(Simulate(options).poses), 5.15, 0.1) << seed;
  }
}

TEST(PoseUpdates, OrdinaryPosesHaveNone) {
  for (const Motion motion : {Motion::kHandheld, Motion::kTumble, Motion::kArm, Motion::kDrone}) {
    for (const double noise : {0.0, 1e-5, 1e-3}) {
      SimulatorOptions options = Recording(200.0, 43);
      options.motion = motion;
      options.position_std = noise;
      EXPECT_EQ(FindUpdatePeriod(Simulate(options).poses), 1.0) << ToString(motion) << " " << noise;
      options.effects.shocks = 20.0;
      options.effects.pose_stream.jitter_s = 1e-3;
      EXPECT_EQ(FindUpdatePeriod(Simulate(options).poses), 1.0) << ToString(motion) << " " << noise;
    }
  }
  EXPECT_EQ(FindUpdatePeriod({}), 1.0);
  EXPECT_EQ(FindUpdatePeriod(std::vector<PoseSample>(500)), 1.0);
}

TEST(PoseUpdates, OnePoseIsKeptOfEachInterval) {
  std::vector<PoseSample> poses(40);
  for (size_t k = 0; k < poses.size(); ++k)
    poses[k].t_ns = static_cast<int64_t>(k * 5'000'000 + (k % 3) * 100'000);
  poses.erase(poses.begin() + 11, poses.begin() + 14);
  std::vector<PoseSample> kept = poses;
  EXPECT_EQ(KeepOneOf(10, &kept), 33u);
  ASSERT_EQ(kept.size(), 4u);
  EXPECT_EQ(kept[1].t_ns, 50'100'000);
  EXPECT_EQ(KeepOneOf(1, &poses), 0u);
  EXPECT_EQ(poses.size(), 37u);
}

TEST(PoseUpdates, FusedPosesGiveNoMoreThanTheirTracker) {
  for (uint32_t seed = 44; seed < 47; ++seed) {
    SimulatorOptions truth = Recording(200.0, seed);
    truth.effects.pose_updates = 2e-3;
    const Calibration result = Calibrate(CalibrationOptions(), Simulate(truth));
    const StreamReport& poses = result.sessions[0].poses;
    EXPECT_EQ(poses.between_updates, poses.received / 10 * 9);
    EXPECT_NEAR(poses.rate_hz, 20.0, 0.1);
    const Eigen::Vector3d error = result.imus[0].T_MI.p - truth.T_MI.p;
    const Eigen::Vector3d std = result.imus[0].Std().head<3>();
    EXPECT_LT(error.cwiseQuotient(std).norm(), 4.0) << seed;
    EXPECT_LT(std.norm(), 3e-3);
    EXPECT_TRUE(std::any_of(result.warnings.begin(), result.warnings.end(), [](const auto& text) {
      return text.find("20 times a second") != std::string::npos;
    }));
  }
}

}  // namespace
}  // namespace imu_pose_calib
