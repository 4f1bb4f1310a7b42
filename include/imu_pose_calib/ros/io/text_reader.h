#pragma once

#include <string>
#include <vector>

#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {

/// Text files to read: poses, and an IMU in one file or in two.
struct TextRequest {
  /// ASL dataset (EuRoC), with its sensors in it or in its mav0. Files left empty below are found
  /// in it by their columns: SENSOR/data.csv.
  std::string folder;
  std::string poses;  ///< table of samples, or CSV of Motive or Vicon
  std::string body;   ///< of a CSV of Motive or Vicon with several
  std::string imu;    ///< several IMUs: white space between them, unless a file is called so
  /// Split IMU, both or none; not together with `imu`.
  std::string gyro, accel;
  std::vector<std::string> pose_sensors;  ///< FILE as poses, or FILE:BODY; "": elsewhere
  double start_s = 0.0;                   ///< [s] after the first stamp; see ReadText()
  double duration_s = 0.0;                ///< [s] 0: to the end
};

/// The request with every file named. Throws InputError when it is incomplete or ambiguous, naming
/// the field to give.
TextRequest FindFiles(TextRequest request);

/// Adds the files that are named, all of them whole, to a recording that lacks their part. Throws
/// InputError when one cannot be read, naming file, line, column and value.
void ReadFiles(const TextRequest& request, Recording* recording);

/// Keeps the samples from `start_s` on, for `duration_s` (0: to the end), as said at ReadText().
void CutSpan(double start_s, double duration_s, SessionData* data);

/// Keeps those poses of a pose sensor that are within the time of the marker's; all when none are,
/// since its clock is another one then.
void CutToPoses(const std::vector<PoseSample>& marker, std::vector<PoseSample>* pose_sensor);

/// Reads a recording from text files. The frames are called world, marker and imu; the topics of
/// the info are the paths of the files.
///
/// `start_s` counts from the first stamp of all files when poses and IMU share a time span, else
/// (clocks of different epochs) from the first stamp of each. Pose sensors: see CutToPoses().
///
/// With a pose sensor there need not be an IMU.
///
/// Throws InputError as FindFiles() and ReadFiles() do.
Recording ReadText(const TextRequest& request);

}  // namespace imu_pose_calib
