#include "imu_pose_calib/core/base/options.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <sstream>
#include <thread>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {
namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

/// Throws unless low <= value <= high, or 0 where that has a meaning of its own. NaN fails.
void CheckRange(const char* field, double value, double low, double high, bool or_zero = false) {
  if ((value >= low && value <= high) || (or_zero && value == 0.0)) return;
  std::ostringstream text;
  text << "option " << field << " = " << value << " is out of range: must be "
       << (or_zero ? "0 or " : "");
  if (high == kInfinity)
    text << "at least " << low;
  else
    text << "within [" << low << ", " << high << "]";
  throw InputError(text.str());
}

/// A value that is not to be estimated must be given.
void CheckGiven(const std::string& value, bool is_estimated, bool is_given) {
  if (!is_estimated && !is_given)
    throw InputError("option estimate_" + value + " = false needs a value to keep: give initial_" +
                     value);
}

}  // namespace

double CalibrationOptions::GravityMagnitude() const {
  if (initial_gravity) return initial_gravity->norm();
  if (!latitude) return gravity_magnitude;
  // Of the reference ellipsoid WGS 84, at sea level (Somigliana).
  const double sin2 = std::pow(std::sin(M_PI / 180.0 * *latitude), 2);
  return 9.7803253359 * (1.0 + 0.00193185265241 * sin2) / std::sqrt(1.0 - 0.00669437999013 * sin2);
}

double CalibrationOptions::GravityStd() const {
  constexpr double kUnknownHeight = 3e-3;  // of a kilometre
  return latitude ? std::min(kUnknownHeight, gravity_magnitude_std) : gravity_magnitude_std;
}

int CalibrationOptions::Threads() const {
  return num_threads > 0 ? num_threads
                         : std::max(1, static_cast<int>(std::thread::hardware_concurrency()));
}

void CalibrationOptions::Validate() const {
  CheckRange("position_unit", position_unit, 1e-9, 1e9);
  CheckRange("gyro_unit", gyro_unit, 1e-9, 1e9);
  CheckRange("accel_unit", accel_unit, 1e-9, 1e9);
  CheckRange("max_gap_s", max_gap_s, 0.0, 1e3);
  CheckRange("min_segment_s", min_segment_s, 0.0, 1e3);
  CheckRange("min_overlap_s", min_overlap_s, 1.0, 1e6);
  CheckRange("max_bad_fraction", max_bad_fraction, 0.0, 1.0);
  CheckRange("gyro_noise_density", gyro_noise_density, 1e-9, 1e3);
  CheckRange("accel_noise_density", accel_noise_density, 1e-9, 1e3);
  CheckRange("gyro_bias_walk", gyro_bias_walk, 1e-12, 1e3);
  CheckRange("accel_bias_walk", accel_bias_walk, 1e-12, 1e3);
  CheckRange("bias_knot_interval_s", bias_knot_interval_s, 1e-2, 1e9, true);
  CheckRange("position_lengthscale_s", position_lengthscale_s, 1e-3, 1e3, true);
  CheckRange("position_signal_std", position_signal_std, 0.0, 1e9);
  CheckRange("position_noise_std", position_noise_std, 0.0, 1e3);
  CheckRange("rotation_lengthscale_s", rotation_lengthscale_s, 1e-3, 1e3, true);
  CheckRange("rotation_signal_std", rotation_signal_std, 0.0, 1e3);
  CheckRange("rotation_noise_std", rotation_noise_std, 0.0, 1e3);
  CheckRange("outlier_threshold", outlier_threshold, 3.0, kInfinity);
  if (initial_time_shift) CheckRange("initial_time_shift", *initial_time_shift, -1e10, 1e10);
  if (initial_rotation)
    CheckRange("norm of initial_rotation", initial_rotation->norm(), 0.99, 1.01);
  if (initial_translation)
    CheckRange("norm of initial_translation", initial_translation->norm(), 0.0, 1e3);
  if (initial_gravity) CheckRange("norm of initial_gravity", initial_gravity->norm(), 0.1, 100.0);
  CheckGiven("time_shift", estimate_time_shift, initial_time_shift.has_value());
  CheckGiven("rotation", estimate_rotation, initial_rotation.has_value());
  CheckGiven("translation", estimate_translation, initial_translation.has_value());
  CheckGiven("gravity", estimate_gravity, initial_gravity.has_value());
  if (!estimate_time_shift && !estimate_rotation && !estimate_translation && !estimate_accel_delay)
    throw InputError("options estimate_* leave nothing to estimate: set at least one to true");
  CheckRange("knot_spacing_s", knot_spacing_s, 1e-3, 10.0, true);
  CheckRange("accel_delay", accel_delay, -0.5, 0.5);
  CheckRange("gravity_magnitude", gravity_magnitude, 0.1, 100.0);
  CheckRange("gravity_magnitude_std", gravity_magnitude_std, 1e-9, 10.0);
  if (latitude) CheckRange("latitude", *latitude, -90.0, 90.0);
  CheckRange("robust_loss_scale", robust_loss_scale, 1.0, kInfinity);
  CheckRange("max_iterations", max_iterations, 1, 10000);
  CheckRange("max_factor_mb", max_factor_mb, 0.0, 1e6);
  CheckRange("num_threads", num_threads, 0, 1024);
  CheckRange("covariance_block_s", covariance_block_s, 0.1, 1e6, true);
  CheckRange("weak_rotation_std", weak_rotation_std, 1e-9, 1.0);
  CheckRange("weak_translation_std", weak_translation_std, 1e-9, 10.0);
  CheckRange("weak_time_shift_std", weak_time_shift_std, 1e-9, 1.0);
}

}  // namespace imu_pose_calib
