#pragma once

#include <rosbag/bag.h>
#include <rosbag/view.h>
#include <sensor_msgs/PointCloud2.h>
#include <tf2_msgs/TFMessage.h>

#include <string>

#include "imu_pose_calib/ros/io/bag_writer.h"
#include "imu_pose_calib/ros/io/conversions.h"

namespace imu_pose_calib {

template <typename Msg>
bool WriteAs(const rosbag::MessageInstance& message, Ros2Writer* writer) {
  const auto msg = message.instantiate<Msg>();
  if (msg) writer->Write(message.getTopic(), ToNanoseconds(message.getTime()), *msg);
  return msg != nullptr;
}

/// Writes the messages of a bag of ROS 1 as one of ROS 2, from the message `first` on and every
/// `step`.
inline void ToRos2(const std::string& from, const std::string& to, const Ros2Format& format,
                   int first = 0, int step = 1) {
  rosbag::Bag in(from);
  Ros2Writer out(to, format);
  int k = 0;
  for (const rosbag::MessageInstance& message : rosbag::View(in)) {
    if (k++ % step != first) continue;
    const bool is_known = WriteAs<sensor_msgs::Imu>(message, &out) ||
                          WriteAs<tf2_msgs::TFMessage>(message, &out) ||
                          WriteAs<geometry_msgs::PoseStamped>(message, &out) ||
                          WriteAs<geometry_msgs::TransformStamped>(message, &out) ||
                          WriteAs<geometry_msgs::PoseWithCovarianceStamped>(message, &out) ||
                          WriteAs<geometry_msgs::Vector3Stamped>(message, &out) ||
                          WriteAs<nav_msgs::Odometry>(message, &out) ||
                          WriteAs<sensor_msgs::PointCloud2>(message, &out);
    if (!is_known) throw InputError("no such message is known: " + message.getDataType());
  }
  out.Close();
}

/// Ways to store a bag of ROS 2: a name, which is the ending of the file too, and a format.
struct Ros2Way {
  std::string ending;
  Ros2Format format;
};

inline std::vector<Ros2Way> Ros2Ways() {
  std::vector<Ros2Way> ways;
  const auto add = [&ways](const char* ending, const char* chunks, bool messages) {
    Ros2Format format;
    format.is_mcap = std::string(ending).find("mcap") != std::string::npos;
    format.chunk_compression = chunks;
    format.compress_messages = messages;
    format.chunk_size = 16 * 1024;
    ways.push_back({ending, format});
  };
  add("mcap", "", false);
  add("none.mcap", "none", false);
  add("lz4.mcap", "lz4", false);
  add("zstd.mcap", "zstd", false);
  add("message.mcap", "", true);
  add("db3", "", false);
  add("message.db3", "", true);
  return ways;
}

}  // namespace imu_pose_calib
