// Any bytes are a bag of ROS 2, whose messages can be read or are no such messages, or an
// InputError.

#include <tf2_msgs/TFMessage.h>
#include <unistd.h>

#include <cstdio>
#include <cstdlib>

#include "imu_pose_calib/ros/io/bags.h"
#include "imu_pose_calib/ros/io/compression.h"
#include "imu_pose_calib/ros/io/ros2_file.h"

namespace {

using namespace imu_pose_calib;  // NOLINT(google-build-using-namespace)

template <typename Read>
void Try(Read read) {
  try {
    read();
  } catch (const InputError&) {
  }
}

void ReadMessage(std::string_view data) {
  const std::string topic = "/x";
  Try([&] { FromCdr<sensor_msgs::Imu>(data); });
  Try([&] { FromCdr<nav_msgs::Odometry>(data); });
  Try([&] { FromCdr<tf2_msgs::TFMessage>(data); });
  for (const std::string type :
       {"mocap4r2_msgs/RigidBodies", "motion_capture_tracking_interfaces/NamedPoseArray"})
    Try([&] { ReadBodies(BagMessage{topic, type, ros::Time(1), data}); });
}

void ReadMessages(Ros2File* file) {
  for (const Ros2File::Entry& entry : file->entries()) Try([&] { ReadMessage(file->Read(entry)); });
}

/// In memory, where SQLite can open it.
const std::string& DatabasePath() {
  static const std::string path = "/dev/shm/fuzz_ros2_bag." + std::to_string(getpid());
  static const int at_exit = std::atexit([] { unlink(DatabasePath().c_str()); });
  static_cast<void>(at_exit);
  return path;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  const std::string_view bytes(reinterpret_cast<const char*>(data), size);
  if (IsSqlite(bytes)) {
    std::FILE* file = std::fopen(DatabasePath().c_str(), "wb");
    std::fwrite(data, 1, size, file);
    std::fclose(file);
    Try([&] { ReadMessages(OpenSqlite(DatabasePath(), "x").get()); });
  } else if (IsZstd(bytes)) {
    Try([&] { ReadMessage(DecompressZstd(bytes, 1 << 24)); });
  } else {
    Try([&] { ReadMessages(OpenMcap(bytes, "x").get()); });
    ReadMessage(bytes);
  }
  return 0;
}
