#include "imu_pose_calib/ros/io/ros_options.h"

#include <set>
#include <sstream>
#include <vector>

#include "imu_pose_calib/core/result.h"
#include "imu_pose_calib/core/types.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/yaml_file.h"

namespace imu_pose_calib {
namespace {

constexpr Method kMethods[] = {Method::kJoint, Method::kGp};

/// The value of a key is not of the type of its field.
struct TypeError {
  std::string expected;
};

template <typename T>
T ReadScalar(const YAML::Node& node, const char* expected) {
  T value{};
  if (!node.IsScalar() || !YAML::convert<T>::decode(node, value)) throw TypeError{expected};
  return value;
}

Eigen::VectorXd ReadNumbers(const YAML::Node& node, size_t count, const char* expected) {
  if (!node.IsSequence() || node.size() != count) throw TypeError{expected};
  Eigen::VectorXd values(static_cast<Eigen::Index>(count));
  for (size_t i = 0; i < count; ++i)
    values[static_cast<Eigen::Index>(i)] = ReadScalar<double>(node[i], expected);
  return values;
}

void Read(const YAML::Node& node, double* field) { *field = ReadScalar<double>(node, "a number"); }
void Read(const YAML::Node& node, int* field) { *field = ReadScalar<int>(node, "an integer"); }
void Read(const YAML::Node& node, bool* field) { *field = ReadScalar<bool>(node, "true or false"); }
void Read(const YAML::Node& node, Method* field) {
  *field = ParseMethod(ReadScalar<std::string>(node, "a string"));
}
void Read(const YAML::Node& node, ImuModel* field) {
  const auto name = ReadScalar<std::string>(node, "a string");
  for (const ImuModel model : {ImuModel::kCalibrated, ImuModel::kScaleMisalignment}) {
    if (name != ToString(model)) continue;
    *field = model;
    return;
  }
  throw TypeError{"calibrated or scale_misalignment"};
}
void Read(const YAML::Node& node, StampRecovery* field) {
  const auto name = ReadScalar<std::string>(node, "a string");
  for (const StampRecovery mode :
       {StampRecovery::kAuto, StampRecovery::kAlways, StampRecovery::kNever}) {
    if (name != ToString(mode)) continue;
    *field = mode;
    return;
  }
  throw TypeError{"auto, always or never"};
}
void Read(const YAML::Node& node, Eigen::Vector3d* field) {
  *field = ReadNumbers(node, 3, "[x, y, z]");
}
void Read(const YAML::Node& node, Eigen::Quaterniond* field) {
  field->coeffs() = ReadNumbers(node, 4, "[x, y, z, w]");
}
template <typename T>
void Read(const YAML::Node& node, std::optional<T>* field) {
  field->reset();
  if (!node.IsNull()) Read(node, &field->emplace());
}

template <typename Vector>
std::string NumbersText(const Vector& values) {
  std::string text;
  for (Eigen::Index i = 0; i < values.size(); ++i)
    text += (i == 0 ? "[" : ", ") + YamlNumber(values[i]);
  return text + "]";
}

std::string Text(double value) { return YamlNumber(value); }
std::string Text(int value) { return std::to_string(value); }
std::string Text(bool value) { return value ? "true" : "false"; }
std::string Text(Method value) { return ToString(value); }
std::string Text(ImuModel value) { return ToString(value); }
std::string Text(StampRecovery value) { return ToString(value); }
std::string Text(const Eigen::Vector3d& value) { return NumbersText(value); }
std::string Text(const Eigen::Quaterniond& value) { return NumbersText(value.coeffs()); }
template <typename T>
std::string Text(const std::optional<T>& value) {
  return value ? Text(*value) : "~";
}

std::string NearestKey(const std::string& key) {
  std::vector<std::string> names;
  VisitFields(CalibrationOptions(),
              [&](const char* name, const auto&) { names.emplace_back(name); });
  return Nearest(key, names);
}

/// Sets the field called `key`.
void ReadField(const std::string& key, const YAML::Node& value, CalibrationOptions* options) {
  bool found = false;
  VisitFields(*options, [&](const std::string& name, auto& field) {
    if (name != key) return;
    found = true;
    Read(value, &field);
  });
  if (!found)
    throw InputError("there is no option '" + key + "'; did you mean '" + NearestKey(key) + "'?");
}

void ReadMap(const YAML::Node& map, CalibrationOptions* options) {
  if (map.IsNull()) return;  // empty file
  if (!map.IsMap()) throw InputError("must be a map of 'option: value' lines");
  std::set<std::string> seen;
  for (const auto& entry : map) {
    const std::string key = ReadScalar<std::string>(entry.first, "a string");
    if (!seen.insert(key).second) throw InputError("option '" + key + "' is given twice");
    try {
      ReadField(key, entry.second, options);
    } catch (const TypeError& error) {
      const std::string value = entry.second.IsNull() ? "nothing" : YAML::Dump(entry.second);
      throw InputError("option " + key + " must be " + error.expected + ", not " + value);
    }
  }
}

}  // namespace

Method ParseMethod(const std::string& name) {
  std::string known;
  for (const Method method : kMethods) {
    if (name == ToString(method)) return method;
    known += (known.empty() ? "" : ", ") + std::string(ToString(method));
  }
  throw InputError("method '" + name + "' does not exist; available: " + known);
}

CalibrationOptions ParseOptions(const std::string& yaml) {
  CalibrationOptions options;
  try {
    ReadMap(ParseYaml(yaml), &options);
  } catch (const TypeError&) {
    throw InputError("keys must be strings");
  }
  options.Validate();
  return options;
}

CalibrationOptions LoadOptions(const std::string& yaml_path) {
  try {
    return ParseOptions(ReadYamlFile(yaml_path));
  } catch (const InputError& error) {
    throw InputError("config '" + yaml_path + "': " + error.what());
  }
}

std::string ToYaml(const CalibrationOptions& options) {
  std::ostringstream text;
  VisitFields(options, [&](const char* name, const auto& field) {
    text << name << ": " << Text(field) << "\n";
  });
  return text.str();
}

}  // namespace imu_pose_calib
