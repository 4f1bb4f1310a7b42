// calibrate_bag and simulate_bag end to end, as a user or a script runs them.

#include <yaml-cpp/yaml.h>

#include <limits>

#include "imu_pose_calib/core/types.h"
#include "imu_pose_calib/ros/bag_writer.h"
#include "imu_pose_calib/ros/result_yaml.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

struct Outcome {
  int status = -1;
  std::string out, err;
};

class ExecutableTest : public TempDirTest {
 protected:
  /// Runs EXECUTABLE with ARGUMENTS (shell syntax) in the temporary directory.
  Outcome Run(const std::string& executable, const std::string& arguments) const {
    const std::string command = "cd '" + dir_.string() + "' && '" IMU_POSE_CALIB_BIN_DIR "/" +
                                executable + "' " + arguments + " > out.txt 2> err.txt";
    const int status = std::system(command.c_str());
    return {WIFEXITED(status) ? WEXITSTATUS(status) : -1,
            ReadText(Path("out.txt")),
            ReadText(Path("err.txt"))};
  }
  Outcome Calibrate(const std::string& arguments) const { return Run("calibrate_bag", arguments); }

  /// Expects exit status, one line on stderr with every part, and no result.
  void ExpectFailure(const std::string& arguments,
                     int status,
                     const std::vector<std::string>& parts) const {
    const Outcome outcome = Calibrate(arguments);
    EXPECT_EQ(outcome.status, status) << outcome.err;
    EXPECT_EQ(outcome.err.compare(0, 22, "calibrate_bag: error: "), 0) << outcome.err;
    EXPECT_EQ(std::count(outcome.err.begin(), outcome.err.end(), '\n'), 1) << outcome.err;
    for (const std::string& part : parts)
      EXPECT_TRUE(Contains(outcome.err, part)) << "'" << part << "' is missing in " << outcome.err;
    EXPECT_EQ(outcome.out, "");
    EXPECT_FALSE(std::filesystem::exists(Path("x.calibration.yaml")));
  }

  void WriteSimulation(const CalibrationData& data) const { WriteBag(Path("x.bag"), data, {}); }

  static SimulatorOptions Handheld() {
    SimulatorOptions options;
    options.duration_s = 15.0;
    return options;
  }
};

// --- calibrate_bag: results ---

/// Distance of a result file from the truth of its bag: translation [m], rotation [rad], shift [s].
Eigen::Vector3d Errors(const YAML::Node& result, const YAML::Node& truth) {
  const auto vector = [](const YAML::Node& node) {
    return Eigen::Vector3d(node[0].as<double>(), node[1].as<double>(), node[2].as<double>());
  };
  const auto quaternion = [](const YAML::Node& node) {
    return Eigen::Quaterniond(
        node[3].as<double>(), node[0].as<double>(), node[1].as<double>(), node[2].as<double>());
  };
  const YAML::Node transform = result["transform"];
  return {(vector(transform["translation"]) - vector(truth["translation"])).norm(),
          quaternion(transform["rotation"]).angularDistance(quaternion(truth["rotation"])),
          std::abs(result["time_shift"].as<double>() - truth["time_shift"].as<double>())};
}

TEST_F(ExecutableTest, CalibratesASimulatedBag) {
  ASSERT_EQ(Run("simulate_bag", "x.bag --duration 20 --time-shift -0.035 --seed=5").status, 0);
  const Outcome outcome = Calibrate("x.bag");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(outcome.err, "");
  EXPECT_TRUE(Contains(outcome.out, "x_marker = R x_imu + p")) << outcome.out;
  EXPECT_TRUE(Contains(outcome.out, "Written to x.calibration.yaml")) << outcome.out;

  const YAML::Node result = YAML::LoadFile(Path("x.calibration.yaml"));
  const Eigen::Vector3d errors = Errors(result, YAML::LoadFile(Path("x.truth.yaml")));
  EXPECT_LT(errors[0], 2e-3);
  EXPECT_LT(errors[1], 1e-3);
  EXPECT_LT(errors[2], 2e-4);
  EXPECT_EQ(result["frames"]["marker"].as<std::string>(), "marker");
}

TEST_F(ExecutableTest, CalibratesASplitImuOnAForeignClock) {
  ASSERT_EQ(Run("simulate_bag",
                "x.bag --duration 20 --split --pose-type TransformStamped --time-shift 1034771.5")
                .status,
            0);
  const Outcome outcome = Calibrate(
      "x.bag --output=y.yaml --gyro-topic /imu/gyro --accel-topic /imu/accel "
      "--pose-topic=/mocap/pose --marker-frame rig --imu-frame /imu_link --method gp");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const YAML::Node result = YAML::LoadFile(Path("y.yaml"));
  const Eigen::Vector3d errors = Errors(result, YAML::LoadFile(Path("x.truth.yaml")));
  EXPECT_LT(errors[0], 2e-3);
  EXPECT_LT(errors[1], 1e-3);
  EXPECT_LT(errors[2], 2e-4);
  EXPECT_EQ(result["frames"]["marker"].as<std::string>(), "rig");
  EXPECT_EQ(result["frames"]["imu"].as<std::string>(), "imu_link");
  EXPECT_FALSE(std::filesystem::exists(Path("x.calibration.yaml")));
}

TEST_F(ExecutableTest, UsesTheConfigAndTheSpan) {
  WriteSimulation(Simulate(Handheld()));
  Write("c.yaml", "estimate_accel_delay: false\naccel_delay: 0.0\n");
  const Outcome outcome = Calibrate("x.bag --config c.yaml --start 2 --duration 10 --quiet");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(outcome.out, "");
  const YAML::Node result = YAML::LoadFile(Path("x.calibration.yaml"));
  EXPECT_EQ(result["accel_delay_std"].as<double>(), 0.0);
  EXPECT_NEAR(result["data"]["duration"].as<double>(), 10.0, 0.1);
}

TEST_F(ExecutableTest, PrintsTheResultThatCannotBeWritten) {
  WriteSimulation(Simulate(Handheld()));
  const Outcome outcome = Calibrate("x.bag --output no/such/dir.yaml");
  EXPECT_EQ(outcome.status, 1);
  EXPECT_TRUE(Contains(outcome.out, "x_marker = R x_imu + p")) << outcome.out;
  EXPECT_TRUE(Contains(outcome.out, "static_transform_publisher")) << outcome.out;
  EXPECT_EQ(outcome.err,
            "calibrate_bag: error: output 'no/such/dir.yaml' cannot be written: No such file or "
            "directory\n");
}

TEST_F(ExecutableTest, HelpAndVersionSucceed) {
  EXPECT_EQ(Calibrate("--help").status, 0);
  EXPECT_TRUE(Contains(Calibrate("--help").out, "--pose-topic"));
  EXPECT_EQ(Calibrate("--version").out, std::string("imu_pose_calib ") + kVersion + "\n");
  EXPECT_EQ(Run("simulate_bag", "--help").status, 0);
}

// --- calibrate_bag: usage and input, exit status 1 ---

TEST_F(ExecutableTest, RefusesBadUsage) {
  ExpectFailure("", 1, {"no bag"});
  ExpectFailure("x.bag --imu_topic /imu", 1, {"imu_topic"});
  ExpectFailure("x.bag --imu /imu", 1, {"--imu"});
  ExpectFailure("x.bag y.bag", 1, {"positional"});
  ExpectFailure("x.bag --start soon", 1, {"start", "soon"});
  ExpectFailure("x.bag --output", 1, {"--output"});
}

TEST_F(ExecutableTest, RefusesBadInput) {
  ExpectFailure("missing.bag", 1, {"missing.bag", "does not exist"});
  WriteSimulation(Simulate(ShortSimulation()));
  ExpectFailure("x.bag --method joint2", 1, {"'joint2'", "available: joint, gp"});
  ExpectFailure("x.bag --config missing.yaml", 1, {"missing.yaml"});
  ExpectFailure("x.bag --pose-topic /imu", 1, {"/imu", "sensor_msgs/Imu"});
  ExpectFailure("x.bag --imu-topic /foo", 1, {"imu_topic '/foo' is not in x.bag; it has: /imu"});
  ExpectFailure("x.bag --output x.bag", 1, {"the bag itself"});
  EXPECT_TRUE(std::filesystem::exists(Path("x.bag")));
}

TEST_F(ExecutableTest, RefusesABagWithoutImuMessages) {
  CalibrationData data = Simulate(ShortSimulation());
  data.gyro.clear();
  data.accel.clear();
  WriteSimulation(data);
  ExpectFailure("x.bag", 1, {"no topic of type sensor_msgs/Imu", "/mocap/pose"});
}

TEST_F(ExecutableTest, RefusesAnEmptyBag) {
  WriteSimulation({});
  ExpectFailure("x.bag", 1, {"x.bag", "no messages"});
}

// --- calibrate_bag: data that cannot be calibrated, exit status 2 ---

TEST_F(ExecutableTest, RefusesMotionThatDeterminesTooLittle) {
  for (const Motion motion : {Motion::kStatic, Motion::kPlanar, Motion::kHinge}) {
    SimulatorOptions options = Handheld();
    options.motion = motion;
    WriteSimulation(Simulate(options));
    ExpectFailure("x.bag", 2, {"turn"});
  }
}

TEST_F(ExecutableTest, RefusesDataWithoutOverlap) {
  CalibrationData data = Simulate(Handheld());
  data.poses.resize(300);  // 3 s
  WriteSimulation(data);
  ExpectFailure("x.bag", 2, {"pose", "span 2.99 s", "at least 5 s"});
}

TEST_F(ExecutableTest, RefusesImuOfAnotherMotion) {
  SimulatorOptions other = Handheld();
  other.seed = 99;
  CalibrationData data = Simulate(Handheld());
  data.gyro = Simulate(other).gyro;
  data.accel = Simulate(other).accel;
  WriteSimulation(data);
  ExpectFailure("x.bag", 2, {"time shift"});
}

TEST_F(ExecutableTest, RefusesMostlyNan) {
  CalibrationData data = Simulate(Handheld());
  for (size_t k = 0; k < data.gyro.size(); k += 2)
    data.gyro[k].value.y() = std::numeric_limits<double>::quiet_NaN();
  WriteSimulation(data);
  ExpectFailure("x.bag", 2, {"gyroscope", "1500 of 3000", "not finite"});
}

TEST_F(ExecutableTest, RefusesReversedStamps) {
  CalibrationData data = Simulate(Handheld());
  std::reverse(data.poses.begin(), data.poses.end());
  WriteSimulation(data);
  ExpectFailure("x.bag", 2, {"of 1500 samples are stamped", "1 s before"});
}

TEST_F(ExecutableTest, FailureLeavesNoOldResultBehind) {
  SimulatorOptions options = Handheld();
  options.motion = Motion::kStatic;
  WriteSimulation(Simulate(options));
  Write("x.calibration.yaml", std::string(kResultHeader) + "\n");
  ExpectFailure("x.bag", 2, {});

  Write("mine.yaml", "not: a result\n");
  ExpectFailure("x.bag --output mine.yaml", 2, {});
  EXPECT_EQ(ReadText(Path("mine.yaml")), "not: a result\n");
}

TEST_F(ExecutableTest, RefusesWhatCannotBeAsItIsInOneLine) {
  struct Case {
    void (*spoil)(CalibrationData*);
    std::vector<std::string> parts;
  };
  const Case cases[] = {
      {[](CalibrationData* d) {
         for (ImuSample& s : d->gyro) s.value *= 57.29578;
       },
       {"gyroscope", "set gyro_unit: 0.0174532925"}},
      {[](CalibrationData* d) {
         for (ImuSample& s : d->accel) s.value /= 9.80665;
       },
       {"accelerometer", "set accel_unit: 9.80665"}},
      {[](CalibrationData* d) {
         for (PoseSample& s : d->poses) s.p_WM *= 1e3;
       },
       {"millimetres", "set position_unit: 1.0e-3"}},
      {[](CalibrationData* d) {
         for (PoseSample& s : d->poses) s.q_WM = s.q_WM.conjugate();
       },
       {"inverted", "set invert_poses: true"}},
      {[](CalibrationData* d) {
         for (PoseSample& s : d->poses) s.p_WM.setZero();
       },
       {"the position never changes"}},
      {[](CalibrationData* d) {
         for (ImuSample& s : d->gyro) s.value.z() = 0.0;
       },
       {"gyroscope: its z axis is always 0"}},
  };
  for (const Case& c : cases) {
    SCOPED_TRACE(c.parts.back());
    CalibrationData data = Simulate(Handheld());
    c.spoil(&data);
    WriteSimulation(data);
    ExpectFailure("x.bag", 2, c.parts);
  }
}

// --- calibrate_bag --check ---

TEST_F(ExecutableTest, ChecksABagWithoutCalibrating) {
  CalibrationData data = Simulate(Handheld());
  WriteSimulation(data);
  Write("x.calibration.yaml", std::string(kResultHeader) + "\n");
  Outcome outcome = Calibrate("x.bag --check");
  EXPECT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(outcome.err, "");
  EXPECT_EQ(outcome.out.compare(0, 6, "GOOD: "), 0) << outcome.out;
  EXPECT_TRUE(Contains(outcome.out, "rad/s rms about marker x, y, z")) << outcome.out;
  EXPECT_TRUE(std::filesystem::exists(Path("x.calibration.yaml")));  // not touched

  for (ImuSample& s : data.gyro) s.value *= 57.29578;
  WriteSimulation(data);
  outcome = Calibrate("x.bag --check");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_EQ(outcome.out.compare(0, 14, "RECORD AGAIN: "), 0) << outcome.out;
  EXPECT_TRUE(Contains(outcome.err, "calibrate_bag: error: gyroscope")) << outcome.err;
  EXPECT_EQ(std::count(outcome.err.begin(), outcome.err.end(), '\n'), 1) << outcome.err;
  EXPECT_EQ(Calibrate("x.bag --check --quiet").out, "");
  EXPECT_EQ(Calibrate("missing.bag --check").status, 1);
}

// --- simulate_bag ---

TEST_F(ExecutableTest, SimulationRepeatsWithItsSeed) {
  ASSERT_EQ(Run("simulate_bag", "a.bag --duration 2 --seed 3").status, 0);
  ASSERT_EQ(Run("simulate_bag", "b.bag --duration 2 --seed 3").status, 0);
  ASSERT_EQ(Run("simulate_bag", "c.bag --duration 2 --seed 4").status, 0);
  EXPECT_EQ(ReadText(Path("a.bag")), ReadText(Path("b.bag")));
  EXPECT_NE(ReadText(Path("a.bag")), ReadText(Path("c.bag")));
  EXPECT_EQ(ReadText(Path("a.truth.yaml")), ReadText(Path("b.truth.yaml")));
}

TEST_F(ExecutableTest, SimulationWritesItsTruth) {
  ASSERT_EQ(Run("simulate_bag", "a.bag --duration 2 --time-shift=-0.5 --accel-delay 0.003").status,
            0);
  const YAML::Node truth = YAML::LoadFile(Path("a.truth.yaml"));
  const SimulatorOptions options;
  EXPECT_EQ(truth["time_shift"].as<double>(), -0.5);
  EXPECT_EQ(truth["accel_delay"].as<double>(), 0.003);
  EXPECT_EQ(truth["rotation"][3].as<double>(), options.T_MI.q.w());
  EXPECT_EQ(truth["translation"][0].as<double>(), options.T_MI.p.x());
  EXPECT_EQ(truth["gravity"][2].as<double>(), options.g_W.z());
  EXPECT_EQ(truth["gyro_bias"][1].as<double>(), options.gyro_bias.y());
  EXPECT_EQ(truth["accel_bias"][2].as<double>(), options.accel_bias.z());
}

TEST_F(ExecutableTest, SimulationRefusesBadOptions) {
  const auto expect_refusal = [&](const std::string& arguments, const std::string& part) {
    const Outcome outcome = Run("simulate_bag", arguments);
    EXPECT_EQ(outcome.status, 1) << arguments;
    EXPECT_TRUE(Contains(outcome.err, part)) << outcome.err;
    EXPECT_EQ(std::count(outcome.err.begin(), outcome.err.end(), '\n'), 1) << outcome.err;
  };
  expect_refusal("", ".bag");
  expect_refusal("a.txt", ".bag");
  expect_refusal("a.bag --motion waltz", "waltz");
  expect_refusal("a.bag --imu-rate 0", "--imu-rate");
  expect_refusal("a.bag --gyro-std=-1", "--gyro-std");
  expect_refusal("a.bag --pose-type Odometry", "Odometry");
  expect_refusal("a.bag --duration 2 --time-shift 1e10", "--time-shift");
  expect_refusal("no/dir.bag --duration 2", "no/dir.bag");
}

}  // namespace
}  // namespace imu_pose_calib
