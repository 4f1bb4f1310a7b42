#pragma once

#include <string>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {

/// First line of every result file; tells our files from others.
extern const char kResultHeader[];

/// The run that a result is of.
struct RunInfo {
  std::string id;  ///< see OutputFiles::run_id(); empty: none
  /// What it writes beside the result under names of their own, from the folder of the result.
  std::vector<std::string> files = {};
};

/// Result file: T_marker_imu and its inverse, clocks, biases, noise, quality and the data used. A
/// comment at the top states the equations of transform and clocks. With several IMUs or sessions
/// these are of the first; `imus`, `between_imus` and `sessions` hold all. `infos`: of each
/// session.
std::string ToYaml(const Calibration& result, const std::vector<RecordingInfo>& infos,
                   const CalibrationOptions& options, const RunInfo& run = {});

}  // namespace imu_pose_calib
