#pragma once

#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/start/data_check.h"
#include "imu_pose_calib/ros/io/recording.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {

// Pieces of text that summaries and reports share.

/// `text` in lines of at most `columns`, the first behind `label`, the others indented like it.
std::string Wrap(const std::string& label, const std::string& text, size_t columns = 80);
/// A time as people say it: "3.10 ms", "2.5 s", "-2.00 h", "12.0 days".
std::string Time(double seconds);
/// "x, y, z", each as printf prints it by `number`.
std::string List(const Eigen::Vector3d& v, const char* number);
/// "2 outlier, 3 flipped": the samples that were dropped; empty: none.
std::string Dropped(const StreamReport& report);
/// The names as they can be shown.
RecordingInfo WithPrintableNames(RecordingInfo info);

/// A stream of a recording and what its check found.
struct CheckedStream {
  std::string role;  ///< "poses", "gyro" or "accel"
  size_t imu;        ///< place in the rig
  std::string topic;
  const StreamCheck& check;
  const StreamReport& report;
  const std::optional<Latency>& latency;
};

/// The poses, then two of each IMU of the rig. Refers to what it is given.
std::vector<CheckedStream> CheckedStreams(const DataCheck& check, const RecordingInfo& info);

}  // namespace imu_pose_calib
