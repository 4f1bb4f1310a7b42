#pragma once

// Ground truth of IMUs and pose sensors as files; doc/trajectory.md says what is in them.

#include <functional>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/ground_truth/imu_track.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/offline/calibration_report.h"

namespace imu_pose_calib {

/// The ground truth that is asked for. Empty: the default.
struct TrajectoryRequest {
  std::string path;  ///< file or folder; empty: none is wanted
  /// "tum", "ov_eval", "euroc", "asl" or "bag". Empty: by the suffix of the path, .tum and .txt,
  /// .csv, .bag; a folder or no suffix is asl.
  std::string format;
  std::string clock;  ///< of the stamps: "imu" (default) or "poses"; of a sensor: its own
  /// Pose sensor whose trajectory it is, "sensor0" or its frame. Empty: the IMUs, or without any
  /// all pose sensors.
  std::string frame;
  double rate_hz = 0.0;    ///< 0: at the samples of the IMU, or poses of the sensor
  double max_gap_s = 2.0;  ///< longest gap of the poses that the IMU carries the trajectory across
};

enum class TrajectoryFormat {
  kTum,     ///< t x y z qx qy qz qw
  kOvEval,  ///< the same with the covariances of rotation and position
  kEuroc,   ///< data.csv of state_groundtruth_estimate0, with velocity and biases
  kAsl,     ///< folder with mav0: that file, its sigmas, and the samples of the IMU
  kBag,     ///< nav_msgs/Odometry, nav_msgs/Path and tf
};

/// A file, or a folder for kAsl, to write.
struct TrajectoryTarget {
  std::string path;
  TrajectoryFormat format;
  size_t session, place;   ///< of the IMU or pose sensor in the rig
  bool is_sensor = false;  ///< a pose sensor

  /// All files that are written.
  std::vector<std::string> Files() const;
  /// The result has what it is of.
  bool IsIn(const Calibration& result) const;
};

/// Of "imu", which is the default, or "poses". Throws InputError naming the field otherwise.
TrackClock ParseClock(const std::string& field, const std::string& name);

/// One for each IMU or pose sensor in each session: `path` itself for a single one, else
/// path_session1_imu0 or path_session1_sensor0 with the suffix of `path`, `_session` and `_imu` as
/// far as there are several. `sensors`: of the rig.
/// Throws InputError when the request cannot be fulfilled.
std::vector<TrajectoryTarget> PlanTrajectories(const TrajectoryRequest& request, Method method,
                                               size_t sessions, size_t imus,
                                               const std::vector<PoseSensorInfo>& sensors = {});

/// The states of an IMU over time, and what files say of it.
struct TrajectoryOutput {
  std::vector<ImuTrack::Instant> instants;
  std::function<std::optional<ImuState>(double t)> state;  ///< see ImuTrack::At()
  bool has_covariance;
  std::string world_frame, imu_frame;  ///< names

  // For kAsl:
  std::function<std::vector<ImuTrack::Sample>()> samples = {};
  ImuStd noise = {};  ///< white noise per sample of the IMU
  double imu_rate_hz = 0.0;
  double gyro_bias_walk = 0.0, accel_bias_walk = 0.0;  ///< [rad/s^2/sqrt(Hz)], [m/s^3/sqrt(Hz)]
};

/// What was written.
struct TrajectoryCount {
  size_t states = 0;
  size_t carried = 0;                             ///< of these, across gaps of the poses
  std::vector<std::pair<int64_t, int64_t>> runs;  ///< of those: first and last stamp [ns]
};

/// Gives `outputs` the files of a target; each names the run, and which states are carried, where
/// its format has a place for that. kOvEval needs covariances. Throws InputError when one cannot be
/// written.
TrajectoryCount WriteTrajectory(const TrajectoryTarget& target, const TrajectoryOutput& output,
                                OutputFiles* outputs);

/// Gives `outputs` the trajectories of what the sessions have, and returns a line on each, with
/// more where the format cannot say which states the IMU alone has carried.
std::vector<std::string> WriteTrajectories(const TrajectoryRequest& request,
                                           const std::vector<TrajectoryTarget>& targets,
                                           const CalibrationRun& run, OutputFiles* outputs);

}  // namespace imu_pose_calib
