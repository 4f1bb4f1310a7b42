#pragma once

#include <string>

#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {

// Pieces of text that the summaries share.

/// As printf.
[[gnu::format(printf, 1, 2)]] std::string Format(const char* format, ...);
/// `text` in lines of at most `columns`, the first behind `label`, the others indented like it.
std::string Wrap(const std::string& label, const std::string& text, size_t columns = 80);
/// A time as people say it: "3.10 ms", "2.5 s", "-2.00 h", "12.0 days".
std::string Time(double seconds);
/// "x, y, z", each as printf prints it by `number`.
std::string List(const Eigen::Vector3d& v, const char* number);
/// "; dropped 2 outlier, ..."; nothing when nothing was.
std::string Dropped(const StreamReport& report);
/// The names as they can be shown.
RecordingInfo WithPrintableNames(RecordingInfo info);

}  // namespace imu_pose_calib
