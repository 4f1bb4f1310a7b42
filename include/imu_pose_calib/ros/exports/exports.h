#pragma once

// Files of other programs. Each is a template of the folder exports/: its first lines, after "#",
// are the comment, which stands where the rest says {comment}. Other names in braces are values
// that exports.cpp computes from the result; what stands between {each imu} and {end} is there for
// each IMU, a file whose name has imuN too. A line with a value that there is not is left out.

#include <Eigen/Geometry>
#include <string>
#include <vector>

#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/transform_file.h"

namespace imu_pose_calib {

struct ExportFile {
  std::string ending;  ///< "kalibr.imu0.yaml", what follows the name of the result and a dot
  std::string text;
};

/// The programs that a result can be exported to.
std::vector<std::string> ExportNames();

/// The names in a list that is separated by commas or white space, each once; "all": every one.
/// Throws InputError listing the known names for one that is not among them.
std::vector<std::string> ParseExports(const std::string& list);

/// The files of the program `name`, doc/exports.md. px4 needs q_body_imu: imu axes to the
/// autopilot's body axes forward, right, down, v_body = q v_imu. Throws InputError when they need
/// noise and rates that the result does not hold.
std::vector<ExportFile> Export(
    const StoredResult& stored, const std::string& name,
    const Eigen::Quaterniond& q_body_imu = Eigen::Quaterniond::Identity());

/// marker -> imu of the result, and imu -> each camera of the chain in the file at `source`, as
/// "urdf" and "tf.launch".
std::vector<ExportFile> ExportChain(const StoredResult& stored, size_t imu,
                                    const std::vector<ChainCamera>& cameras,
                                    const std::string& source);

/// Writes the files of all `names` to `outputs`, next to the result, or into `folder` if that is
/// not empty: my.calibration.kalibr.imu0.yaml for my.calibration.yaml. Returns their paths.
std::vector<std::string> WriteExports(
    const StoredResult& stored, const std::vector<std::string>& names, OutputFiles* outputs,
    const std::string& folder = "",
    const Eigen::Quaterniond& q_body_imu = Eigen::Quaterniond::Identity());

/// What a user of these exports should know before he compares them with the result; may be empty.
std::string ExportNote(const StoredResult& stored, const std::vector<std::string>& names);

}  // namespace imu_pose_calib
