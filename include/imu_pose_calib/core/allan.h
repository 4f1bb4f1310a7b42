#pragma once

#include <Eigen/Core>
#include <vector>

namespace imu_pose_calib {

/// Noise per sample at the averaging time `tau` [s]: Allan deviation between neighbouring means
/// over tau, times the root of the samples in tau. White noise has the same at every tau; noise
/// that is stronger at low frequencies has more at long ones. It sees frequencies around
/// kAllanBand / tau.
///
/// The two windows of the means slide with the samples, and a sample at the end of a window counts
/// by the part of its time that is within: no choice of bins, of the origin of t or of rounding
/// moves the result.
///
/// t: [s], not decreasing; windows that samples do not cover by three quarters are left out. x: as
/// many, of the same unit as the result. The spread is the median's, so outliers do not count. 0
/// when there is no room for ten pairs of windows side by side.
double AllanNoise(const std::vector<double>& t, const std::vector<Eigen::Vector3d>& x, double tau);

/// Frequency [Hz] times tau [s] at which the Allan deviation is most sensitive.
constexpr double kAllanBand = 0.37;

}  // namespace imu_pose_calib
