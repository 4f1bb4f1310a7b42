// Any bytes are a bag of ROS 2 or of ROS 1, whose messages can be read or are no such messages, or
// an InputError.

#include <tf2_msgs/TFMessage.h>
#include <unistd.h>

#include <cstdlib>
#include <fstream>

#include "imu_pose_calib/ros/io/bag_file.h"
#include "imu_pose_calib/ros/io/bags.h"

namespace {

using namespace imu_pose_calib;  // NOLINT(google-build-using-namespace)

template <typename Read>
void Try(Read read) {
  try {
    read();
  } catch (const InputError&) {
  }
}

template <typename Msg>
void ReadAs(std::string_view data) {
  for (const bool is_cdr : {false, true})
    Try([&] {
      Msg msg;
      MessageInput(data, is_cdr).next(msg);
    });
}

void ReadMessage(std::string_view data) {
  const std::string topic = "/x";
  ReadAs<sensor_msgs::Imu>(data);
  ReadAs<nav_msgs::Odometry>(data);
  ReadAs<tf2_msgs::TFMessage>(data);
  for (const std::string type :
       {"mocap4r2_msgs/RigidBodies", "motion_capture_tracking_interfaces/NamedPoseArray"})
    Try([&] { ReadBodies(BagMessage{topic, type, ros::Time(1), data}); });
}

/// In memory.
const std::string& BagPath() {
  static const std::string path = "/dev/shm/fuzz_ros2_bag." + std::to_string(getpid());
  static const int at_exit = std::atexit([] { unlink(BagPath().c_str()); });
  static_cast<void>(at_exit);
  return path;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  const std::string_view bytes(reinterpret_cast<const char*>(data), size);
  std::ofstream(BagPath(), std::ios::binary) << bytes;
  Try([&] {
    const auto file = OpenBagFile(BagPath());
    for (const BagFile::Entry& entry : file->entries())
      Try([&] { ReadMessage(file->Read(entry)); });
  });
  if (bytes.substr(0, 4) == kZstdMagic) Try([&] { ReadMessage(DecompressZstd(bytes, 1 << 24)); });
  ReadMessage(bytes);
  return 0;
}
