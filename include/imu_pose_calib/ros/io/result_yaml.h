#pragma once

#include <string>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {

/// Why samples are dropped.
struct DropReason {
  const char* key;    ///< of result files
  const char* words;  ///< for people
  size_t StreamReport::*count;
};
constexpr DropReason kDropReasons[] = {
    {"not_finite", "not finite", &StreamReport::not_finite},
    {"zero_quaternion", "zero quaternion", &StreamReport::zero_quaternion},
    {"reversed_stamp", "reversed stamp", &StreamReport::reversed_stamp},
    {"duplicate_stamp", "duplicate stamp", &StreamReport::duplicate_stamp},
    {"repeated_value", "repeated value", &StreamReport::repeated_value},
    {"saturated", "saturated", &StreamReport::saturated},
    {"outlier", "outlier", &StreamReport::outlier},
    {"flipped", "flipped", &StreamReport::flipped},
    {"in_short_segment", "between gaps", &StreamReport::in_short_segment},
    {"between_updates", "between updates", &StreamReport::between_updates}};

/// "2 outlier, 3 flipped": the samples that were dropped; empty: none.
std::string Dropped(const StreamReport& report);

/// First line of every result file; tells our files from others.
constexpr char kResultHeader[] = "# imu_pose_calib: calibration of an IMU on a tracked body";

/// The run that a result is of.
struct RunInfo {
  std::string id;  ///< see OutputFiles::run_id(); empty: none
  /// What it writes beside the result under names of their own, from the folder of the result.
  std::vector<std::string> files = {};
};

/// Result file: T_marker_imu and its inverse, clocks, biases, noise, quality and the data used. A
/// comment at the top states the equations of transform and clocks. With several IMUs or sessions
/// these are of the first; `imus`, `between_imus` and `sessions` hold all. `pose_sensors`: only
/// where there are any; without an IMU, its keys are left out. `infos`: of each session.
std::string ToYaml(const Calibration& result, const std::vector<RecordingInfo>& infos,
                   const CalibrationOptions& options, const RunInfo& run = {});

/// The numbers of a pose sensor may be used: status kOk or kWeak.
bool IsUsable(const PoseSensorCalibration& sensor);

/// A frame on the body: x_marker = T_MF x_frame.
struct BodyFrame {
  std::string name;
  Rigid3 T_MF;
};
/// Those of each IMU, then of each pose sensor that is usable.
std::vector<BodyFrame> BodyFrames(const Calibration& result, const RecordingInfo& info);

/// What a result file says of the rig, read back; only what is named here is set.
struct StoredResult {
  std::string path;     ///< of the file, as given
  std::string version;  ///< of the package that wrote it
  std::string run_id;   ///< of the run that wrote it; empty: of none that has one
  /// Status, message, IMU model; transform, accel_delay and matrices of each IMU; of each session
  /// gravity, and of its IMUs clock, biases, noise and rates; noise, rate and duration of the poses
  /// of the first session; of each pose sensor all but residuals and observability, its
  /// `world` at the start of each piece.
  Calibration result;
  /// Frames, recording and topics of each session; of pose sensors in the first alone.
  std::vector<RecordingInfo> infos;
  CalibrationOptions options;  ///< gyro_bias_walk, accel_bias_walk

  /// The IMU in the first session that has it.
  const ImuSession& Clock(size_t imu) const;
  const ImuInfo& Info(size_t imu) const { return infos.front().imus[imu]; }
};

/// Reads the text of a result file, which ToYaml() writes. Throws InputError naming the key that is
/// missing or unfit.
StoredResult ParseResult(const std::string& yaml, const std::string& path);

/// The same of the file at `path`, which the error names too.
StoredResult LoadResult(const std::string& path);

}  // namespace imu_pose_calib
