#pragma once

#include <yaml-cpp/yaml.h>

#include <string>

#include "imu_pose_calib/core/base/options.h"

namespace imu_pose_calib {

/// Options of a YAML text: a map whose keys are field names of CalibrationOptions. Fields without a
/// key keep their default; `~` means "not given" for the optional ones. Rotations are [x, y, z, w],
/// translations [x, y, z].
/// Throws InputError naming the key for a key that does not exist (with the nearest one that does),
/// a value of the wrong type, or a value out of range.
CalibrationOptions ParseOptions(const std::string& yaml);

/// The same of a file, which the error names too.
CalibrationOptions LoadOptions(const std::string& yaml_path);

/// Sets the field called `key` as a value of such a text does, without a look at its range.
void SetOption(const std::string& key, const YAML::Node& value, CalibrationOptions* options);

/// The same map for every field, one `key: value` a line; ParseOptions() reads it back exactly.
std::string ToYaml(const CalibrationOptions& options);

/// Reads the text of Kalibr's imu.yaml, with its keys at the top or, as in Kalibr's results, below
/// `imu0`, or of a sensor.yaml of EuRoC. Sets the noise densities and walks, which are required;
/// keys of these files that say nothing about noise are passed over. Returns the rostopic, empty
/// when it is not given.
///
/// Throws InputError naming key and bound for a key that is missing, unknown, of the wrong type or
/// out of range.
std::string ParseImuYaml(const std::string& yaml, CalibrationOptions* options);

/// The same of a file, which the error names too; for the topic alone without options.
std::string LoadImuYaml(const std::string& path, CalibrationOptions* options = nullptr);

}  // namespace imu_pose_calib
