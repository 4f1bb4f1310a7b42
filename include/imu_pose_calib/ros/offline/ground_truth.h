#pragma once

#include <string>
#include <vector>

#include "imu_pose_calib/ros/io/trajectory_writer.h"
#include "imu_pose_calib/ros/offline/calibration_report.h"

namespace imu_pose_calib {

/// The ground truth that is asked for. Empty: the default.
struct TrajectoryRequest {
  std::string path;    ///< file or folder; empty: none is wanted
  std::string format;  ///< see ParseTrajectoryFormat()
  std::string clock;   ///< of the stamps: "imu" (default) or "poses"; of a sensor: its own
  /// Pose sensor whose trajectory it is, "sensor0" or its frame. Empty: the IMUs, or without any
  /// all pose sensors.
  std::string frame;
  double rate_hz = 0.0;    ///< 0: at the samples of the IMU, or poses of the sensor
  double max_gap_s = 2.0;  ///< longest gap of the poses that the IMU carries the trajectory across
};

/// Of "imu", which is the default, or "poses". Throws InputError naming the field otherwise.
TrackClock ParseClock(const std::string& field, const std::string& name);

/// A file or folder to write.
struct TrajectoryTarget {
  std::string path;
  TrajectoryFormat format;
  size_t session, place;   ///< of the IMU or pose sensor in the rig
  bool is_sensor = false;  ///< a pose sensor
};

/// One for each IMU or pose sensor in each session: `path` itself for a single one, else
/// path_session1_imu0 or path_session1_sensor0 with the suffix of `path`, `_session` and `_imu` as
/// far as there are several. `sensors`: of the rig.
/// Throws InputError when the request cannot be fulfilled.
std::vector<TrajectoryTarget> PlanTrajectories(const TrajectoryRequest& request, Method method,
                                               size_t sessions, size_t imus,
                                               const std::vector<PoseSensorInfo>& sensors = {});

/// The result has what the target is of.
bool IsThere(const TrajectoryTarget& target, const Calibration& result);

/// Gives `outputs` the trajectories of what the sessions have, and returns a line on each, with
/// more where the format cannot say which states the IMU alone has carried.
std::vector<std::string> WriteTrajectories(const TrajectoryRequest& request,
                                           const std::vector<TrajectoryTarget>& targets,
                                           const CalibrationRun& run, OutputFiles* outputs);

}  // namespace imu_pose_calib
