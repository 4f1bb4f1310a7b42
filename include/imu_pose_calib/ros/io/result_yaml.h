#pragma once

#include <string>
#include <vector>

#include "imu_pose_calib/core/options.h"
#include "imu_pose_calib/core/result.h"
#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {

/// Version of the package, "1.2.3".
extern const char kVersion[];

/// First line of every result file; tells our files from others.
extern const char kResultHeader[];

/// Result file: T_marker_imu and its inverse, clocks, biases, noise, quality and the data used. A
/// comment at the top states the equations of transform and clocks. With several IMUs or sessions
/// these are of the first; `imus`, `between_imus` and `sessions` hold all. `infos`: of each
/// session.
std::string ToYaml(const Calibration& result,
                   const std::vector<RecordingInfo>& infos,
                   const CalibrationOptions& options);

/// Shortest text that reads back as `value` and that YAML 1.1 and 1.2 both take for a float.
std::string YamlNumber(double value);

/// Replaces the file at `path` in one step. Throws InputError naming path and reason on failure.
void WriteFile(const std::string& path, const std::string& text);

/// Removes the file at `path` when it is a result of an earlier run.
void RemoveOldResult(const std::string& path);

}  // namespace imu_pose_calib
