// Node imu_pose_calib: calibrates from a recording, or from topics as they arrive when none is
// given, and offers the result in the ROS graph.

#include <ros/ros.h>
#include <tf2_ros/static_transform_broadcaster.h>

#include <csignal>
#include <iostream>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/live/live_node.h"
#include "imu_pose_calib/ros/live/parameters.h"
#include "imu_pose_calib/ros/offline/command_line.h"
#include "imu_pose_calib/ros/offline/offline.h"
#include "imu_pose_calib/ros/offline/summary.h"

namespace imu_pose_calib {
namespace {

OfflineRequest ReadRequest(const ros::NodeHandle& node) {
  const auto text = [&](const char* name) {
    return Param<std::string>(node, name, "", "a string");
  };
  const auto number = [&](const char* name) { return Param<double>(node, name, 0.0, "a number"); };
  OfflineRequest request;
  request.bag.paths = SplitBags(text("bag"));
  request.bag.imu_topic = text("imu_topic");
  request.bag.pose_topic = text("pose_topic");
  request.bag.gyro_topic = text("gyro_topic");
  request.bag.accel_topic = text("accel_topic");
  request.bag.tf_parent = text("tf_parent");
  request.bag.tf_child = text("tf_child");
  request.bag.start_s = number("start");
  request.bag.duration_s = number("duration");
  request.bag.record_time = Param<bool>(node, "record_time", false, "true or false");
  request.text.poses = text("poses");
  request.text.imu = text("imu");
  request.text.gyro = text("gyro");
  request.text.accel = text("accel");
  request.imu_yaml = text("imu_yaml");
  request.config = text("config");
  request.method = text("method");
  request.output = text("output");
  request.marker_frame = text("marker_frame");
  request.imu_frame = text("imu_frame");
  return request;
}

/// Publishes the result and the static transform until the node is shut down.
void Offer(const OfflineResult& offline, ros::NodeHandle* node) {
  auto publisher = node->advertise<CalibrationResult>("result", 1, true);
  publisher.publish(ToMsg(offline.result, offline.info, ros::Time::now()));

  tf2_ros::StaticTransformBroadcaster broadcaster;
  broadcaster.sendTransform(ToTransformStamped(offline.result, offline.info, ros::Time::now()));
  ros::spin();
}

void RunOffline(ros::NodeHandle* node) {
  const bool exit = Param<bool>(*node, "exit", false, "true or false");
  // Nobody listens to ROS during the solve: until its end, an interrupt ends the process at once.
  const auto handler = std::signal(SIGINT, SIG_DFL);
  const OfflineResult offline = CalibrateOffline(ReadRequest(*node));
  std::signal(SIGINT, handler);
  std::cout << Summary(offline.result, offline.info) << std::flush;
  WriteResult(offline);
  ROS_INFO("Written to %s", offline.output.c_str());
  if (!exit) Offer(offline, node);
}

void Run(ros::NodeHandle* node) {
  if (node->hasParam("bag") || node->hasParam("poses")) {
    RunOffline(node);
  } else {
    RunLive(*node);
  }
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  ros::init(argc, argv, "imu_pose_calib");
  // Outlives the error message: without any handle the console is shut down.
  ros::NodeHandle node("~");
  return imu_pose_calib::RunToExitStatus(
      [&] { imu_pose_calib::Run(&node); },
      [](const std::string& error) { ROS_FATAL("%s", error.c_str()); });
}
