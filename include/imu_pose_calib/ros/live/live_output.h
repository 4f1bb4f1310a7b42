#pragma once

#include <diagnostic_updater/diagnostic_updater.h>
#include <ros/node_handle.h>
#include <tf2_ros/static_transform_broadcaster.h>
#include <visualization_msgs/MarkerArray.h>

#include <deque>
#include <string>

#include "imu_pose_calib/ros/io/recording.h"
#include "imu_pose_calib/ros/live/live_calibration.h"

namespace imu_pose_calib {

/// What there is to draw of a live calibration.
struct Scene {
  std::string world_frame;
  LiveStatus status;
  const Calibration* result;           ///< null: none yet
  const PoseSample* pose;              ///< newest; null: none yet
  const std::deque<PoseSample>& path;  ///< the last poses, thinned out
};

/// Frames, paths, gravity, the lever arm with the ellipsoid of its sigma, excitation bars and
/// verdict, all in the world frame. Each array replaces the one before.
visualization_msgs::MarkerArray Draw(const Scene& scene, const ros::Time& stamp);

/// What the live node knows at one time.
struct LiveView {
  LiveStatus status;
  RecordingInfo info;
  double solve_time = 0.0;  ///< of the solve that is running; 0: none [s]
  ros::Time stamp;
};

/// Publishes status, result, tf, markers and diagnostics of a live calibration. Without a lock of
/// its own: whoever calls holds that of the LiveCalibration.
class LiveOutput {
 public:
  LiveOutput(const ros::NodeHandle& node, const LiveCalibration* live);

  void PublishStatus(const LiveView& view);
  void PublishDiagnostics(const LiveStatus& status);
  void PublishMarkers(const LiveView& view);
  void PublishPath(const LiveView& view);
  /// The IMU where the marker is in `pose`, once there is a result.
  void PublishPose(const PoseSample& pose, const RecordingInfo& info);
  /// The result, and as a static transform. `other_parent`: of the imu frame in tf; empty: none.
  void PublishResult(const RecordingInfo& info, const std::string& foreign_frame,
                     const std::string& other_parent);

 private:
  void Diagnose(diagnostic_updater::DiagnosticStatusWrapper& wrapper);

  ros::NodeHandle node_;
  const LiveCalibration* const live_;
  LiveStatus diagnosed_;
  ros::Publisher status_publisher_, result_publisher_, pose_publisher_, path_publisher_,
      marker_publisher_;
  tf2_ros::StaticTransformBroadcaster broadcaster_;
  diagnostic_updater::Updater diagnostics_;
};

}  // namespace imu_pose_calib
