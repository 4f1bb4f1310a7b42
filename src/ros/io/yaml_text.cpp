#include "imu_pose_calib/ros/io/yaml_text.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>

namespace imu_pose_calib {

std::string YamlNumber(double value) {
  if (std::isnan(value)) return ".nan";
  if (std::isinf(value)) return value > 0 ? ".inf" : "-.inf";
  char buffer[32];
  for (int digits = 15; digits <= 17; ++digits) {
    std::snprintf(buffer, sizeof(buffer), "%.*g", digits, value);
    if (std::strtod(buffer, nullptr) == value) break;
  }
  // YAML 1.1 takes "1" for an integer and "1e-05" for a string.
  std::string text = buffer;
  if (text.find('.') == std::string::npos) text.insert(std::min(text.find('e'), text.size()), ".0");
  return text;
}

std::string SecondsText(int64_t t_ns) {
  const std::lldiv_t parts = std::lldiv(t_ns, 1'000'000'000);
  char text[48];
  std::snprintf(text, sizeof(text), "%s%lld.%09lld", t_ns < 0 ? "-" : "", std::llabs(parts.quot),
                std::llabs(parts.rem));
  return text;
}

std::string UtcText(std::time_t time, const char* format) {
  std::tm utc{};
  char text[32];
  std::strftime(text, sizeof(text), format, gmtime_r(&time, &utc));
  return text;
}

}  // namespace imu_pose_calib
