#pragma once

#include <cmath>
#include <cstdio>
#include <sstream>
#include <string>

namespace imu_pose_calib {

/// By a format of printf for one double, such as "%.1f sigma"; 31 characters at most.
inline std::string Number(double value, const char* format = "%.4g") {
  char text[32];
  std::snprintf(text, sizeof(text), format, value);
  return text;
}

/// "123.4 mm", "0.1234 deg" or "0.1234 ms" of a value in m, rad or s.
inline std::string InWords(double value, const std::string& unit) {
  if (unit == "rad") return Number(180.0 / M_PI * value, "%.3g deg");
  return Number(1e3 * value, unit == "m" ? "%.3g mm" : "%.3g ms");
}

/// Throws an Error whose text is all of these, as a stream writes them.
template <typename Error, typename... Args>
[[noreturn]] void Throw(const Args&... args) {
  std::ostringstream text;
  (text << ... << args);
  throw Error(text.str());
}

}  // namespace imu_pose_calib
