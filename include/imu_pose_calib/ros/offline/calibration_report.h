#pragma once

#include <yaml-cpp/yaml.h>

#include <Eigen/Core>
#include <string>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {

/// A calibration and what it was made of.
struct CalibrationRun {
  CalibrationOptions options;
  std::vector<SessionData> sessions;  ///< as recorded
  std::vector<RecordingInfo> infos;   ///< of each session
  /// Without a solution: the data were refused before the solve.
  Calibration result;
  std::string refusal = {};  ///< why there is no result; empty: there is one
  std::string run_id = {};   ///< see OutputFiles
};

/// Numbers that every reader of YAML takes for numbers.
YAML::Node YamlList(const Eigen::VectorXd& values);

/// Puts the numbers that scripts/report.py draws into a folder:
///
///   report.yaml         verdict, names, streams, sensors, and which sessions and IMUs there are
///   result.yaml         as the result file, after a solve
///   sS_..., sS_iI_...   series of session S and of its IMU I, or sS_pP_... of its pose sensor P,
///                       each a NumPy file of rows; times are [s] on the clock of the session's
///                       poses, or without a solve after the first stamp of the stream, everything
///                       else SI
///
/// Throws InputError when a file cannot be written.
void WriteReportData(const CalibrationRun& run, const std::string& folder);

/// The page that scripts/report.py, which is installed beside the executables, draws of these: one
/// HTML file, or PDF when `path` ends in ".pdf". Throws InputError with the reason when it cannot
/// be drawn.
std::string DrawReport(const CalibrationRun& run, const std::string& path);

}  // namespace imu_pose_calib
