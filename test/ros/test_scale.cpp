// benchmark/scale.py as one runs it, on its shortest recording.

#include <sstream>

#include "run_executable.h"

namespace imu_pose_calib {
namespace {

using Row = std::vector<std::string>;

/// Cells of "| a | b |".
Row Cells(const std::string& line) {
  Row cells;
  for (size_t begin = 2, end; (end = line.find(" |", begin)) != std::string::npos; begin = end + 3)
    cells.push_back(line.substr(begin, end - begin));
  return cells;
}

class ScaleTest : public ExecutableTest {
 protected:
  Outcome Scale(const std::string& arguments) const {
    return Run(IMU_POSE_CALIB_SOURCE_DIR "/benchmark/scale.py",
               "--devel " IMU_POSE_CALIB_BIN_DIR "/../.. " + arguments);
  }
};

TEST_F(ScaleTest, TablesTwoBuildsInTurn) {
  const Outcome outcome =
      Scale("--durations 10 --runs 1 --against " IMU_POSE_CALIB_BIN_DIR "/../..");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  std::istringstream lines(outcome.out);
  std::vector<Row> rows;
  for (std::string line; std::getline(lines, line);)
    if (!Contains(line, "|---")) rows.push_back(Cells(line));
  ASSERT_EQ(rows.size(), 4) << outcome.out;
  const Row columns = {"recording",     "build",           "real [s]",        "user [s]",
                       "memory [MB]",   "real per s [ms]", "user per s [ms]", "memory per s [MB]",
                       "p off [sigma]", "apart [sigma]"};
  EXPECT_EQ(rows[0], columns);
  for (const Row& row : rows) ASSERT_EQ(row.size(), columns.size()) << outcome.out;
  for (const Row& build : {rows[1], rows[2]}) {
    EXPECT_EQ(build[0], "10 s");
    EXPECT_GT(std::stod(build[3]), 0.01);  // a process that only starts takes less
    EXPECT_GT(std::stod(build[4]), 10.0);
    EXPECT_NEAR(std::stod(build[5]) / std::stod(build[2]), 100.0, 10.0);
    EXPECT_NEAR(std::stod(build[7]) / std::stod(build[4]), 0.1, 0.01);
    EXPECT_GT(std::stod(build[8]), 0.0);
    EXPECT_LT(std::stod(build[8]), 5.0);
  }
  EXPECT_EQ(rows[1][1] + rows[2][1] + rows[3][1], "ABA / B");
  EXPECT_GT(std::stod(rows[3][4]), 0.5);  // of memory: the build is the same
  EXPECT_LT(std::stod(rows[3][4]), 2.0);
  EXPECT_EQ(rows[3][9], "0.000");
}

TEST_F(ScaleTest, SaysWhyARunFailed) {
  const Outcome outcome = Scale("--bags nothing.bag");
  EXPECT_EQ(outcome.status, 1);
  EXPECT_TRUE(Contains(outcome.err, "scale.py: error: ")) << outcome.err;
  EXPECT_TRUE(Contains(outcome.err, "bag 'nothing.bag' does not exist")) << outcome.err;
}

TEST_F(ScaleTest, RefusesWhatItCannotRun) {
  const Outcome outcome = Scale("--against here");
  EXPECT_EQ(outcome.status, 1);
  EXPECT_TRUE(Contains(outcome.err, "here/lib/imu_pose_calib/calibrate_bag cannot be run"))
      << outcome.err;
  EXPECT_EQ(Scale("--runs 0").status, 2);
}

}  // namespace
}  // namespace imu_pose_calib
