#pragma once

#include <yaml-cpp/yaml.h>

#include <string>
#include <vector>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {

/// The text of the file at `path`, at most 10 MB. Throws InputError with the reason, without the
/// path.
std::string ReadYamlFile(const std::string& path);

/// The first document of a YAML text. Throws InputError naming the line when the text is not YAML
/// or nests deeper than 20 levels, on which a parser could exhaust the stack.
YAML::Node ParseYaml(const std::string& text);

/// What `parse(text)` makes of the file at `path`, with errors that begin "WHAT 'PATH': ".
template <typename Parse>
auto LoadYaml(const std::string& what, const std::string& path, Parse parse) {
  try {
    return parse(ReadYamlFile(path));
  } catch (const InputError& error) {
    Reject(what, " '", path, "': ", error.what());
  }
}

/// "; did you mean 'x'?": the one of `names` that is a typing error away from `name`; else nothing.
std::string DidYouMean(const std::string& name, const std::vector<std::string>& names);

}  // namespace imu_pose_calib
