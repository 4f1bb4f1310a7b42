#pragma once

#include <string>

namespace imu_pose_calib {

/// "123.4 mm", "0.1234 deg" or "0.1234 ms" of a value in m, rad or s.
std::string InWords(double value, const std::string& unit);
/// By a format of printf for one double, such as "%.1f sigma"; 31 characters at most.
std::string Number(double value, const char* format = "%.4g");

}  // namespace imu_pose_calib
