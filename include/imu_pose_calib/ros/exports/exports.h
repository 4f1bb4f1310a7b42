#pragma once

#include <string>
#include <vector>

#include "imu_pose_calib/ros/exports/exporters.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/result_yaml.h"

namespace imu_pose_calib {

/// The programs that a result can be exported to.
std::vector<std::string> ExportNames();

/// The names in a list that is separated by commas or white space, each once; "all": every one.
/// Throws InputError listing the known names for one that is not among them.
std::vector<std::string> ParseExports(const std::string& list);

/// The files of one program, doc/exports.md. Each states the equations of transform and clocks in
/// this package's terms and what its own keys mean.
std::vector<ExportFile> Export(const StoredResult& stored, const std::string& name,
                               const ExportOptions& options = {});

/// Writes the files of all `names` to `outputs`, next to the result, or into `folder` if that is
/// not empty: my.calibration.kalibr.imu0.yaml for my.calibration.yaml. Returns their paths.
std::vector<std::string> WriteExports(const StoredResult& stored,
                                      const std::vector<std::string>& names, OutputFiles* outputs,
                                      const std::string& folder = "",
                                      const ExportOptions& options = {});

/// What a user of these exports should know before he compares them with the result; may be empty.
std::string ExportNote(const StoredResult& stored, const std::vector<std::string>& names);

}  // namespace imu_pose_calib
