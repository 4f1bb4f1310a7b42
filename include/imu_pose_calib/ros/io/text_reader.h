#pragma once

#include <string>
#include <vector>

#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {

/// The request with every file named, and without the folder. Throws InputError when it is
/// incomplete or ambiguous, naming the field to give.
RecordingRequest FindFiles(RecordingRequest request);

/// Adds the files that are named to a recording that lacks their part, and keeps the span, see
/// ReadText(). Throws InputError when one cannot be read, naming file, line, column and value.
void ReadFiles(const RecordingRequest& request, Recording* recording);

/// Reads a recording from text files. The frames are called world, marker and imu; the topics of
/// the info are the paths of the files.
///
/// `start_s` counts from the first stamp of all files when poses and IMU share a time span, else
/// (clocks of different epochs) from the first stamp of each. Of pose sensors those poses are kept
/// that are within the time of the marker's; all when none are, since its clock is another one
/// then.
///
/// With a pose sensor there need not be an IMU.
///
/// Throws InputError as FindFiles() and ReadFiles() do.
Recording ReadText(const RecordingRequest& request);

}  // namespace imu_pose_calib
