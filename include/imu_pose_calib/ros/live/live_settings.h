#pragma once

#include <ros/names.h>
#include <ros/node_handle.h>
#include <ros/param.h>

#include <string>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/live/live_calibration.h"

namespace imu_pose_calib {

/// Parameter `name`, or `fallback` when it is not set. InputError when its type is wrong. Needs no
/// NodeHandle, which would start the threads of ROS.
template <typename T>
T Param(const std::string& name, const T& fallback, const char* type) {
  T value = fallback;
  if (ros::param::has(name) && !ros::param::get(name, value))
    throw InputError("parameter " + ros::names::resolve(name) + " must be " + type);
  return value;
}

/// The same of a node's own names.
template <typename T>
T Param(const ros::NodeHandle& node, const std::string& name, const T& fallback, const char* type) {
  return Param<T>(node.resolveName(name), fallback, type);
}

/// Parameters of the live node; README.md lists them.
struct LiveSettings {
  /// Topics and frame of several IMUs have white space between them.
  std::string imu_topic, gyro_topic, accel_topic, pose_topic, tf_parent, tf_child;
  std::string marker_frame, imu_frame;  ///< empty: of the messages
  std::string output, imu_yaml;
  bool auto_save = false;
  CalibrationOptions calibration;
  LiveOptions live;
};

/// From the parameters of `node`. Throws InputError for those that cannot be used as given.
LiveSettings ReadLiveSettings(const ros::NodeHandle& node);

}  // namespace imu_pose_calib
