#pragma once

#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/core/ground_truth/imu_track.h"
#include "imu_pose_calib/ros/io/output_files.h"

namespace imu_pose_calib {

/// Ground truth files, doc/trajectory.md says what is in them.
enum class TrajectoryFormat {
  kTum,     ///< t x y z qx qy qz qw
  kOvEval,  ///< the same with the covariances of rotation and position
  kEuroc,   ///< data.csv of state_groundtruth_estimate0, with velocity and biases
  kAsl,     ///< folder with mav0: that file, its sigmas, and the samples of the IMU
  kBag,     ///< nav_msgs/Odometry, nav_msgs/Path and tf
};

/// "tum", "ov_eval", "euroc", "asl", "bag"; InputError otherwise. When the name is empty, by the
/// suffix of `path`: .tum and .txt, .csv, .bag; a folder or no suffix is asl.
TrajectoryFormat ParseTrajectoryFormat(const std::string& name, const std::string& path);

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
  struct Run {
    int64_t first_ns, last_ns;  ///< stamps
  };
  size_t states = 0;
  size_t carried = 0;     ///< of these, across gaps of the poses
  std::vector<Run> runs;  ///< of those
  /// Whether the file says which.
  bool is_marked = true;
};

/// Gives `outputs` a file, or a folder for kAsl; each names the run where its format has a place
/// for that, and which states are carried. kOvEval needs covariances. Throws InputError when it
/// cannot be written.
TrajectoryCount WriteTrajectory(const std::string& path, TrajectoryFormat format,
                                const TrajectoryOutput& output, OutputFiles* outputs);

/// The files that WriteTrajectory() would write at `path`.
std::vector<std::string> TrajectoryFiles(const std::string& path, TrajectoryFormat format);

/// Throws InputError when `path` holds an ASL dataset that is not from WriteTrajectory().
void CheckAslFolder(const std::string& path);

}  // namespace imu_pose_calib
