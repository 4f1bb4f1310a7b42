#pragma once

#include <string>

namespace imu_pose_calib {

/// `text` from a file, safe to show in a terminal: control characters and bytes that are no UTF-8
/// are written as \\x1b. What is printable stays as it is, so that doing it twice does no harm.
std::string Printable(const std::string& text);

}  // namespace imu_pose_calib
