#pragma once

#include <string>

#include "imu_pose_calib/ros/offline/report_data.h"

namespace imu_pose_calib {

/// First line of every report in HTML; tells our files from others.
extern const char kReportHeader[];

/// Draws a report with scripts/report.py, which is installed beside the executables: as one HTML
/// file, or as PDF when `path` ends in ".pdf". Replaces the file in one step. Throws InputError
/// with the reason when it cannot be drawn or written.
void WriteReport(const ReportInput& input, const std::string& path);

/// Removes the file at `path` when it is a report in HTML of an earlier run.
void RemoveOldReport(const std::string& path);

}  // namespace imu_pose_calib
