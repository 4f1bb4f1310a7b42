#include "imu_pose_calib/core/base/options.h"

#include <algorithm>
#include <cmath>
#include <sstream>
#include <thread>
#include <type_traits>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {
namespace {

/// Throws unless the value is within the bound. NaN fails.
void Check(const std::string& field, double value, const Bound& bound) {
  if ((value >= bound.low && value <= bound.high) || (bound.or_zero && value == 0.0)) return;
  std::ostringstream text;
  text << "option " << field << " = " << value << " is out of range: must be ";
  if (std::isinf(bound.high))
    text << "at least " << bound.low;
  else
    text << (bound.or_zero ? "0 or " : "") << "within [" << bound.low << ", " << bound.high << "]";
  throw InputError(text.str());
}
template <typename T>
void Check(const std::string& field, const std::optional<T>& value, const Bound& bound) {
  if (!value) return;
  if constexpr (std::is_same_v<T, double>)
    Check(field, *value, bound);
  else
    Check("norm of " + field, value->norm(), bound);
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
  VisitFields(*this, [](const char* name, const auto& field, const Bound& bound) {
    if constexpr (!std::is_enum_v<std::decay_t<decltype(field)>>) Check(name, field, bound);
  });
  CheckGiven("time_shift", estimate_time_shift, initial_time_shift.has_value());
  CheckGiven("rotation", estimate_rotation, initial_rotation.has_value());
  CheckGiven("translation", estimate_translation, initial_translation.has_value());
  CheckGiven("gravity", estimate_gravity, initial_gravity.has_value());
  if (!estimate_time_shift && !estimate_rotation && !estimate_translation && !estimate_accel_delay)
    throw InputError("options estimate_* leave nothing to estimate: set at least one to true");
}

}  // namespace imu_pose_calib
