#include "imu_pose_calib/ros/io/imu_yaml.h"

#include <algorithm>
#include <vector>

#include "imu_pose_calib/core/types.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/yaml_file.h"

namespace imu_pose_calib {
namespace {

// Keys of Kalibr's imu.yaml and of its result, and of EuRoC's sensor.yaml.
const std::vector<std::string> kKeys = {"gyroscope_noise_density",
                                        "gyroscope_random_walk",
                                        "accelerometer_noise_density",
                                        "accelerometer_random_walk",
                                        "update_rate",
                                        "rostopic",
                                        "model",
                                        "time_offset",
                                        "T_i_b",
                                        "accelerometers",
                                        "gyroscopes",
                                        "sensor_type",
                                        "comment",
                                        "T_BS",
                                        "rate_hz"};

/// The map that holds the keys.
YAML::Node FindImu(const YAML::Node& root) {
  if (!root.IsMap()) throw InputError("must be a map of 'key: value' lines");
  if (!root["imu0"]) return root;
  if (root.size() > 1)
    throw InputError("holds more than imu0; keep the block of the one IMU to calibrate");
  if (!root["imu0"].IsMap()) throw InputError("imu0 must be a map of 'key: value' lines");
  return root["imu0"];
}

void CheckKeys(const YAML::Node& imu) {
  for (const auto& entry : imu) {
    const std::string key = entry.first.IsScalar() ? entry.first.Scalar() : YAML::Dump(entry.first);
    if (std::find(kKeys.begin(), kKeys.end(), key) == kKeys.end())
      throw InputError("there is no key '" + key + "'; did you mean '" + Nearest(key, kKeys) +
                       "'?");
  }
}

double ReadNumber(const YAML::Node& imu, const char* key, double low, double high) {
  const YAML::Node node = imu[key];
  if (!node) throw InputError(std::string(key) + " is missing");
  double value = 0.0;
  if (!node.IsScalar() || !YAML::convert<double>::decode(node, value))
    throw InputError(std::string(key) + " must be a number, not " +
                     (node.IsNull() ? "nothing" : YAML::Dump(node)));
  if (!(value >= low && value <= high))
    throw InputError(std::string(key) + " = " + YamlNumber(value) +
                     " is out of range: must be within [" + YamlNumber(low) + ", " +
                     YamlNumber(high) + "]");
  return value;
}

ImuYaml Read(const YAML::Node& imu) {
  CheckKeys(imu);
  ImuYaml yaml;
  // The bounds of CalibrationOptions.
  yaml.gyroscope_noise_density = ReadNumber(imu, "gyroscope_noise_density", 1e-9, 1e3);
  yaml.gyroscope_random_walk = ReadNumber(imu, "gyroscope_random_walk", 1e-12, 1e3);
  yaml.accelerometer_noise_density = ReadNumber(imu, "accelerometer_noise_density", 1e-9, 1e3);
  yaml.accelerometer_random_walk = ReadNumber(imu, "accelerometer_random_walk", 1e-12, 1e3);
  if (imu["update_rate"]) yaml.update_rate = ReadNumber(imu, "update_rate", 1e-3, 1e6);
  if (imu["rostopic"]) {
    if (!imu["rostopic"].IsScalar()) throw InputError("rostopic must be a string");
    yaml.rostopic = imu["rostopic"].Scalar();
  }
  return yaml;
}

}  // namespace

void ImuYaml::CopyNoise(CalibrationOptions* options) const {
  options->gyro_noise_density = gyroscope_noise_density;
  options->gyro_bias_walk = gyroscope_random_walk;
  options->accel_noise_density = accelerometer_noise_density;
  options->accel_bias_walk = accelerometer_random_walk;
}

ImuYaml ParseImuYaml(const std::string& yaml) { return Read(FindImu(ParseYaml(yaml))); }

ImuYaml LoadImuYaml(const std::string& path) {
  try {
    return ParseImuYaml(ReadYamlFile(path));
  } catch (const InputError& error) {
    throw InputError("imu_yaml '" + path + "': " + error.what());
  }
}

}  // namespace imu_pose_calib
