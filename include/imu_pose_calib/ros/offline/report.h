#pragma once

#include <yaml-cpp/yaml.h>

#include <functional>
#include <string>

#include "imu_pose_calib/ros/offline/report_series.h"

namespace imu_pose_calib {

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

/// What every page tells of its making: version, command, folder.
YAML::Node ReportHead();

/// Writes the head of a page, report.yaml, to a folder.
void WriteHead(const YAML::Node& head, const std::string& folder);

/// Draws the page for `path` as DrawReport() does, of the numbers that `write` puts into a folder.
/// run_id: empty when none is told.
std::string DrawPage(const std::string& path, const std::string& run_id,
                     const std::function<void(const std::string&)>& write);

/// Throws InputError for a report that is of no kind that can be drawn; none is one that can.
void CheckReportName(const std::string& path);

}  // namespace imu_pose_calib
