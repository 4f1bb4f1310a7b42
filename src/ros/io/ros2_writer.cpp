#include "imu_pose_calib/ros/io/ros2_writer.h"

#include <algorithm>
#include <boost/algorithm/string.hpp>
#include <sstream>

#include "imu_pose_calib/ros/io/compression.h"

namespace imu_pose_calib {

Ros2Writer::Ros2Writer(const std::string& path, const Ros2Format& format)
    : format_(format), storage_(format.is_mcap ? CreateMcap(path, format) : CreateSqlite(path)) {}

void Ros2Writer::Add(const std::string& topic,
                     const std::string& ros1_type,
                     const std::string& ros1_definition,
                     int64_t t_ns,
                     const std::string& data) {
  const auto [known, is_new] = topics_.emplace(topic, static_cast<uint32_t>(topics_.size()));
  if (is_new)
    storage_->AddTopic(
        topic, boost::replace_first_copy(ros1_type, "/", "/msg/"), Ros2Definition(ros1_definition));
  storage_->Write(known->second, t_ns, format_.compress_messages ? CompressZstd(data) : data);
}

std::string Ros2Definition(const std::string& ros1_definition) {
  std::istringstream lines(ros1_definition);
  std::string line, separator, text;
  bool has_time = false;
  while (std::getline(lines, line)) {
    line.resize(std::min(line.find('#'), line.size()));
    boost::trim(line);
    if (line.empty() || line == "uint32 seq") continue;  // a field of ROS 1's Header alone
    if (boost::starts_with(line, "====")) separator = line;
    if (boost::starts_with(line, "Header ")) line = "std_msgs/" + line;
    if (boost::starts_with(line, "time ")) {
      line = "builtin_interfaces/Time" + line.substr(4);
      has_time = true;
    }
    text += line + "\n";
  }
  if (has_time) text += separator + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";
  return text;
}

}  // namespace imu_pose_calib
