#pragma once

#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// Record time minus header stamp of one stream [s]; the clocks may differ.
struct Latency {
  double median_s = 0.0;
  double spread_s = 0.0;  ///< robust sigma
};

/// Where the samples of an IMU come from. All empty: the recording lacks it.
struct ImuInfo {
  /// Either `imu_topic`, or `gyro_topic` and `accel_topic` for a split IMU; the others are empty.
  std::string imu_topic, gyro_topic, accel_topic;
  std::string imu_frame;  ///< without leading slash
  /// No value: there are no record times, as in text files.
  std::optional<Latency> gyro_latency, accel_latency;

  const std::string& GyroSource() const { return imu_topic.empty() ? gyro_topic : imu_topic; }
  const std::string& AccelSource() const { return imu_topic.empty() ? accel_topic : imu_topic; }
};

/// Where the poses of a pose sensor come from. All empty: the recording lacks it.
struct PoseSensorInfo {
  std::string topic;               ///< or path of a file, either with :BODY; or tf:PARENT:CHILD
  std::string frame, world_frame;  ///< S and V, without leading slash
};

/// Where a recording comes from and how its frames are called.
struct RecordingInfo {
  /// Path of the bag, or paths with spaces between them. Empty: live topics, or text files, whose
  /// paths stand for the topics.
  std::string bag;
  std::vector<ImuInfo> imus = std::vector<ImuInfo>(1);
  std::vector<PoseSensorInfo> pose_sensors;
  std::string pose_topic;
  /// Frame names without leading slash: fixed frame of the poses, marker.
  std::string world_frame, marker_frame;
  /// File that the noise of the IMU is from. Empty: the options.
  std::string imu_yaml;
  /// What the covariances of the poses say, median.
  std::optional<PoseStd> stated_pose_std;
  std::optional<Latency> pose_latency;  ///< see ImuInfo
  /// What is to be said of the files, as that one is cut off.
  std::vector<std::string> notes;

  /// What tells it from other recordings.
  const std::string& Source() const { return bag.empty() ? pose_topic : bag; }
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

/// The names that one text holds with white space between them; at least one, which may be empty.
std::vector<std::string> SplitNames(const std::string& text);

/// Paths likewise, or the one of a file of that name; none when the text is empty.
std::vector<std::string> SplitPaths(const std::string& text);

/// Source and body of a name SOURCE:BODY; of a name without, or that a file has, no body.
std::pair<std::string, std::string> SplitBody(const std::string& name);

/// SOURCE:BODY, or SOURCE when there is no body.
std::string JoinBody(const std::string& source, const std::string& body);

/// Parent and child of poses from tf, without leading slash.
using TfFrames = std::pair<std::string, std::string>;

/// tf:PARENT:CHILD.
std::string JoinTf(const TfFrames& frames);

/// Of a pose sensor tf:PARENT:CHILD; no value when it is a topic.
std::optional<TfFrames> SplitTf(const std::string& name);

/// A pose sensor by its name and the frames of its messages. Those that are empty are called by the
/// topic: "camera_pose" and "camera_pose_world" for /camera/pose.
PoseSensorInfo NamePoseSensor(const std::string& name, const std::string& world_frame,
                              const std::string& frame);

/// Throws InputError when a pose sensor is the marker, or is given twice; all as by JoinBody() or
/// JoinTf().
void CheckPoseSensors(const std::string& marker, const std::vector<std::string>& pose_sensors);

/// `frame` without leading slash, or `fallback` when it is empty.
std::string FrameName(const std::string& frame, const std::string& fallback);

/// Sets frames that are named by the user, `imu_frame` with white space between those of several
/// IMUs; empty names keep those of the recording. IMUs that it calls alike get numbers, and so do
/// pose sensors that it calls as what is before them.
void NameFrames(const std::string& marker_frame, const std::string& imu_frame, RecordingInfo* info);

/// The names as they can be shown.
RecordingInfo WithPrintableNames(RecordingInfo info);

}  // namespace imu_pose_calib
