#pragma once

#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/start/data_check.h"
#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {

/// The result as a person reads it in a terminal, at most 80 columns wide (names excepted):
/// verdict, data, T_marker_imu and its inverse, clocks, biases, residuals and warnings, each number
/// with its unit, each equation with its direction; last a command that publishes the transform.
/// With several IMUs or sessions, a table of each. `infos`: of each session. With `lines`, only
/// verdict, table, what was dropped, the warnings that fit into so many lines, and the command.
std::string Summary(const Calibration& result, const std::vector<RecordingInfo>& infos,
                    std::optional<size_t> lines = std::nullopt);

/// The end of a summary: the files that were written.
std::string WrittenTo(const std::vector<std::string>& paths);

/// What a check of the data found, readable at a glance: verdict, a table of the streams, clocks,
/// excitation and warnings.
std::string Summary(const DataCheck& check, const RecordingInfo& info);

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
