#pragma once

#include <vector>

#include "imu_pose_calib/core/correction_splines.h"
#include "imu_pose_calib/core/least_squares.h"

namespace imu_pose_calib {

/// Noise per sample at the averaging time `tau` [s]: Allan deviation between neighbouring means
/// over tau, times the root of the samples in tau. White noise has the same at every tau; noise
/// that is stronger at low frequencies has more at long ones. It sees frequencies around
/// 0.37 / tau.
///
/// The two windows of the means slide with the samples, and a sample at the end of a window counts
/// by the part of its time that is within: no choice of bins, of the origin of t or of rounding
/// moves the result.
///
/// t: [s], not decreasing; windows that samples do not cover by three quarters are left out. x: as
/// many, of the same unit as the result. The spread is the median's, so outliers do not count. 0
/// when there is no room for ten pairs of windows side by side.
double AllanNoise(const std::vector<double>& t, const std::vector<Eigen::Vector3d>& x, double tau);

/// Sets the share of each sensor's degrees of freedom that a session's splines use up, doc/math.md,
/// S4, "Degrees of freedom".
void ShareFreedom(const CorrectionSplines& splines, size_t session, LeastSquares* joint);

/// Whether the poses tell more of a session's positions than the accelerometers, in the mean over
/// the band of the splines.
bool DoPosesLead(const CorrectionSplines& splines, size_t session, const LeastSquares& joint);

/// Sets the information that the trajectories feign, doc/math.md Eq. (18).
void FeignInformation(const std::vector<CorrectionSplines>& splines, LeastSquares* joint);

/// Robust weights of the samples by the last residuals in units of the noise of `models`,
/// doc/math.md, S4, "Passes".
void UpdateWeights(const LeastSquares& joint,
                   const std::vector<CorrectionSplines>& splines,
                   std::vector<SensorModel>* models);

/// Noise of each sensor at the frequencies where poses and IMU meet over its spread per sample, at
/// least 1: 1 when it is white. From the last residuals; doc/math.md, S4, "Colour".
std::vector<double> NoiseColor(const LeastSquares& joint,
                               const std::vector<SensorStatistics>& statistics);

/// The same of IMU sensors that vibrate beyond the band: below 1; else 1. Where the spread is what
/// weighs them, or the trajectory would follow them there.
std::vector<double> NoiseInBand(const LeastSquares& joint,
                                const std::vector<CorrectionSplines>& splines,
                                const std::vector<SensorStatistics>& statistics);

}  // namespace imu_pose_calib
