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

/// A recording to read: from bags, from text files, or the poses from the one and the IMUs from the
/// other. What is left empty is found by the types of topics, or by the columns of files.
struct RecordingRequest {
  /// Bags of one recording, each with all topics or only some; or the folder of an ASL dataset
  /// (EuRoC), with sensors in it or in its mav0: SENSOR/data.csv.
  std::vector<std::string> paths;

  // Topics of bags.
  std::string imu_topic;                ///< several IMUs: white space between them, as below
  std::string gyro_topic, accel_topic;  ///< split IMU, both or none; not together with `imu_topic`
  std::string pose_topic;
  /// Poses of `tf_child` in `tf_parent` from tf, both or none; not together with `pose_topic`.
  std::string tf_parent, tf_child;
  std::string usual_imu_topic;  ///< taken when no IMU topic is given and the bags have it

  // Text files: tables of samples or, of poses, a CSV of Motive or Vicon.
  std::string poses;
  std::string imu;          ///< several: white space between them, unless a file is called so
  std::string gyro, accel;  ///< split IMU, both or none; not together with `imu`

  std::string body;  ///< of a pose topic, or file of poses, that holds several
  /// With white space between them: TOPIC or FILE, with :BODY where it holds several, or
  /// tf:PARENT:CHILD.
  std::string pose_sensors;
  double start_s = 0.0;      ///< [s] after the first record time of bags; of files see ReadText()
  double duration_s = 0.0;   ///< [s] 0: to the end
  bool record_time = false;  ///< Stamp with the record times instead of the header stamps.
  /// An IMU or pose sensor that is named may be missing: another session of the rig has it.
  bool may_lack_sensors = false;

  bool NamesPoseFile() const { return !poses.empty(); }
  bool NamesImuFile() const { return !(imu.empty() && gyro.empty() && accel.empty()); }
};

// --- Reading ---

/// Reads bags of ROS 1, or of ROS 2 (folder, .mcap, .db3), and the text files beside them: IMU
/// samples (sensor_msgs/Imu on one topic; gyroscope and accelerometer on two as sensor_msgs/Imu or
/// geometry_msgs/Vector3Stamped) and poses (geometry_msgs/PoseStamped, TransformStamped or
/// PoseWithCovarianceStamped, nav_msgs/Odometry, or tf; of ROS 2 also messages that hold poses of
/// several bodies by name). With a pose sensor there need not be an IMU.
///
/// Time is the header stamp, at full precision. World frame: header.frame_id of the poses; marker
/// frame: child_frame_id, else "marker"; imu frame: header.frame_id of the IMU, else "imu". Of a
/// pose sensor the same as of the marker, else "camera_pose" and "camera_pose_world" for
/// /camera/pose.
///
/// Throws InputError when a bag cannot be read or when the bags do not hold exactly one choice of
/// topics: the text, printable, names what they have and which field to give.
Recording ReadBag(const RecordingRequest& request);

/// Bags by the recording that they are of, in the order in which they are given. Those that
/// continue each other, or hold other topics of the same time, are one recording. Reads and throws
/// as ReadBag() does.
std::vector<std::vector<std::string>> GroupBags(const std::vector<std::string>& paths);

/// The request with every file named, and without the folder. Throws InputError when it is
/// incomplete or ambiguous, naming the field to give.
RecordingRequest FindFiles(RecordingRequest request);

/// Adds the files that are named to a recording that lacks their part, and keeps the span, see
/// ReadText(). Throws InputError when one cannot be read, naming file, line, column and value.
void ReadFiles(const RecordingRequest& request, Recording* recording);

/// Reads a recording from text files. The frames are called world, marker and imu; the topics of
/// the info are the paths of the files. With a pose sensor there need not be an IMU.
///
/// `start_s` counts from the first stamp of all files when poses and IMU share a time span, else
/// (clocks of different epochs) from the first stamp of each. Of pose sensors those poses are kept
/// that are within the time of the marker's; all when none are, since its clock is another one
/// then. Throws InputError as FindFiles() and ReadFiles() do.
Recording ReadText(const RecordingRequest& request);

// --- Names and fields ---

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

/// Whether a pose sensor of that name is in a file.
bool IsPoseFile(const std::string& name);

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
