// The core knows Eigen and Ceres, and nothing of ROS, files or logging. On Debian the ROS headers
// are on the default include path, so no compiler tells.

#include "run_executable.h"

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

/// scripts/include_graph.py on this repository, or on a small tree of its own.
class IncludeGraph : public ExecutableTest {};

const std::string kScript = "scripts/include_graph.py";

TEST_F(IncludeGraph, HasNoArrowBack) {
  const Outcome outcome =
      Run("/usr/bin/python3", IMU_POSE_CALIB_SOURCE_DIR "/" + kScript + " --check");
  EXPECT_EQ(outcome.status, 0) << outcome.out << outcome.err;
}

TEST_F(IncludeGraph, FindsRoomsAndUnitsThatIncludeEachOther) {
  for (const char* folder : {"scripts", "src/core/a", "src/core/b", "include/imu_pose_calib"})
    std::filesystem::create_directories(Path(folder));
  std::filesystem::copy(IMU_POSE_CALIB_SOURCE_DIR "/" + kScript, Path(kScript));
  Write("src/core/a/x.cpp", "#include \"imu_pose_calib/core/b/y.h\"\n");
  Write("src/core/b/y.cpp", "\n");
  EXPECT_EQ(Run("/usr/bin/python3", kScript + " --check").status, 0);
  Write("src/core/b/z.cpp", "#include \"imu_pose_calib/core/a/x.h\"\n");
  const Outcome rooms = Run("/usr/bin/python3", kScript + " --check");
  EXPECT_EQ(rooms.status, 1);
  EXPECT_TRUE(Contains(rooms.out, "rooms that include each other: core/a, core/b")) << rooms.out;
  EXPECT_FALSE(Contains(rooms.out, "units that include each other")) << rooms.out;
  Write("src/core/b/y.cpp", "#include \"imu_pose_calib/core/a/x.h\"\n");
  EXPECT_TRUE(Contains(Run("/usr/bin/python3", kScript + " --check").out,
                       "units that include each other: core/a/x, core/b/y"));
}

TEST_F(IncludeGraph, IsTheOneOfTheDocument) {
  const std::string graph = Run("/usr/bin/python3", IMU_POSE_CALIB_SOURCE_DIR "/" + kScript).out;
  EXPECT_TRUE(Contains(graph, "core.calibration[core/calibration] --> "));
  EXPECT_TRUE(Contains(ReadText(IMU_POSE_CALIB_SOURCE_DIR "/doc/architecture.md"),
                       "```mermaid\n" + graph + "```\n"));
}

}  // namespace
}  // namespace imu_pose_calib
