#include <gtest/gtest.h>

#include <ctime>

#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/ground_truth/trajectory.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

/// [s] of processor time.
double Elapsed(clockid_t clock) {
  timespec now{};
  clock_gettime(clock, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

/// Share of the processor time of `work` that other threads spend.
template <typename Work>
double ShareOfOthers(const Work& work) {
  const double all = Elapsed(CLOCK_PROCESS_CPUTIME_ID), own = Elapsed(CLOCK_THREAD_CPUTIME_ID);
  work();
  return 1.0 - (Elapsed(CLOCK_THREAD_CPUTIME_ID) - own) / (Elapsed(CLOCK_PROCESS_CPUTIME_ID) - all);
}

TEST(NumThreads, OneIsTheCallersAlone) {
  SimulatorOptions truth;
  truth.duration_s = 12.0;
  SessionData data = Simulate(truth);
  // Two segments, the second turned: the trajectory is built again without it.
  for (size_t i = 1000; i < data.poses.size(); ++i) {
    data.poses[i].t_ns += 500'000'000;
    data.poses[i].q_WM = data.poses[i].q_WM * Eigen::Quaterniond(0.0, 1.0, 0.0, 0.0);
  }
  // First: the threads of a Ceres with OpenMP stay, and wait for more work by spinning.
  CalibrationOptions options;
  options.num_threads = 1;
  for (const Method method : {Method::kJoint, Method::kGp}) {
    options.method = method;
    EXPECT_LT(ShareOfOthers([&] { Calibrate(options, data); }), 1e-3);
  }
  options.num_threads = 2;
  for (const Method method : {Method::kJoint, Method::kGp}) {
    options.method = method;
    EXPECT_GT(ShareOfOthers([&] { Calibrate(options, data); }), 0.02);
  }
}

/// How the work is shared out, and what of it is done twice for want of memory, changes no digit.
TEST(NumThreads, ChangeNoDigit) {
  SimulatorOptions truth;
  truth.duration_s = 20.0;
  const SessionData data = Simulate(truth);
  CalibrationOptions options;
  options.num_threads = 1;
  const Calibration expected = Calibrate(options, data);
  options.num_threads = 3;
  const Calibration shared = Calibrate(options, data);
  options.max_factor_mb = 0.0;
  const Calibration twice = Calibrate(options, data);
  for (const Calibration* other : {&shared, &twice}) {
    EXPECT_EQ(other->imus[0].T_MI.Matrix(), expected.imus[0].T_MI.Matrix());
    EXPECT_EQ(other->imus[0].covariance, expected.imus[0].covariance);
    EXPECT_EQ(other->sessions[0].g_W, expected.sessions[0].g_W);
    EXPECT_EQ(other->solution->splines[0].phi, expected.solution->splines[0].phi);
  }
  EXPECT_NO_THROW(TrajectoryCovariance{shared.solution});
  EXPECT_THROW(TrajectoryCovariance{twice.solution}, InputError);
}

}  // namespace
}  // namespace imu_pose_calib
