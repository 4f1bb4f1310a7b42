#pragma once

#include <vector>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// Calibrations, halves of a recording and sessions agree when no component differs by more than
/// this many sigma.
constexpr double kAgreementBound = 5.0;

/// A calibration of one IMU as it is compared with others. A sigma of 0: given, not estimated.
struct Comparable {
  Rigid3 T_MI;
  /// Of (p_MI [m] in M, small rotation [rad] about the imu axes).
  Matrix6d covariance = Matrix6d::Zero();
  double accel_delay = 0.0, accel_delay_std = 0.0;  ///< [s]
  double time_shift = 0.0, time_shift_std = 0.0;    ///< [s] of the same instant in all
};

/// The quantities that are compared.
enum class ComparedQuantity { kTranslation, kRotation, kAccelDelay, kTimeShift };

/// "translation", "rotation", "accel delay", "time shift".
const char* ToString(ComparedQuantity quantity);

/// Difference of one component.
struct Difference {
  ComparedQuantity quantity;
  int axis;       ///< 0 to 2, of M or, for rotations, of the IMU; 0 for the scalars
  double value;   ///< [m, rad, s]
  double sigma;   ///< of the difference; 0: neither is estimated, so nothing is judged
  double sigmas;  ///< |value| / sigma
};

/// Second calibration less the first, taken as independent.
struct Comparison {
  std::vector<Difference> components;
  double chi2 = 0.0;  ///< of the quantities that are judged, their components' covariances included
  int dof = 0;
  double distance = 0.0, angle = 0.0;  ///< [m], [rad]

  /// The component with most sigmas; null when none is judged.
  const Difference* Worst() const;
};

Comparison Compare(const Comparable& first, const Comparable& second,
                   const std::vector<ComparedQuantity>& quantities);

/// Mean weighted by the inverse covariances of each quantity. One without them in some calibration
/// has the plain mean, and sigma 0.
Comparable Mean(const std::vector<Comparable>& calibrations);

/// How one quantity scatters among calibrations.
struct Scatter {
  ComparedQuantity quantity;
  Eigen::VectorXd deviation;  ///< standard deviation of each component about the plain mean
  Eigen::VectorXd sigma;      ///< root mean square of the sigmas
  double chi2 = 0.0;          ///< about the weighted mean; with `dof` 0 not judged
  int dof = 0;
};

/// At least two calibrations of one rig.
struct Repeatability {
  Comparable mean;
  std::vector<Scatter> scatters;
  std::vector<Comparison> from_others;  ///< each less the mean of all others
};

Repeatability Repeat(const std::vector<Comparable>& calibrations,
                     const std::vector<ComparedQuantity>& quantities);

}  // namespace imu_pose_calib
