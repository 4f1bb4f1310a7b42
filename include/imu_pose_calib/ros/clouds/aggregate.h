#pragma once

#include <string>
#include <vector>

#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/ros/clouds/cloud_map.h"
#include "imu_pose_calib/ros/offline/offline.h"

namespace imu_pose_calib {

/// Clouds of a recording to put together. Empty: the default.
struct AggregateRequest {
  /// What to calibrate from; only bags, and all are one recording. The result goes beside the map.
  OfflineRequest recording;
  std::string cloud_topic;
  SensorMount sensor;               ///< that the clouds are of, but for the clock:
  std::string cloud_clock;          ///< of the clouds' stamps: "imu" (default) or "poses"
  std::string point_time = "auto";  ///< see FindPointTime()
  std::string output;               ///< PCD file; default: x.map.pcd for x.bag
  std::string uncalibrated;         ///< PCD file of the map without any calibration
  bool keep_uncalibrated = false;   ///< make that map also without a file
  double voxel_m = 0.05;            ///< cubes of the map
  double min_range_m = 0.3;         ///< nearer points are of the sensor's own body
  double max_range_m = 200.0;
  double radius_m = 0.3;  ///< around a point, for the sharpness
};

struct AggregateOutcome {
  std::string text;                         ///< what a person wants to know of the map
  std::vector<MapPoint> map, uncalibrated;  ///< the latter only when it is wanted
  std::vector<std::string> written;         ///< files
  std::string world_frame;
};

/// Calibrates, and puts the clouds together through the trajectory of the solve, each point at its
/// own time; what has no trajectory is left out. Judges the map's sharpness, with and without the
/// calibration.
///
/// Throws InputError when something cannot be used as given, DataError when no calibration can come
/// from the data, or no cloud is within the trajectory.
AggregateOutcome AggregateClouds(const AggregateRequest& request, const Progress& progress = {});

}  // namespace imu_pose_calib
