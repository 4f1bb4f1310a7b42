#pragma once

#include <string>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {

/// What a report tells of.
struct ReportInput {
  const CalibrationOptions& options;
  const std::vector<SessionData>& sessions;  ///< as recorded
  const std::vector<RecordingInfo>& infos;   ///< of each session
  /// Without a solution: the data were refused before the solve.
  const Calibration& result;
  std::string refusal;      ///< why there is no result; empty: there is one
  std::string run_id = {};  ///< see OutputFiles
};

/// Puts the numbers that scripts/report.py draws into a folder:
///
///   report.yaml         verdict, names, streams, sensors, and which sessions and IMUs there are
///   result.yaml         as the result file, after a solve
///   sS_..., sS_iI_...   series of session S and of its IMU I, each a NumPy file of rows; times are
///                       [s] after report.yaml's `epoch_ns` on the clock of the session's poses, or
///                       without a solve after the first stamp of the stream, everything else SI
///
/// Throws InputError when a file cannot be written.
void WriteReportData(const ReportInput& input, const std::string& folder);

/// Draws a report with scripts/report.py, which is installed beside the executables: as one HTML
/// file, or as PDF when `path` ends in ".pdf", which it returns. Throws InputError
/// with the reason when it cannot be drawn or written.
std::string DrawReport(const ReportInput& input, const std::string& path);

/// Throws InputError for a report that is of no kind that can be drawn; none is one that can.
void CheckReportName(const std::string& path);

}  // namespace imu_pose_calib
