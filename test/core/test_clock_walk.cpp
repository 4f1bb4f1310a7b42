#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "imu_pose_calib/core/calibration/estimate.h"
#include "imu_pose_calib/core/calibration/solution.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/start/clock_walk.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

ClockWalk Walk() {
  ClockWalk walk;
  walk.t = {1.0, 2.0, 4.0};
  walk.offset = {0.0, 2e-3, -2e-3};
  walk.std = {1e-3, 1e-3};
  return walk;
}

TEST(ClockWalk, IsLinearBetweenItsKnotsAndEvenBeyond) {
  const ClockWalk walk = Walk();
  for (const auto& [t, offset] : {std::pair{0.0, 0.0}, {1.5, 1e-3}, {3.0, 0.0}, {9.0, -2e-3}})
    EXPECT_NEAR(walk.At(t), offset, 1e-15) << t;
  EXPECT_EQ(walk.Locate(4.0).first, 1u);
  EXPECT_EQ(ClockWalk().At(3.0), 0.0);
}

TEST(ClockWalk, ImuTimeIsTheOtherWay) {
  ImuSessionEstimate imu;
  imu.time_shift = 0.3;
  imu.clock_drift = 5e-5;
  imu.clock_reference = 2.0;
  imu.walk = Walk();
  for (double t = 0.0; t < 5.0; t += 0.1) EXPECT_NEAR(imu.ImuTime(imu.PoseTime(t)), t, 1e-10);
}

SimulatorOptions Recording(uint32_t seed) {
  SimulatorOptions options;
  options.seed = seed;
  options.duration_s = 80.0;
  options.position_std = 3e-4;
  options.clock_drift = 1e-5;
  return options;
}

/// [s] Beyond the truth, relative to the sigma that is reported; the seconds around a step left
/// out.
double LargestError(const Calibration& result, const SimulatorOptions& truth) {
  const Solution& solution = *result.solution;
  const ImuSessionEstimate& imu = solution.estimate.sessions[0].imus[0];
  const ClockOffsets& clock = result.sessions[0].imus[0].clock;
  const double epochs =
      1e-9 * static_cast<double>(solution.pose_epochs_ns[0] - solution.imus[0][0].epoch_ns);
  const double middle = 0.5 * truth.duration_s;
  double largest = 0.0;
  for (size_t k = 0; k < clock.t.size(); ++k) {
    const double t = imu.walk.t[k];
    if (t < 0.0 || t > truth.duration_s || std::abs(t - 0.45 * truth.duration_s) < 1.5) continue;
    const double expected =
        truth.time_shift_s + truth.clock_drift * (t - middle) + Wander(truth, t);
    largest = std::max(largest, std::abs(epochs + imu.PoseTime(t) - t - expected) / clock.std[k]);
  }
  return largest;
}

/// Errors of the lever arm in sigmas.
double LargestLeverError(const Calibration& result, const SimulatorOptions& truth) {
  const ImuCalibration& imu = result.imus[0];
  return (imu.T_MI.p - truth.T_MI.p).cwiseQuotient(imu.Std().head<3>()).cwiseAbs().maxCoeff();
}

TEST(ClockWalk, AnEvenClockIsALine) {
  for (const double glitch : {0.0, 0.05}) {
    SimulatorOptions truth = Recording(3);
    SessionData data = Simulate(truth);
    // What a tracker does when markers come and go: wrong for half a second.
    for (PoseSample& pose : data.poses) {
      const double t = 1e-9 * static_cast<double>(pose.t_ns - data.poses[0].t_ns);
      if (std::fmod(t, 10.0) < 0.5)
        pose.q_WM = pose.q_WM * Eigen::Quaterniond(Eigen::AngleAxisd(glitch * std::sin(6.0 * t),
                                                                     Eigen::Vector3d::UnitX()));
    }
    const Calibration result = Calibrate({}, data);
    EXPECT_FALSE(result.sessions[0].imus[0].clock.wanders) << glitch;
    EXPECT_TRUE(result.sessions[0].imus[0].clock.steps.empty()) << glitch;
  }
}

TEST(ClockWalk, FollowsAClockThatWanders) {
  const Calibration even = Calibrate({}, Simulate(Recording(5)));
  for (const double amplitude : {1e-3, 5e-3}) {
    SimulatorOptions truth = Recording(5);
    truth.effects.imu_stream.wander_s = amplitude;
    const SessionData data = Simulate(truth);
    const Calibration result = Calibrate({}, data);
    EXPECT_TRUE(result.sessions[0].imus[0].clock.wanders);
    EXPECT_LT(LargestError(result, truth), 4.0) << amplitude;
    EXPECT_LT(LargestLeverError(result, truth), 4.0) << amplitude;
    EXPECT_LT(result.imus[0].Std().head<3>().norm(), 1.3 * even.imus[0].Std().head<3>().norm());

    CalibrationOptions options;
    options.estimate_clock_walk = false;
    const Calibration without = Calibrate(options, data);
    EXPECT_FALSE(without.sessions[0].imus[0].clock.wanders);
    EXPECT_GT(without.imus[0].Std().head<3>().norm(), 1.5 * result.imus[0].Std().head<3>().norm());
  }
}

TEST(ClockWalk, NamesSteps) {
  const Calibration even = Calibrate({}, Simulate(Recording(7)));
  for (const double step : {5e-3, -20e-3}) {
    SimulatorOptions truth = Recording(7);
    truth.effects.imu_stream.clock_step_s = step;
    const Calibration result = Calibrate({}, Simulate(truth));
    const ClockOffsets& clock = result.sessions[0].imus[0].clock;
    ASSERT_EQ(clock.steps.size(), 1u) << step;
    EXPECT_NEAR(clock.steps[0].size, -step, 0.1 * std::abs(step));
    EXPECT_NEAR(clock.steps[0].t - clock.t[0],
                0.45 * truth.duration_s - result.solution->estimate.sessions[0].imus[0].walk.t[0],
                0.03);
    EXPECT_LT(LargestLeverError(result, truth), 4.0) << step;
    EXPECT_LT(result.imus[0].Std().head<3>().norm(), 1.3 * even.imus[0].Std().head<3>().norm());
  }
  SimulatorOptions truth = Recording(7);
  truth.effects.pose_stream.clock_step_s = 20e-3;
  const Calibration result = Calibrate({}, Simulate(truth));
  EXPECT_TRUE(result.sessions[0].imus[0].clock.wanders);
  EXPECT_LT(LargestLeverError(result, truth), 4.0);
  EXPECT_LT(result.imus[0].Std().head<3>().norm(), 1.5 * even.imus[0].Std().head<3>().norm());
}

TEST(ClockWalk, ATimeShiftThatIsGivenIsKept) {
  SimulatorOptions truth = Recording(9);
  truth.effects.imu_stream.wander_s = 2e-3;
  CalibrationOptions options;
  options.estimate_time_shift = false;
  options.initial_time_shift = truth.time_shift_s;
  const Calibration result = Calibrate(options, Simulate(truth));
  EXPECT_NEAR(result.sessions[0].imus[0].time_shift, truth.time_shift_s, 1e-9);
  EXPECT_FALSE(result.sessions[0].imus[0].clock.wanders);
}

TEST(Gravity, IsFoundWhereItIsNotTheMean) {
  for (const double more : {-0.027, 0.025}) {
    SimulatorOptions truth = Recording(11);
    truth.effects.gravity = more;
    const Calibration result = Calibrate({}, Simulate(truth));
    EXPECT_LT(LargestLeverError(result, truth), 4.0) << more;
    const SessionCalibration& session = result.sessions[0];
    EXPECT_LT(std::abs(session.g_W.norm() - (truth.g_W.norm() + more)),
              4.0 * session.g_W_std.norm())
        << more;
    EXPECT_LT(session.g_W_std.norm(), 0.06);
  }
}

}  // namespace
}  // namespace imu_pose_calib
