#pragma once

#include <yaml-cpp/yaml.h>

#include <string>
#include <vector>

namespace imu_pose_calib {

/// The text of the file at `path`, at most `max_size` bytes. Throws InputError with the reason,
/// without the path.
std::string ReadYamlFile(const std::string& path, size_t max_size = 100'000);

/// The first document of a YAML text. Throws InputError naming the line when the text is not YAML
/// or nests deeper than 20 levels, on which a parser could exhaust the stack.
YAML::Node ParseYaml(const std::string& text);

/// The one of `names` with the smallest edit distance to `name`.
std::string Nearest(const std::string& name, const std::vector<std::string>& names);

}  // namespace imu_pose_calib
