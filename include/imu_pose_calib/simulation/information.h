#pragma once

#include <vector>

#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/ground_truth/trajectory.h"
#include "imu_pose_calib/simulation/simulator_options.h"

namespace imu_pose_calib {

// What recordings can tell of a calibration, by their Fisher information. No code is shared with
// the solve.

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
  /// of the accelerometer.
  ErrorNorms as_joint;
};

/// Bounds for recordings of one rig whose noises are those of `truths` and whose stamps are those
/// of `recordings`, with derivatives in closed form at the truth. The trajectory is a spline of
/// knots `knots_s` [s] apart. Effects of `truths` are not taken into account.
ErrorBounds FindErrorBounds(const std::vector<SimulatorOptions>& truths,
                            const std::vector<SessionData>& recordings, double knots_s = 0.05);

/// How the sigmas of one IMU shrink while more of a session is used.
struct InformationGrowth {
  std::vector<double> share;  ///< (0..1] of the session, increasing, the last is 1
  /// Sigmas at each share: translation [m], rotation [rad], time_shift [s], accel_delay [s]; at 1
  /// those of the result, so 0 throughout for what is not estimated.
  std::vector<Eigen::Matrix<double, 8, 1>> std;
};

/// By the motion from `begin` to `end` [s, pose clock]: what the samples of gyroscope and
/// accelerometer tell of the calibration beside gravity and constant biases on a trajectory that is
/// known, brought to the sigmas of the result. What the trajectory's own errors cost is taken to be
/// the same share throughout.
InformationGrowth GrowInformation(const Calibration& result, size_t session, size_t imu,
                                  const SessionTrajectory& trajectory, double begin, double end);

}  // namespace imu_pose_calib
