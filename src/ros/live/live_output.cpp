#include "imu_pose_calib/ros/live/live_output.h"

#include <geometry_msgs/PoseStamped.h>
#include <nav_msgs/Path.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <string>
#include <vector>

#include "imu_pose_calib/CalibrationResult.h"
#include "imu_pose_calib/CalibrationStatus.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/live/markers.h"

namespace imu_pose_calib {
namespace {

using diagnostic_msgs::DiagnosticStatus;

/// T_WI at the pose T_WM.
geometry_msgs::PoseStamped ToImuPose(const PoseSample& pose,
                                     const Rigid3& T_MI,
                                     const std::string& world_frame) {
  const Eigen::Quaterniond q_WM = pose.q_WM.normalized();
  geometry_msgs::PoseStamped msg;
  msg.header.stamp = FromNanoseconds(pose.t_ns);
  msg.header.frame_id = world_frame;
  msg.pose.position = ToPointMsg(pose.p_WM + q_WM * T_MI.p);
  msg.pose.orientation = ToQuaternionMsg(q_WM * T_MI.q);
  return msg;
}

/// "rotation    x [######----]  60 %"
std::string Bar(const std::string& motion, char axis, double share) {
  const int filled = static_cast<int>(std::floor(10.0 * share));
  const std::string bar = std::string(static_cast<size_t>(filled), '#') +
                          std::string(static_cast<size_t>(10 - filled), '-');
  char line[64];
  std::snprintf(
      line, sizeof(line), "%-11s %c [%s] %3.0f %%", motion.c_str(), axis, bar.c_str(), 100 * share);
  return line;
}

std::vector<std::string> Bars(const Excitation& excitation) {
  std::vector<std::string> bars;
  for (int axis = 0; axis < 3; ++axis)
    bars.push_back(Bar("rotation", "xyz"[axis], excitation.rotation[axis]));
  for (int axis = 0; axis < 3; ++axis)
    bars.push_back(Bar("translation", "xyz"[axis], excitation.translation[axis]));
  return bars;
}

}  // namespace

LiveOutput::LiveOutput(const ros::NodeHandle& node, const LiveCalibration* live)
    : node_(node), live_(live), diagnostics_(ros::NodeHandle(), node) {
  status_publisher_ = node_.advertise<CalibrationStatus>("status", 10);
  result_publisher_ = node_.advertise<CalibrationResult>("result", 1, true);
  pose_publisher_ = node_.advertise<geometry_msgs::PoseStamped>("imu_pose", 100);
  path_publisher_ = node_.advertise<nav_msgs::Path>("imu_path", 1);
  marker_publisher_ = node_.advertise<visualization_msgs::MarkerArray>("markers", 1);
  diagnostics_.setHardwareID("none");
  diagnostics_.add("calibration", this, &LiveOutput::Diagnose);
}

void LiveOutput::PublishStatus(const LiveView& view) {
  const LiveStatus& status = view.status;
  CalibrationStatus msg;
  msg.header.stamp = view.stamp;
  msg.phase = static_cast<uint8_t>(status.phase);
  msg.phase_text = ToString(status.phase);
  msg.message = status.message;
  msg.buffered =
      std::min({status.poses.buffered_s, status.gyro.buffered_s, status.accel.buffered_s});
  msg.pose_rate = status.poses.rate_hz;
  msg.gyro_rate = status.gyro.rate_hz;
  msg.accel_rate = status.accel.rate_hz;
  msg.pose_count = status.poses.received;
  msg.gyro_count = status.gyro.received;
  msg.accel_count = status.accel.received;
  msg.rotation_excitation = ToVector3Msg(status.excitation.rotation);
  msg.translation_excitation = ToVector3Msg(status.excitation.translation);
  msg.bars = Bars(status.excitation);
  msg.solves = static_cast<uint32_t>(status.solves);
  msg.solve_time = view.solve_time;
  if (live_->result()) {
    const LargestStd std_dev = MaxStd(*live_->result());
    msg.rotation_std = std_dev.rotation;
    msg.translation_std = std_dev.translation;
    msg.time_shift_std = std_dev.time_shift;
    msg.warnings = live_->result()->warnings;
  }
  status_publisher_.publish(msg);
}

void LiveOutput::PublishDiagnostics(const LiveStatus& status) {
  diagnosed_ = status;
  diagnostics_.force_update();
}

void LiveOutput::Diagnose(diagnostic_updater::DiagnosticStatusWrapper& wrapper) {
  const bool bad = diagnosed_.phase == Phase::kWaiting || diagnosed_.phase == Phase::kDegraded;
  wrapper.summary(bad ? DiagnosticStatus::WARN : DiagnosticStatus::OK,
                  std::string(ToString(diagnosed_.phase)) + ": " + diagnosed_.message);
  const auto stream = [&](const std::string& name, const StreamStatus& status) {
    wrapper.addf(name + " rate", "%.1f Hz", status.rate_hz);
    wrapper.addf(name + " delay", "%.4f s", status.delay_s);
    wrapper.add(name + " received", status.received);
  };
  stream("pose", diagnosed_.poses);
  stream("gyro", diagnosed_.gyro);
  stream("accel", diagnosed_.accel);
  wrapper.add("verdict", live_->result() ? live_->result()->message : "none yet");
  if (!live_->result()) return;
  for (const std::string& warning : live_->result()->warnings) wrapper.add("warning", warning);
}

void LiveOutput::PublishMarkers(const LiveView& view) {
  if (marker_publisher_.getNumSubscribers() == 0) return;
  const Scene scene{view.info.world_frame,
                    view.status,
                    live_->result() ? &*live_->result() : nullptr,
                    live_->pose() ? &*live_->pose() : nullptr,
                    live_->path()};
  marker_publisher_.publish(Draw(scene, view.stamp));
}

void LiveOutput::PublishPath(const LiveView& view) {
  if (!live_->result() || path_publisher_.getNumSubscribers() == 0) return;
  nav_msgs::Path path;
  path.header.stamp = view.stamp;
  path.header.frame_id = view.info.world_frame;
  for (const PoseSample& pose : live_->path())
    path.poses.push_back(ToImuPose(pose, live_->result()->imus[0].T_MI, view.info.world_frame));
  path_publisher_.publish(path);
}

void LiveOutput::PublishPose(const PoseSample& pose, const RecordingInfo& info) {
  if (!live_->result() || pose_publisher_.getNumSubscribers() == 0) return;
  pose_publisher_.publish(ToImuPose(pose, live_->result()->imus[0].T_MI, info.world_frame));
}

void LiveOutput::PublishResult(const RecordingInfo& info,
                               const std::string& foreign_frame,
                               const std::string& other_parent) {
  const ros::Time now = ros::Time::now();
  result_publisher_.publish(ToMsg(*live_->result(), info, now));
  std::vector<geometry_msgs::TransformStamped> transforms;
  for (const auto& transform : ToTransforms(*live_->result(), info, now)) {
    if (transform.child_frame_id != info.marker_frame) {
      transforms.push_back(transform);
      continue;
    }
    ROS_ERROR(
        "No transform is published: the marker and the imu frame are both called '%s'; set "
        "marker_frame or imu_frame",
        info.marker_frame.c_str());
  }
  broadcaster_.sendTransform(transforms);
  if (!other_parent.empty())
    ROS_WARN("tf has two parents of '%s': '%s' from elsewhere and '%s' from here; set imu_frame",
             foreign_frame.c_str(),
             other_parent.c_str(),
             info.marker_frame.c_str());
}

}  // namespace imu_pose_calib
