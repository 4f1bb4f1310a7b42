#pragma once

/// Room simulation: recordings with exact truth, for tests, simulate_bag and evaluate_trial.
/// In: options and effects that real recordings have. Out: SessionData, the truth, and the
/// Cramér-Rao bound of what can be known. Calibrate() needs none of it.

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/simulation/real_effects.h"
#include "imu_pose_calib/simulation/simulator_options.h"
#include "imu_pose_calib/simulation/true_trajectory.h"

namespace imu_pose_calib {

/// What a calibration should find: `time_shift_s` and `accel_delay_s` with the delays of the
/// sensors' filters and the mean lateness of the stamps.
struct TrueClock {
  double time_shift_s, accel_delay_s;

  explicit TrueClock(const SimulatorOptions& options);
};

/// [s] by how much the offset of the clocks exceeds a line, `t` [s] after the first sample.
double Wander(const SimulatorOptions& options, double t);

/// IMU number `imu` on the body of `first`, which is number 0: 0.2 m further along x each, turned,
/// and with a clock, a delay and noise of its own.
SimulatorOptions FurtherImu(SimulatorOptions first, size_t imu);

/// Poses and the samples of one or several IMUs; the same options give the same data.
SessionData Simulate(const SimulatorOptions& options, size_t imus = 1);

}  // namespace imu_pose_calib
