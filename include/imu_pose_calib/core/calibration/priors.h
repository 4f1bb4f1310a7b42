#pragma once

#include <cmath>

#include "imu_pose_calib/core/base/options.h"

namespace imu_pose_calib {

// Sigmas of ordinary clocks, trackers and IMUs; kDriftPrior is in options.h.
constexpr double kDelayPrior = 0.02;              // [s] of accel_delay
constexpr double kPoseScalePrior = 1e-3;          // [1]
constexpr double kScalePrior = 0.01;              // [1] diagonal of K_g and K_a
constexpr double kAlignmentPrior = M_PI / 360.0;  // [rad] their other elements: 0.5 deg
constexpr double kSizePrior = 2e-3;               // [m] places of the accelerometer's axes
// Widths of peaks, see PeakSigma(): most have none, others have much.
constexpr double kSmoothingPrior = 1e-5;                   // [s^2] of poses and IMUs
constexpr double kCompliancePrior = 1e-6;                  // [s^2] of mounts
constexpr double kThirdPrior = 1e-6, kFourthPrior = 1e-7;  // [s^3], [s^4] cumulants of poses
constexpr double kPositionDelayPrior = 8e-5;               // [s]
/// How much must speak for a delay of positions, whose peak has a sigma of 0.02 ms: slow errors of
/// rotations look like one by four sigma.
constexpr double kPositionDelayDoubt = 8.0;

/// Sigma of the Gaussian prior that pulls as a peak with heavy tails does, where the parameter is
/// x: doubt log(1 + x^2 / scale^2) has the slope of x^2 / (2 sigma^2). Cauchy's: 1.
inline double PeakSigma(double scale, double x, double doubt = 1.0) {
  return std::hypot(scale, x) / std::sqrt(2.0 * doubt);
}

}  // namespace imu_pose_calib
