#include "imu_pose_calib/ros/yaml_file.h"

#include <algorithm>
#include <filesystem>
#include <numeric>

#include "imu_pose_calib/core/types.h"

namespace imu_pose_calib {
namespace {

/// Levenshtein distance.
size_t EditDistance(const std::string& a, const std::string& b) {
  std::vector<size_t> row(b.size() + 1);
  std::iota(row.begin(), row.end(), size_t{0});
  for (const char letter : a) {
    size_t diagonal = row[0]++;
    for (size_t j = 0; j < b.size(); ++j) {
      const size_t replaced = diagonal + (letter == b[j] ? 0 : 1);
      diagonal = row[j + 1];
      row[j + 1] = std::min({replaced, row[j] + 1, row[j + 1] + 1});
    }
  }
  return row.back();
}

}  // namespace

YAML::Node LoadYaml(const std::string& path) {
  if (std::filesystem::is_directory(path)) throw InputError("is a directory, must be a YAML file");
  try {
    return YAML::LoadFile(path);
  } catch (const YAML::BadFile&) {
    throw InputError("cannot be read");
  } catch (const YAML::Exception& error) {
    throw InputError("line " + std::to_string(error.mark.line + 1) + ": " + error.msg);
  }
}

std::string Nearest(const std::string& name, const std::vector<std::string>& names) {
  return *std::min_element(
      names.begin(), names.end(), [&](const std::string& a, const std::string& b) {
        return EditDistance(name, a) < EditDistance(name, b);
      });
}

}  // namespace imu_pose_calib
