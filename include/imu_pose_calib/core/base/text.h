#pragma once

#include <sstream>
#include <string>

namespace imu_pose_calib {

/// "123.4 mm", "0.1234 deg" or "0.1234 ms" of a value in m, rad or s.
std::string InWords(double value, const std::string& unit);
/// By a format of printf for one double, such as "%.1f sigma"; 31 characters at most.
std::string Number(double value, const char* format = "%.4g");

/// Throws an Error whose text is all of these, as a stream writes them.
template <typename Error, typename... Args>
[[noreturn]] void Throw(const Args&... args) {
  std::ostringstream text;
  (text << ... << args);
  throw Error(text.str());
}

}  // namespace imu_pose_calib
