#pragma once

#include "test_util.h"

namespace imu_pose_calib {

struct Outcome {
  int status = -1;
  std::string out, err;
};

/// Tests that run executables as a user or a script does, in a directory of their own.
class ExecutableTest : public TempDirTest {
 protected:
  /// Runs EXECUTABLE, one of the package's or a path, with ARGUMENTS (shell syntax) in the
  /// temporary directory.
  Outcome Run(const std::string& executable, const std::string& arguments) const {
    const std::filesystem::path path = std::filesystem::path(IMU_POSE_CALIB_BIN_DIR) / executable;
    const std::string command = "cd '" + dir_.string() + "' && '" + path.string() + "' " +
                                arguments + " > out.txt 2> err.txt";
    const int status = std::system(command.c_str());
    return {WIFEXITED(status) ? WEXITSTATUS(status) : -1, ReadText(Path("out.txt")),
            ReadText(Path("err.txt"))};
  }
  Outcome Calibrate(const std::string& arguments) const { return Run("calibrate_bag", arguments); }

  /// Expects exit status, one line on stderr with every part, and no result.
  void ExpectFailure(const std::string& arguments, int status,
                     const std::vector<std::string>& parts) const {
    const Outcome outcome = Calibrate(arguments);
    EXPECT_EQ(outcome.status, status) << outcome.err;
    EXPECT_EQ(outcome.err.compare(0, 22, "calibrate_bag: error: "), 0) << outcome.err;
    EXPECT_EQ(std::count(outcome.err.begin(), outcome.err.end(), '\n'), 1) << outcome.err;
    EXPECT_FALSE(Contains(outcome.err, "\x1b")) << outcome.err;
    for (const std::string& part : parts)
      EXPECT_TRUE(Contains(outcome.err, part)) << "'" << part << "' is missing in " << outcome.err;
    EXPECT_EQ(outcome.out, "");
    EXPECT_FALSE(std::filesystem::exists(Path("x.calibration.yaml")));
  }
};

}  // namespace imu_pose_calib
