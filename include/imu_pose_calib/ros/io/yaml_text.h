#pragma once

#include <string>

namespace imu_pose_calib {

/// Shortest text that reads back as `value` and that YAML 1.1 and 1.2 both take for a float.
std::string YamlNumber(double value);

}  // namespace imu_pose_calib
