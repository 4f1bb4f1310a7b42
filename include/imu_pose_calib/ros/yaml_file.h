#pragma once

#include <yaml-cpp/yaml.h>

#include <string>
#include <vector>

namespace imu_pose_calib {

/// The content of a YAML file. InputError, without the path, when it is none.
YAML::Node LoadYaml(const std::string& path);

/// The one of `names` with the smallest edit distance to `name`.
std::string Nearest(const std::string& name, const std::vector<std::string>& names);

}  // namespace imu_pose_calib
