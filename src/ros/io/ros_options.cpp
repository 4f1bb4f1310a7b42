#include "imu_pose_calib/ros/io/ros_options.h"

#include <algorithm>
#include <set>
#include <sstream>
#include <vector>

#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/recording.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/io/yaml_file.h"

namespace imu_pose_calib {
namespace {

// Read the value of a key, which errors call `what`.

[[noreturn]] void Refuse(const std::string& what, const YAML::Node& node, const char* expected) {
  Reject(what, " must be ", expected, ", not ", (node.IsNull() ? "nothing" : YAML::Dump(node)));
}

template <typename T>
T ReadScalar(const std::string& what, const YAML::Node& node, const char* expected) {
  T value{};
  if (!node.IsScalar() || !YAML::convert<T>::decode(node, value)) Refuse(what, node, expected);
  return value;
}

/// The value of that name; `known` are all names.
template <typename Enum>
Enum ReadName(const std::string& what, const YAML::Node& node, std::initializer_list<Enum> values,
              const char* known) {
  const auto name = ReadScalar<std::string>(what, node, "a string");
  for (const Enum value : values)
    if (name == ToString(value)) return value;
  Reject(what, " '", name, "' does not exist; available: ", known);
}

void Read(const std::string& what, const YAML::Node& node, double* field) {
  *field = ReadScalar<double>(what, node, "a number");
}
void Read(const std::string& what, const YAML::Node& node, int* field) {
  *field = ReadScalar<int>(what, node, "an integer");
}
void Read(const std::string& what, const YAML::Node& node, bool* field) {
  *field = ReadScalar<bool>(what, node, "true or false");
}
void Read(const std::string& what, const YAML::Node& node, Method* field) {
  *field = ReadName(what, node, {Method::kJoint, Method::kGp}, "joint, gp");
}
void Read(const std::string& what, const YAML::Node& node, SolverKind* field) {
  *field = ReadName(what, node, {SolverKind::kWindows, SolverKind::kCeres}, "windows, ceres");
}
void Read(const std::string& what, const YAML::Node& node, ImuModel* field) {
  *field = ReadName(what, node, {ImuModel::kCalibrated, ImuModel::kScaleMisalignment},
                    "calibrated, scale_misalignment");
}
void Read(const std::string& what, const YAML::Node& node, StampRecovery* field) {
  *field =
      ReadName(what, node, {StampRecovery::kAuto, StampRecovery::kAlways, StampRecovery::kNever},
               "auto, always or never");
}
template <int kSize>
void Read(const std::string& what, const YAML::Node& node, Eigen::Matrix<double, kSize, 1>* field) {
  const char* const expected = kSize == 3 ? "[x, y, z]" : "[x, y, z, w]";
  if (!node.IsSequence() || node.size() != kSize) Refuse(what, node, expected);
  for (int i = 0; i < kSize; ++i) (*field)[i] = ReadScalar<double>(what, node[i], expected);
}
void Read(const std::string& what, const YAML::Node& node, Eigen::Quaterniond* field) {
  Read(what, node, &field->coeffs());
}
template <typename T>
void Read(const std::string& what, const YAML::Node& node, std::optional<T>* field) {
  field->reset();
  if (!node.IsNull()) Read(what, node, &field->emplace());
}

std::string Text(double value) { return YamlNumber(value); }
std::string Text(int value) { return std::to_string(value); }
std::string Text(bool value) { return value ? "true" : "false"; }
std::string Text(const Eigen::Vector3d& value) { return YamlNumbers(value); }
std::string Text(const Eigen::Quaterniond& value) { return YamlNumbers(value.coeffs()); }
template <typename Enum>
std::string Text(Enum value) {
  return ToString(value);
}
template <typename T>
std::string Text(const std::optional<T>& value) {
  return value ? Text(*value) : "~";
}

// --- Noise of an IMU ---

// Keys of Kalibr's imu.yaml and of its result, and of EuRoC's sensor.yaml.
const std::vector<std::string> kKeys = SplitNames(R"(
  gyroscope_noise_density gyroscope_random_walk accelerometer_noise_density
  accelerometer_random_walk update_rate rostopic model time_offset T_i_b accelerometers gyroscopes
  sensor_type comment T_BS rate_hz)");

/// The map that holds the keys, each of which is one of these.
YAML::Node FindImu(const YAML::Node& root) {
  if (!root.IsMap()) Reject("must be a map of 'key: value' lines");
  const YAML::Node imu = root["imu0"] ? root["imu0"] : root;
  if (root["imu0"] && root.size() > 1)
    Reject("holds more than imu0; keep the block of the one IMU to calibrate");
  if (!imu.IsMap()) Reject("imu0 must be a map of 'key: value' lines");
  for (const auto& entry : imu) {
    const std::string key = entry.first.IsScalar() ? entry.first.Scalar() : YAML::Dump(entry.first);
    if (std::find(kKeys.begin(), kKeys.end(), key) == kKeys.end())
      Reject("there is no key '", key, "'", DidYouMean(key, kKeys));
  }
  return imu;
}

/// A key of a number, the field that it sets, if any, and its bounds.
struct ImuKey {
  const char* name;
  double CalibrationOptions::*field;
  double low, high;
};
constexpr ImuKey kImuKeys[] = {
    {"gyroscope_noise_density", &CalibrationOptions::gyro_noise_density, 1e-9, 1e3},
    {"gyroscope_random_walk", &CalibrationOptions::gyro_bias_walk, 1e-12, 1e3},
    {"accelerometer_noise_density", &CalibrationOptions::accel_noise_density, 1e-9, 1e3},
    {"accelerometer_random_walk", &CalibrationOptions::accel_bias_walk, 1e-12, 1e3},
    {"update_rate", nullptr, 1e-3, 1e6}};

}  // namespace

void SetOption(const std::string& key, const YAML::Node& value, CalibrationOptions* options) {
  std::vector<std::string> others;
  bool found = false;
  VisitFields(*options, [&](const std::string& name, auto& field, const Bound&) {
    if (name == key) {
      found = true;
      Read("option " + key, value, &field);
    } else {
      others.push_back(name);
    }
  });
  if (!found) Reject("there is no option '", key, "'", DidYouMean(key, others));
}

CalibrationOptions ParseOptions(const std::string& yaml) {
  const YAML::Node map = ParseYaml(yaml);
  if (!map.IsMap() && !map.IsNull()) Reject("must be a map of 'option: value' lines");
  CalibrationOptions options;
  std::set<std::string> seen;
  for (const auto& entry : map) {
    if (!entry.first.IsScalar()) Reject("keys must be strings");
    const std::string key = entry.first.Scalar();
    if (!seen.insert(key).second) Reject("option '", key, "' is given twice");
    SetOption(key, entry.second, &options);
  }
  options.Validate();
  return options;
}

CalibrationOptions LoadOptions(const std::string& yaml_path) {
  return LoadYaml("config", yaml_path, ParseOptions);
}

std::string ToYaml(const CalibrationOptions& options) {
  std::ostringstream text;
  VisitFields(options, [&](const char* name, const auto& field, const Bound&) {
    text << name << ": " << Text(field) << "\n";
  });
  return text.str();
}

std::string ParseImuYaml(const std::string& yaml, CalibrationOptions* options) {
  const YAML::Node imu = FindImu(ParseYaml(yaml));
  for (const auto& [name, field, low, high] : kImuKeys) {
    if (!imu[name] && field == nullptr) continue;
    if (!imu[name]) Reject(name, " is missing");
    double value = 0.0;
    Read(name, imu[name], &value);
    if (!(value >= low && value <= high))
      Reject(name, " = ", YamlNumber(value), " is out of range: must be within [", YamlNumber(low),
             ", ", YamlNumber(high), "]");
    if (field != nullptr) options->*field = value;
  }
  std::string topic;
  if (imu["rostopic"]) ReadYaml("rostopic", imu["rostopic"], &topic);
  return topic;
}

std::string LoadImuYaml(const std::string& path, CalibrationOptions* options) {
  CalibrationOptions ignored;
  return LoadYaml("imu_yaml", path, [&](const std::string& yaml) {
    return ParseImuYaml(yaml, options ? options : &ignored);
  });
}

}  // namespace imu_pose_calib
