// Any text is the noise of an IMU, within the bounds of the options, or an InputError.

#include <cstdint>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/ros_options.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace imu_pose_calib;
  CalibrationOptions options;
  try {
    ParseImuYaml(std::string(reinterpret_cast<const char*>(data), size), &options);
  } catch (const InputError&) {
    return 0;
  }
  options.Validate();
  return 0;
}
