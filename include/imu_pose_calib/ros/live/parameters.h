#pragma once

#include <ros/node_handle.h>

#include <string>

#include "imu_pose_calib/core/types.h"

namespace imu_pose_calib {

/// Parameter `name`, or `fallback` when it is not set. InputError when its type is wrong.
template <typename T>
T Param(const ros::NodeHandle& node, const std::string& name, const T& fallback, const char* type) {
  T value = fallback;
  if (node.hasParam(name) && !node.getParam(name, value))
    throw InputError("parameter " + node.resolveName(name) + " must be " + type);
  return value;
}

}  // namespace imu_pose_calib
