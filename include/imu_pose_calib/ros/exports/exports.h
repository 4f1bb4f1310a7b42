#pragma once

// Files of other programs. Each is a template of the folder exports/: its lines that begin with "#"
// are the comment, which stands where the rest says {comment}; in it, {head} and {axes} are the
// files of these names. Other names in braces are values that exports.cpp computes from the result;
// what stands between {each imu} and {end} is there for each IMU, a file whose name has imuN too;
// with {child} or {child word}, quoted for a shell, in it, for each frame on the body, pose sensors
// too. A line with a value that there is not is left out. Frames of values: marker M, imu I, pose
// sensor S that plays a camera or lidar, without one the marker, accelerometer's axes A. Of MI, IM,
// I0I, SI, IS, SA, AM, AA0, BM there are T_, R_, q_ and p_: {T_IM} is a list, {T_IM rows} one of
// each row, {T_IM block} one on several lines, {T_IM words} without brackets, {p_IM.0} a number.
// {accel_...} and {gyro_...} need noise and rates in the result.

#include <Eigen/Geometry>
#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/result_yaml.h"

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

/// What a result leaves open.
struct ExportChoice {
  /// px4: imu axes to the autopilot's body axes forward, right, down, v_body = q v_imu.
  Eigen::Quaterniond q_body_imu = Eigen::Quaterniond::Identity();
  /// Place of the pose sensor that plays camera or lidar. Nothing: the first that is usable, or the
  /// marker where there is none.
  std::optional<size_t> pose_sensor = std::nullopt;
};

/// The files of the program `name`, doc/exports.md. Throws InputError when they need an IMU, a pose
/// sensor, noise or rates that the result does not hold.
std::vector<ExportFile> Export(const StoredResult& stored, const std::string& name,
                               const ExportChoice& choice = {});

/// marker -> imu of the result, and imu -> each camera of the chain in the file at `path`, as
/// "urdf" and "tf.launch". Throws InputError when the result has no such IMU, and for the chain.
std::vector<ExportFile> ExportChain(const StoredResult& stored, size_t imu,
                                    const std::string& path);

/// The files of all `names` next to a result of so many IMUs, my.calibration.kalibr.imu0.yaml for
/// my.calibration.yaml; none of a program that needs an IMU where there is none.
std::vector<std::string> ExportPaths(const std::string& result,
                                     const std::vector<std::string>& names, size_t imus);

/// Writes the files of all `names` to `outputs`, next to the result, or into `folder` if that is
/// not empty: my.calibration.kalibr.imu0.yaml for my.calibration.yaml. Returns their paths. Of all
/// names those are left out that need an IMU which the result does not hold.
std::vector<std::string> WriteExports(const StoredResult& stored,
                                      const std::vector<std::string>& names, OutputFiles* outputs,
                                      const std::string& folder = "",
                                      const ExportChoice& choice = {});

/// What a user of these exports should know before he compares them with the result; may be empty.
std::string ExportNote(const StoredResult& stored, const std::vector<std::string>& names);

}  // namespace imu_pose_calib
