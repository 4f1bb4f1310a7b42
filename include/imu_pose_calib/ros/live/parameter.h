#pragma once

#include <ros/names.h>
#include <ros/param.h>

#include <string>
#include <type_traits>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// The private parameter `name` of this node, or `value` when it is not set. InputError when its
/// type is wrong. Needs no NodeHandle, which would start the threads of ROS.
template <typename T>
T RosParameter(const std::string& name, T value) {
  const std::string key = ros::names::resolve("~" + name);
  const char* type = std::is_same_v<T, bool>     ? "true or false"
                     : std::is_same_v<T, double> ? "a number"
                                                 : "a string";
  if (ros::param::has(key) && !ros::param::get(key, value))
    throw InputError("parameter " + key + " must be " + type);
  return value;
}

}  // namespace imu_pose_calib
