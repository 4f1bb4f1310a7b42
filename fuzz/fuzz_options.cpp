// Any text is a set of options, which reads back from its own YAML, or an InputError.

#include <cstdlib>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/ros_options.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace imu_pose_calib;
  try {
    const CalibrationOptions options =
        ParseOptions(std::string(reinterpret_cast<const char*>(data), size));
    if (ToYaml(ParseOptions(ToYaml(options))) != ToYaml(options)) std::abort();
  } catch (const InputError&) {
  }
  return 0;
}
