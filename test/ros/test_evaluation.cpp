// evaluate as a user runs it, and its scripts.

#include <yaml-cpp/yaml.h>

#include <chrono>
#include <csignal>
#include <thread>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/simulation/simulator_options.h"
#include "run_executable.h"

namespace imu_pose_calib {
namespace {

TEST(EvaluationScriptsTest, Hold) {
  EXPECT_EQ(std::system("/usr/bin/python3 '" IMU_POSE_CALIB_SOURCE_DIR
                        "/test/ros/test_evaluation.py' '" IMU_POSE_CALIB_BIN_DIR "'"),
            0);
}

class EvaluateTest : public ExecutableTest {
 protected:
  Outcome Evaluate(const std::string& out, const std::string& more = "") const {
    return Run("evaluate",
               "--simulate --experiments excitation --trials 1 --jobs 2 --out " + out + " " + more);
  }
  std::vector<std::string> Tables(const std::string& out) const {
    std::vector<std::string> tables;
    for (const char* name : {"evaluation.md", "cells.csv", "trials.csv",
                             "excitation_simulation.svg", "excitation_simulation.png"}) {
      tables.push_back(ReadText(Path(out + "/" + name)));
      EXPECT_FALSE(tables.back().empty()) << name;
    }
    return tables;
  }
};

TEST_F(EvaluateTest, EndsInTheSameTablesWhenItIsKilledOrShared) {
  const Outcome outcome = Evaluate("whole");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const std::vector<std::string> whole = Tables("whole");
  EXPECT_TRUE(Contains(whole[0], "| drone |"));
  EXPECT_TRUE(Contains(whole[1], "excitation,simulation,\"tumble\",joint,1,1,"));
  EXPECT_TRUE(
      Contains(ReadText(Path("whole/usage.md")), "| excitation | simulation | arm | joint |"));

  // Killed after some trials.
  const std::string evaluate = "cd '" + dir_.string() +
                               "' && exec '" IMU_POSE_CALIB_BIN_DIR
                               "/evaluate' --simulate --experiments excitation --trials 1 --jobs 1 "
                               "--out killed";
  const pid_t child = fork();
  if (child == 0) execl("/bin/sh", "sh", "-c", evaluate.c_str(), nullptr);
  const auto count = [&] {
    size_t trials = 0;
    std::error_code none;
    for (const auto& entry :
         std::filesystem::recursive_directory_iterator(Path("killed/trials"), none))
      trials += entry.path().extension() == ".yaml" ? 1 : 0;
    return trials;
  };
  for (int i = 0; i < 600 && count() < 2; ++i)
    std::this_thread::sleep_for(std::chrono::milliseconds(100));
  kill(child, SIGKILL);
  waitpid(child, nullptr, 0);
  EXPECT_GE(count(), 2u);
  EXPECT_LT(count(), 8u);
  EXPECT_FALSE(std::filesystem::exists(Path("killed/evaluation.md")));
  ASSERT_EQ(Evaluate("killed").status, 0);
  EXPECT_EQ(Tables("killed"), whole);

  // Shared by the commands that it prints.
  const Outcome jobs = Evaluate("shared", "--print-jobs 2");
  ASSERT_EQ(std::count(jobs.out.begin(), jobs.out.end(), '\n'), 2) << jobs.out;
  std::istringstream lines(jobs.out);
  std::string line;
  std::getline(lines, line);
  ASSERT_EQ(std::system(("cd '" + dir_.string() + "' && " + line + " > /dev/null").c_str()), 0);
  const Outcome early = Evaluate("shared", "--merge");
  EXPECT_EQ(early.status, 1);
  EXPECT_TRUE(Contains(early.err, "4 of 8 trials are missing")) << early.err;
  std::getline(lines, line);
  ASSERT_EQ(std::system(("cd '" + dir_.string() + "' && " + line + " > /dev/null").c_str()), 0);
  const Outcome merged = Evaluate("shared", "--merge");
  ASSERT_EQ(merged.status, 0) << merged.err;
  EXPECT_EQ(Tables("shared"), whole);
}

TEST_F(EvaluateTest, RefusesWhatItCannotDo) {
  const auto expect = [&](const std::string& arguments, const std::vector<std::string>& parts) {
    const Outcome outcome = Run("evaluate", arguments);
    EXPECT_EQ(outcome.status, 1) << arguments;
    for (const std::string& part : parts)
      EXPECT_TRUE(Contains(outcome.err, part)) << arguments << ": " << outcome.err;
  };
  expect("--experiments pose_noize", {"'pose_noize'", "did you mean 'pose_noise'?"});
  expect("--trials 0", {"--trials = 0", "1 to 100000"});
  expect("--job 3/2", {"--job '3/2'", "I from 1 to K"});
  expect("--bag x.bag --experiments lever_arm", {"none of the experiments runs on a bag"});
  expect("--dataset kitti --data .", {"'kitti'", "tum-vi, euroc or broad"});
  expect("--dataset euroc", {"--data", "https://doi.org/10.3929/ethz-b-000690084"});
  expect("--dataset broad --data .", {"no sequence of 'broad'", "convert_broad.py"});
  expect("--batch nowhere", {"'nowhere' is not a folder"});
  expect("--chain '0 0 0 0 0 0 1' --simulate", {"--chain takes two transforms"});
}

/// A guess does not matter: errors are against what the same 20 s say without one.
TEST_F(EvaluateTest, GuessesOnABagEndInTheResultWithoutOne) {
  ASSERT_EQ(Run("simulate_bag", "A.bag --duration 25 --seed 5").status, 0);
  const Outcome outcome =
      Run("evaluate", "--bag A.bag --experiments guess --trials 1 --quiet --out guess");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_TRUE(
      std::filesystem::exists(Path("guess/trials/reference/sample/duration_20/joint.yaml")));
  const std::string cells = ReadText(Path("guess/cells.csv"));
  for (const char* method : {"gp", "joint"}) {
    EXPECT_TRUE(Contains(cells, std::string("guess,sample,\"none\",") + method + ",1,1,1,0,0,0,0,"))
        << cells;
    EXPECT_TRUE(Contains(cells, std::string("guess,sample,\"wrong\",") + method + ",6,6,6,"))
        << cells;
  }
  // The errors are 0; then come the sigmas.
  const YAML::Node none =
      YAML::LoadFile(Path("guess/trials/guess/sample/guess_none/joint/001.yaml"));
  const auto std = none["std"].as<std::vector<double>>();
  EXPECT_TRUE(Contains(cells, Format("\"none\",joint,1,1,1,0,0,0,0,%.9g,%.9g,%.9g,%.9g,0,",
                                     180.0 / M_PI * Eigen::Vector3d(std[3], std[4], std[5]).norm(),
                                     1e3 * Eigen::Vector3d(std[0], std[1], std[2]).norm(),
                                     1e3 * none["time_shift"][1].as<double>(),
                                     1e3 * none["accel_delay"][1].as<double>())))
      << cells;
}

TEST_F(EvaluateTest, ComparesBagsOfOneRigAndWithAChain) {
  ASSERT_EQ(Run("simulate_bag", "A.bag --duration 15 --seed 5").status, 0);
  ASSERT_EQ(Run("simulate_bag", "B.bag --duration 15 --seed 6").status, 0);
  // T_marker_camera and T_camera_imu that are together 10 mm along x from the simulator's T_MI.
  const Outcome outcome = Run("evaluate",
                              "--experiments repeatability --rig A.bag B.bag --chain "
                              "'0.06 -0.03 0.08 -0.5 0.5 0.5 0.5' '0 0 0 0 0 0 1' --out rig");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const std::string text = ReadText(Path("rig/evaluation.md"));
  EXPECT_TRUE(Contains(text, "| B less A | ")) << text;
  EXPECT_TRUE(Contains(text, "Less the chained calibration")) << text;
  const size_t joint = text.find("| A | ", text.rfind("Less the chained calibration"));
  ASSERT_NE(joint, std::string::npos) << text;
  std::istringstream row(text.substr(joint + 6));
  double degrees = NAN, millimetres = NAN;
  std::string bar;
  row >> degrees >> bar >> millimetres;
  EXPECT_LT(degrees, 0.1);
  EXPECT_NEAR(millimetres, 10.0, 1.0);
}

// --- Batch and datasets ---

TEST_F(EvaluateTest, BatchHasARowForEachBag) {
  std::filesystem::create_directories(dir_ / "fleet/b.1");
  ASSERT_EQ(Run("simulate_bag", "fleet/good.bag --duration 15 --seed 5").status, 0);
  ASSERT_EQ(Run("simulate_bag", "fleet/b.1/planar.bag --duration 15 --motion planar").status, 0);
  Write("fleet/cut.bag", ReadText(Path("fleet/good.bag")).substr(0, 5000));
  const Outcome outcome = Run("evaluate", "--batch fleet --out done");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_TRUE(Contains(outcome.err, "2 of 3 bags")) << outcome.err;
  EXPECT_TRUE(Contains(outcome.err, "b.1/planar, cut")) << outcome.err;
  const std::string table = ReadText(Path("done/sequences.md"));
  EXPECT_TRUE(Contains(table, "| good | ok | ")) << table;
  EXPECT_TRUE(Contains(table, "| b.1/planar | refused | the marker turns about one axis")) << table;
  EXPECT_TRUE(Contains(table, "| cut | failed | bag ")) << table;
  EXPECT_TRUE(std::filesystem::exists(Path("done/good.calibration.yaml")));
  EXPECT_TRUE(std::filesystem::exists(Path("done/good.calibration.report.html")));
  EXPECT_FALSE(std::filesystem::exists(Path("done/b.1/planar.calibration.yaml")));
  EXPECT_TRUE(std::filesystem::exists(Path("done/b.1/planar.calibration.report.html")));
  EXPECT_TRUE(
      Contains(ReadText(Path("done/sequences.report.html")), "1 of 3 recordings have a result"));

  std::filesystem::remove(dir_ / "fleet/cut.bag");
  std::filesystem::remove(dir_ / "fleet/b.1/planar.bag");
  EXPECT_EQ(Run("evaluate", "--batch fleet --out done").status, 0);
}

/// A sensor.yaml as EuRoC has it: the marker in the body frame, which is the IMU's.
std::string SensorYaml(const Rigid3& T_BM) {
  std::ostringstream text;
  text.precision(17);
  text
      << "#Default\nsensor_type: vicon\ncomment: of a test\nT_BS:\n  cols: 4\n  rows: 4\n  data: [";
  const Eigen::Matrix4d T = T_BM.Matrix();
  for (int i = 0; i < 16; ++i) text << (i > 0 ? ", " : "") << T(i / 4, i % 4);
  text << "]\n";
  return text.str();
}

TEST_F(EvaluateTest, AuditsWhatADatasetPublishes) {
  const SimulatorOptions truth;
  std::filesystem::create_directories(dir_ / "data");
  for (const char* name : {"V1", "V2"})
    ASSERT_EQ(Run("simulate_bag", std::string("data/") + name +
                                      " --format asl --duration 20 --time-shift 0 --seed " +
                                      (name[1] + std::string("0")))
                  .status,
              0);
  Rigid3 wrong = truth.T_MI.Inverse();
  wrong.p.z() += 0.02;
  Write("data/V1/mocap0/sensor.yaml", SensorYaml(truth.T_MI.Inverse()));
  Write("data/V2/mocap0/sensor.yaml", SensorYaml(wrong));
  const Outcome outcome = Run("evaluate", "--dataset euroc --data data --out done");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const auto row = [&](const std::string& name) {
    const size_t audit = outcome.out.find("Less what is published");
    const size_t begin = outcome.out.find("| " + name, audit);
    return outcome.out.substr(begin, outcome.out.find('\n', begin) - begin);
  };
  EXPECT_TRUE(Contains(row("V1/mocap0"), "| yes | yes |")) << outcome.out;
  EXPECT_TRUE(Contains(row("V2/mocap0"), "| no | yes |")) << outcome.out;
  EXPECT_TRUE(Contains(outcome.out, "Scatter of 2")) << outcome.out;
}

}  // namespace
}  // namespace imu_pose_calib
