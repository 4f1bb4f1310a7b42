// Node imu_pose_calib: calibrates from one bag, or from topics as they arrive when no bag is given,
// and offers the result in the ROS graph.

#include <ros/ros.h>
#include <tf2_ros/static_transform_broadcaster.h>

#include <iostream>

#include "imu_pose_calib/ros/conversions.h"
#include "imu_pose_calib/ros/live_node.h"
#include "imu_pose_calib/ros/offline.h"
#include "imu_pose_calib/ros/parameters.h"
#include "imu_pose_calib/ros/result_yaml.h"
#include "imu_pose_calib/ros/summary.h"

namespace imu_pose_calib {
namespace {

OfflineRequest ReadRequest(const ros::NodeHandle& node) {
  const auto text = [&](const char* name) {
    return Param<std::string>(node, name, "", "a string");
  };
  const auto number = [&](const char* name) { return Param<double>(node, name, 0.0, "a number"); };
  OfflineRequest request;
  request.bag = {text("bag"),
                 text("imu_topic"),
                 text("pose_topic"),
                 text("gyro_topic"),
                 text("accel_topic"),
                 number("start"),
                 number("duration")};
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
  if (offline.info.marker_frame == offline.info.imu_frame) {
    ROS_ERROR(
        "No transform is published: the marker and the imu frame are both called '%s'; set "
        "marker_frame or imu_frame",
        offline.info.imu_frame.c_str());
  } else {
    broadcaster.sendTransform(ToTransformStamped(offline.result, offline.info, ros::Time::now()));
  }
  ros::spin();
}

void RunOffline(ros::NodeHandle* node) {
  const bool exit = Param<bool>(*node, "exit", false, "true or false");
  const OfflineResult offline = CalibrateOffline(ReadRequest(*node));
  std::cout << Summary(offline.result, offline.info) << std::flush;
  WriteFile(offline.output, offline.yaml);
  ROS_INFO("Written to %s", offline.output.c_str());
  if (!exit) Offer(offline, node);
}

void Run(ros::NodeHandle* node) {
  if (node->hasParam("bag")) {
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
  try {
    imu_pose_calib::Run(&node);
    return 0;
  } catch (const std::exception& error) {
    ROS_FATAL("%s", imu_pose_calib::OneLine(error).c_str());
    return imu_pose_calib::ExitStatus(error);
  }
}
