#pragma once

#include <optional>
#include <string>

#include "imu_pose_calib/core/types.h"

namespace imu_pose_calib {

/// Record time minus header stamp of one stream [s]; the clocks may differ.
struct Latency {
  double median_s = 0.0;
  double spread_s = 0.0;  ///< robust sigma
};

/// Where a recording comes from and how its frames are called.
struct RecordingInfo {
  /// Path of the bag, or paths with spaces between them. Empty: live topics, or text files, whose
  /// paths stand for the topics.
  std::string bag;
  /// Either `imu_topic`, or `gyro_topic` and `accel_topic` for a split IMU; the others are empty.
  std::string imu_topic, gyro_topic, accel_topic;
  std::string pose_topic;
  /// Frame names without leading slash: fixed frame of the poses, marker, imu.
  std::string world_frame, marker_frame, imu_frame;
  /// File that the noise of the IMU is from. Empty: the options.
  std::string imu_yaml;
  /// What the covariances of the poses say, median.
  std::optional<PoseStd> stated_pose_std;
  /// No value: there are no record times, as in text files.
  std::optional<Latency> pose_latency, gyro_latency, accel_latency;
};

/// The samples of one recording in the order in which they were recorded.
struct Recording {
  RecordingInfo info;
  SessionData data;
};

/// A field of a request: its name and what was given for it, empty for nothing.
struct Given {
  const char* name;
  const std::string& value;
};

/// Whether a source is named by a pair of fields instead of by one. Throws InputError when one of
/// the pair is missing, or when both ways are used.
bool IsPair(const Given& one, const Given& first, const Given& second);

/// Throws InputError when the part of a recording to use is not one.
void CheckSpan(double start_s, double duration_s);

/// For handing a recording from one process to another of the same program.
std::string ToBytes(const Recording& recording);
Recording FromBytes(std::string bytes);

}  // namespace imu_pose_calib
