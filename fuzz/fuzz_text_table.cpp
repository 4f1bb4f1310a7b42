// Any text is a table of samples or an InputError.

#include <sstream>

#include "imu_pose_calib/ros/io/text_table.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace imu_pose_calib;
  const std::string text(reinterpret_cast<const char*>(data), size);
  const auto read = [&](auto read_table) {
    std::istringstream in(text);
    try {
      read_table(in);
    } catch (const InputError&) {
    }
  };
  ImuData imu;
  read([&](std::istream& in) { ReadPoseTable(in, "poses"); });
  read([&](std::istream& in) { ReadImuTable(in, "imu", &imu); });
  read([&](std::istream& in) { ReadSensorTable(in, "gyro", false); });
  read([&](std::istream& in) { ReadSensorTable(in, "accel", true); });
  read([&](std::istream& in) { ReadMocapCsv(in, "mocap", ""); });
  read([&](std::istream& in) { HasHeader(in, "poses", false); });
  return 0;
}
