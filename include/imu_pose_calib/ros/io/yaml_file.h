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

// --- Values of a node, there or not, which errors call `what` ---

/// Must be finite.
void ReadYaml(const std::string& what, const YAML::Node& node, double* value);
void ReadYaml(const std::string& what, const YAML::Node& node, size_t* value);
void ReadYaml(const std::string& what, const YAML::Node& node, std::string* value);
/// See UnitQuaternion().
void ReadYaml(const std::string& what, const YAML::Node& node, Eigen::Quaterniond* value);

/// A list of numbers, or of rows.
template <int kRows, int kColumns>
void ReadYaml(const std::string& what, const YAML::Node& rows,
              Eigen::Matrix<double, kRows, kColumns>* value) {
  constexpr bool kIsVector = kColumns == 1;
  const auto check = [&](const YAML::Node& list, size_t size, const char* of) {
    if (!list || !list.IsSequence() || list.size() != size)
      Reject(what, kIsVector ? " must be a list of " : " must have ", size, of);
  };
  check(rows, kRows, kIsVector ? " numbers" : " rows");
  for (int i = 0; i < kRows; ++i) {
    if (!kIsVector) check(rows[i], kColumns, " columns");
    for (int j = 0; j < kColumns; ++j)
      ReadYaml(what, kIsVector ? rows[i] : rows[i][j], &(*value)(i, j));
  }
}

/// A transform as four rows of four numbers.
Rigid3 ReadMatrix(const std::string& what, const YAML::Node& rows);

/// Normalized when it is within 1 % of a unit quaternion; else InputError.
Eigen::Quaterniond UnitQuaternion(const std::string& what, const Eigen::Vector4d& xyzw);

/// "; did you mean 'x'?": the one of `names` that is a typing error away from `name`; else nothing.
std::string DidYouMean(const std::string& name, const std::vector<std::string>& names);

}  // namespace imu_pose_calib
