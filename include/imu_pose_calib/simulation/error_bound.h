#pragma once

#include <vector>

#include "imu_pose_calib/simulation/simulator_options.h"

namespace imu_pose_calib {

/// Sigmas, or errors, of a calibration: norms over the axes of p_MI and R_MI.
struct ErrorNorms {
  double translation = 0.0;  ///< [m]
  double rotation = 0.0;     ///< [rad]
  double time_shift = 0.0;   ///< [s] of the first recording
  double accel_delay = 0.0;  ///< [s]
};

/// Cramér-Rao bounds: what no unbiased estimate can beat.
struct ErrorBounds {
  /// Of T_MI, clocks, gravity, biases and trajectory, when all else is known.
  ErrorNorms least;
  /// When the rest is unknown, too, that the joint solve estimates by default, as far as its priors
  /// say: drift of the clock, scale and misalignment, scale and smoothing of the poses, smoothing
  /// of the accelerometer; but for the mount, which is taken to be stiff.
  ErrorNorms as_joint;
};

/// Bounds for recordings of one rig whose noises are those of `truths` and whose stamps are those
/// of `recordings`, by the Fisher information with derivatives in closed form at the truth; no code
/// is shared with the solve. The trajectory is a spline of knots `knots_s` [s] apart. Effects of
/// `truths` are not taken into account.
ErrorBounds FindErrorBounds(const std::vector<SimulatorOptions>& truths,
                            const std::vector<SessionData>& recordings, double knots_s = 0.05);

}  // namespace imu_pose_calib
