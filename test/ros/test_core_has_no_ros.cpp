// The core knows Eigen and Ceres, and nothing of ROS, files or logging. On Debian the ROS headers
// are on the default include path, so no compiler tells.

#include "test_util.h"

namespace imu_pose_calib {
namespace {

const char* const kCoreFolders[] = {"include/imu_pose_calib/core", "src/core", "test/core"};
const char* const kForbidden[] = {"ros/",       "rosbag/",   "_msgs/",    "yaml-cpp",
                                  "<iostream>", "<fstream>", "std::cout", "std::cerr"};

/// Line numbers and words of `text` that a core file must not contain.
std::string Violations(const std::string& text) {
  std::string violations, line;
  std::istringstream lines(text);
  for (int number = 1; std::getline(lines, line); ++number)
    for (const char* word : kForbidden)
      if (Contains(line, word)) violations += " " + std::to_string(number) + ":" + word;
  return violations;
}

TEST(Core, HasNoRos) {
  size_t files = 0;
  for (const char* folder : kCoreFolders) {
    const auto root = std::filesystem::path(IMU_POSE_CALIB_SOURCE_DIR) / folder;
    for (const auto& entry : std::filesystem::recursive_directory_iterator(root)) {
      if (!entry.is_regular_file()) continue;
      EXPECT_EQ(Violations(ReadText(entry.path().string())), "") << entry.path();
      ++files;
    }
  }
  EXPECT_GT(files, 10u);
}

TEST(Core, WouldBeCaughtUsingRos) {
  EXPECT_EQ(Violations("int a;\n#include <ros/ros.h>\n"), " 2:ros/");
  EXPECT_EQ(Violations("#include \"imu_pose_calib/ros/io/bag_reader.h\"\n"), " 1:ros/");
  EXPECT_EQ(Violations("#include <sensor_msgs/Imu.h>"), " 1:_msgs/");
  EXPECT_EQ(Violations("#include <Eigen/Core>\n"), "");
}

}  // namespace
}  // namespace imu_pose_calib
