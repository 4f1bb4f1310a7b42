#pragma once

#include <ceres/cost_function.h>

#include <Eigen/Core>
#include <cmath>
#include <memory>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/calibration/estimate.h"

namespace imu_pose_calib {

// Sigmas of ordinary clocks, trackers and IMUs; kDriftPrior is in options.h.
constexpr double kDelayPrior = 0.02;              // [s] of accel_delay
constexpr double kPoseScalePrior = 1e-3;          // [1]
constexpr double kScalePrior = 0.01;              // [1] diagonal of K_g and K_a
constexpr double kAlignmentPrior = M_PI / 360.0;  // [rad] their other elements: 0.5 deg
constexpr double kSizePrior = 2e-3;               // [m] places of the accelerometer's axes
// Sigmas of what most have none of and others much, see MatchPeaks().
constexpr double kSmoothingPeak = 7e-6;                  // [s^2] of poses and IMUs
constexpr double kCompliancePeak = 7e-7;                 // [s^2] of mounts
constexpr double kThirdPeak = 7e-7, kFourthPeak = 7e-8;  // [s^3], [s^4] cumulants of poses
constexpr double kPositionDelayPeak = 1.5e-5;            // [s]

/// [s^2] of an accelerometer that is so late [s]: a filter averages over no more than about the
/// time by which it delays.
inline double AccelSmoothingPeak(double delay) { return std::hypot(kSmoothingPeak, delay * delay); }

/// Gaussian prior of one component of a parameter.
struct GaussianPrior {
  double mean = 0.0, std = 0.0;  ///< std 0: nothing is known
};

/// What is known of a component that has no peak; those of matrices are in rows, or in rows of the
/// lower triangle.
GaussianPrior PriorOf(const Parameter& p, int component, const CalibrationOptions& options);

/// Whether most have none of it and others have much.
bool HasPeak(ParameterKind kind);

/// A factor as a residual A x - b of the parameters that have a peak, in their order.
std::unique_ptr<ceres::CostFunction> PeakPriors(const std::vector<Parameter>& parameters,
                                                const GaussianFactor& factor);

/// The narrowest Gaussian of each prior, to begin with; `parameters`: those that have a peak.
GaussianFactor FirstPeaks(const Estimate& estimate, const std::vector<Parameter>& parameters);

/// Moment matching (doc/math.md, S4, "Peaks"): a factor with which the parameters that have peaks
/// get the mean and the covariance that they have with priors
///   sum_k 10^-k N(0, (10^k peak)^2), k = 0 .. 3,
/// where all else says what it does. `covariance`: of all `parameters`, one after the other, as the
/// solve with estimate.peaks has it.
GaussianFactor MatchPeaks(const Estimate& estimate, const std::vector<Parameter>& parameters,
                          const Eigen::MatrixXd& covariance);

}  // namespace imu_pose_calib
