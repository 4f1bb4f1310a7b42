#include "imu_pose_calib/core/base/text.h"

#include <cmath>
#include <cstdio>

namespace imu_pose_calib {

std::string InWords(double value, const std::string& unit) {
  if (unit == "rad") return Number(180.0 / M_PI * value, "%.3g deg");
  return Number(1e3 * value, unit == "m" ? "%.3g mm" : "%.3g ms");
}

std::string Number(double value, const char* format) {
  char text[32];
  std::snprintf(text, sizeof(text), format, value);
  return text;
}

}  // namespace imu_pose_calib
