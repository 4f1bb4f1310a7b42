// calibrate_bag and simulate_bag end to end, as a user or a script runs them.

#include <rosbag/bag.h>
#include <sensor_msgs/Imu.h>
#include <yaml-cpp/yaml.h>

#include <limits>
#include <sstream>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "run_executable.h"

namespace imu_pose_calib {
namespace {

class CalibrateBagTest : public ExecutableTest {
 protected:
  void WriteSimulation(const SessionData& data) const { WriteBag(Path("x.bag"), data, {}); }

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
    return Eigen::Quaterniond(node[3].as<double>(), node[0].as<double>(), node[1].as<double>(),
                              node[2].as<double>());
  };
  const YAML::Node transform = result["transform"];
  return {(vector(transform["translation"]) - vector(truth["translation"])).norm(),
          quaternion(transform["rotation"]).angularDistance(quaternion(truth["rotation"])),
          std::abs(result["time_shift"].as<double>() - truth["time_shift"].as<double>())};
}

TEST_F(CalibrateBagTest, CalibratesASimulatedBag) {
  ASSERT_EQ(Run("simulate_bag", "x.bag --duration 20 --time-shift -0.035 --seed=5").status, 0);
  const Outcome outcome = Calibrate("x.bag");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(outcome.err, "");
  EXPECT_TRUE(Contains(outcome.out, "translation [mm]")) << outcome.out;
  EXPECT_TRUE(Contains(outcome.out, "Written to x.calibration.yaml")) << outcome.out;

  const YAML::Node result = YAML::LoadFile(Path("x.calibration.yaml"));
  const Eigen::Vector3d errors = Errors(result, YAML::LoadFile(Path("x.truth.yaml")));
  EXPECT_LT(errors[0], 2e-3);
  EXPECT_LT(errors[1], 1e-3);
  EXPECT_LT(errors[2], 2e-4);
  EXPECT_EQ(result["frames"]["marker"].as<std::string>(), "marker");
}

TEST_F(CalibrateBagTest, CalibratesASplitImuOnAForeignClock) {
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

TEST_F(CalibrateBagTest, UsesTheConfigAndTheSpan) {
  WriteSimulation(Simulate(Handheld()));
  Write("c.yaml", "estimate_accel_delay: false\naccel_delay: 0.0\n");
  const Outcome outcome = Calibrate("x.bag --config c.yaml --start 2 --duration 10 --quiet");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(outcome.out, "");
  const YAML::Node result = YAML::LoadFile(Path("x.calibration.yaml"));
  EXPECT_EQ(result["accel_delay_std"].as<double>(), 0.0);
  EXPECT_NEAR(result["data"]["duration"].as<double>(), 10.0, 0.1);
}

/// Its gyroscope hears vibration that the trajectory does not follow, and poses that err slowly:
/// what such residuals tell about the clocks is less than it seems.
TEST_F(CalibrateBagTest, PartsOfTheSampleAgreeWithinTheirSigmas) {
  const auto part = [this](const std::string& span) {
    const Outcome outcome =
        Calibrate(std::string(IMU_POSE_CALIB_SOURCE_DIR) +
                  "/data/estimator_own_clocks.bag --quiet --output x.yaml " + span);
    EXPECT_EQ(outcome.status, 0) << outcome.err;
    return YAML::LoadFile(Path("x.yaml"));
  };
  const YAML::Node first = part("--duration 44"), second = part("--start 40");
  const auto compare = [](const YAML::Node& a, const YAML::Node& a_std, const YAML::Node& b,
                          const YAML::Node& b_std) {
    EXPECT_LT(std::abs(a.as<double>() - b.as<double>()),
              4.0 * std::hypot(a_std.as<double>(), b_std.as<double>()));
    EXPECT_LT(a_std.as<double>(), 3e-4);
  };
  compare(first["accel_delay"], first["accel_delay_std"], second["accel_delay"],
          second["accel_delay_std"]);
  // Where the one ends and the other begins; the clocks drift.
  const YAML::Node end = first["clock"], begin = second["clock"];
  ASSERT_NEAR(end["t"][end["t"].size() - 1].as<double>(), begin["t"][0].as<double>(), 5.0);
  compare(end["offset"][end["offset"].size() - 1], end["std"][end["std"].size() - 1],
          begin["offset"][0], begin["std"][0]);
}

/// In 9 s that poses and IMU have in common it is taken up in the last two, and p comes out 5 sigma
/// from that of all other parts: what a hand does to a headset is not in the model.
TEST_F(CalibrateBagTest, TheFirstPartOfTheSampleIsWeak) {
  const Outcome outcome = Calibrate(IMU_POSE_CALIB_SOURCE_DIR
                                    "/data/estimator_own_clocks.bag --duration 15 --output x.yaml");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(outcome.out.find("WEAK: nearly all turns are in 1.9 s (bound: 3 s)"), 0u)
      << outcome.out;
}

TEST_F(CalibrateBagTest, TriesTheOutputBeforeTheSolve) {
  WriteSimulation(Simulate(Handheld()));
  const Outcome outcome = Calibrate("x.bag --output no/such/dir.yaml");
  EXPECT_EQ(outcome.status, 1);
  EXPECT_EQ(outcome.out, "");
  EXPECT_EQ(outcome.err,
            "calibrate_bag: error: output 'no/such/dir.yaml' cannot be written: No such file or "
            "directory\n");
}

/// A result file without the lines that tell where and when it comes from.
std::string Numbers(const std::string& yaml) {
  std::istringstream in(yaml);
  std::string text, line;
  while (std::getline(in, line))
    if (!Contains(line, "date:") && !Contains(line, "_topic:") && !Contains(line, "_file:") &&
        !Contains(line, "bag:") && !Contains(line, "run_id:"))
      text += line + "\n";
  return text;
}

TEST_F(CalibrateBagTest, BagFolderAndTablesGiveTheSameResult) {
  const std::string options = " --duration 10 --seed 2 --time-shift 0.1";
  ASSERT_EQ(Run("simulate_bag", "x.bag" + options).status, 0);
  ASSERT_EQ(Run("simulate_bag", "asl/" + options + " --format asl").status, 0);
  ASSERT_EQ(Run("simulate_bag", "x" + options + " --format text").status, 0);
  ASSERT_EQ(Run("simulate_bag", "y" + options + " --format text --split").status, 0);
  EXPECT_EQ(ReadText(Path("asl.truth.yaml")), ReadText(Path("x.truth.yaml")));

  const std::string span = " --start 1 --duration 8";
  ASSERT_EQ(Calibrate("x.bag" + span).status, 0);
  ASSERT_EQ(Calibrate("asl" + span).status, 0);
  ASSERT_EQ(Calibrate("--poses x.poses.txt --imu x.imu.csv" + span).status, 0);
  ASSERT_EQ(Calibrate("--poses y.poses.txt --gyro y.gyro.csv --accel y.accel.csv" + span).status,
            0);
  const std::string expected = Numbers(ReadText(Path("x.calibration.yaml")));
  EXPECT_GT(expected.size(), 2000u);
  EXPECT_EQ(Numbers(ReadText(Path("asl/calibration.yaml"))), expected);
  EXPECT_EQ(Numbers(ReadText(Path("x.poses.calibration.yaml"))), expected);
  EXPECT_EQ(Numbers(ReadText(Path("y.poses.calibration.yaml"))), expected);
  // Poses of one kind of file, IMU of the other.
  for (const char* part : {"--poses x.poses.txt", "--imu x.imu.csv"}) {
    ASSERT_EQ(Calibrate(std::string("x.bag ") + part + span + " --output mixed.yaml").status, 0);
    EXPECT_EQ(Numbers(ReadText(Path("mixed.yaml"))), expected) << part;
  }

  const YAML::Node data = YAML::LoadFile(Path("asl/calibration.yaml"))["data"];
  EXPECT_EQ(data["bag"].as<std::string>(), "");
  EXPECT_EQ(data["pose_topic"].as<std::string>(), "asl/mocap0/data.csv");
  EXPECT_EQ(data["imu_topic"].as<std::string>(), "asl/imu0/data.csv");
}

TEST_F(CalibrateBagTest, TakesNoiseFromTheSensorYamlOfAFolder) {
  ASSERT_EQ(Run("simulate_bag", "asl --duration 10 --format asl").status, 0);
  const std::string sensor =
      "sensor_type: imu\ncomment: of a data sheet\n"
      "T_BS:\n  cols: 4\n  rows: 4\n"
      "  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]\n"
      "rate_hz: 200\n"
      "gyroscope_noise_density: 1.6968e-04     # [ rad / s / sqrt(Hz) ]\n"
      "gyroscope_random_walk: 1.9393e-05\n"
      "accelerometer_noise_density: 2.5e-3\n"
      "accelerometer_random_walk: 3.0e-3\n";
  Write("asl/imu0/sensor.yaml", sensor);
  const Outcome outcome = Calibrate("asl --verbose");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_TRUE(Contains(outcome.out, "noise  asl/imu0/sensor.yaml")) << outcome.out;
  const YAML::Node result = YAML::LoadFile(Path("asl/calibration.yaml"));
  EXPECT_EQ(result["data"]["imu_yaml"].as<std::string>(), "asl/imu0/sensor.yaml");
  EXPECT_EQ(result["options"]["gyro_noise_density"].as<double>(), 1.6968e-4);
  EXPECT_EQ(result["options"]["accel_bias_walk"].as<double>(), 3e-3);

  // What the user gives comes first.
  Write("c.yaml", "accel_bias_walk: 1e-4\n");
  ASSERT_EQ(Calibrate("asl --config c.yaml --output c.result.yaml").status, 0);
  EXPECT_EQ(YAML::LoadFile(Path("c.result.yaml"))["options"]["accel_bias_walk"].as<double>(), 1e-4);

  Write("asl/imu0/sensor.yaml", "gyroscope_noise_density: -1\n");
  ExpectFailure("asl", 1, {"asl/imu0/sensor.yaml': gyroscope_noise_density = -1"});
}

TEST_F(CalibrateBagTest, HelpAndVersionSucceed) {
  const Outcome help = Calibrate("--help"), all = Calibrate("--help-all");
  EXPECT_EQ(help.status, 0);
  EXPECT_EQ(all.status, 0);
  for (const char* text : {"--pose-topic", "--check", "Examples:", "Exit status:"}) {
    EXPECT_TRUE(Contains(help.out, text)) << text;
    EXPECT_TRUE(Contains(all.out, text)) << text;
  }
  EXPECT_FALSE(Contains(help.out, "--trajectory-gaps"));
  EXPECT_TRUE(Contains(all.out, "--trajectory-gaps"));
  // One screen.
  std::istringstream lines(help.out);
  int count = 0;
  for (std::string line; std::getline(lines, line); ++count) EXPECT_LE(line.size(), 80u) << line;
  EXPECT_LE(count, 40);
  EXPECT_EQ(Calibrate("--version").out, std::string("imu_pose_calib ") + kVersion + "\n");
  EXPECT_EQ(Run("simulate_bag", "--help").status, 0);
}

// --- calibrate_bag: sources ---

/// Largest difference of two results: translation [m], rotation, time shift and accel delay [s].
double Difference(const YAML::Node& a, const YAML::Node& b) {
  double largest = 0.0;
  for (const char* key : {"translation", "rotation"})
    for (size_t i = 0; i < a["transform"][key].size(); ++i)
      largest = std::max(largest, std::abs(a["transform"][key][i].as<double>() -
                                           b["transform"][key][i].as<double>()));
  for (const char* key : {"time_shift", "accel_delay"})
    largest = std::max(largest, std::abs(a[key].as<double>() - b[key].as<double>()));
  return largest;
}

TEST_F(CalibrateBagTest, EverySourceGivesTheSameResult) {
  const SessionData data = Simulate(Handheld());
  WriteBag(Path("x.bag"), data, {});
  ASSERT_EQ(Calibrate("x.bag --quiet").status, 0);
  const YAML::Node expected = YAML::LoadFile(Path("x.calibration.yaml"));
  const auto expect_same = [&](const BagFormat& format, const std::string& arguments) {
    WriteBag(Path("y.bag"), data, format);
    const Outcome outcome = Calibrate("y.bag --quiet " + arguments);
    ASSERT_EQ(outcome.status, 0) << outcome.err;
    EXPECT_LT(Difference(YAML::LoadFile(Path("y.calibration.yaml")), expected), 1e-6) << arguments;
  };
  expect_same({false, "TransformStamped"}, "");
  expect_same({false, "PoseWithCovarianceStamped"}, "");
  expect_same({false, "Odometry"}, "");
  // an arm of six joints, of which two move per message
  expect_same({false, "tf"}, "--tf-parent world --tf-child /marker");
  expect_same({true, "PoseStamped"}, "");
  expect_same({false, "PoseStamped", "Vector3Stamped"},
              "--gyro-topic /imu/gyro --accel-topic /imu/accel");
}

TEST_F(CalibrateBagTest, ReadsSeveralBagsAsOneRecording) {
  SessionData data = Simulate(Handheld()), first = data, second = data;
  WriteBag(Path("x.bag"), data, {});
  ASSERT_EQ(Calibrate("x.bag --quiet --start 2 --duration 10").status, 0);
  const YAML::Node expected = YAML::LoadFile(Path("x.calibration.yaml"));

  first.poses.resize(700);
  first.imus[0].gyro.resize(1400);
  first.imus[0].accel.resize(1400);
  second.poses.erase(second.poses.begin(), second.poses.begin() + 700);
  second.imus[0].gyro.erase(second.imus[0].gyro.begin(), second.imus[0].gyro.begin() + 1400);
  second.imus[0].accel.erase(second.imus[0].accel.begin(), second.imus[0].accel.begin() + 1400);
  WriteBag(Path("a.bag"), first, {});
  WriteBag(Path("b.bag"), second, {});
  const Outcome outcome = Calibrate("a.bag b.bag --quiet --start 2 --duration 10");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const YAML::Node result = YAML::LoadFile(Path("a.calibration.yaml"));
  EXPECT_LT(Difference(result, expected), 1e-6);
  EXPECT_EQ(result["data"]["bag"].as<std::string>(), "a.bag b.bag");
}

TEST_F(CalibrateBagTest, TakesNoiseAndTopicFromAnImuYaml) {
  const SessionData data = Simulate(Handheld());
  WriteBag(Path("x.bag"), data, {});
  {
    rosbag::Bag bag(Path("x.bag"), rosbag::bagmode::Append);
    sensor_msgs::Imu other;  // two IMUs: not to be told apart without the rostopic
    other.header.stamp = ros::Time(1600000001);
    other.angular_velocity.x = other.linear_acceleration.x = 1.0;
    bag.write("/imu2", other.header.stamp, other);
  }
  Write("imu.yaml",
        "gyroscope_noise_density: 4.0e-4\ngyroscope_random_walk: 3.0e-5\n"
        "accelerometer_noise_density: 3.0e-3\naccelerometer_random_walk: 4.0e-4\n"
        "rostopic: /imu\nupdate_rate: 200.0\n");
  const Outcome outcome = Calibrate("x.bag --quiet --imu-yaml imu.yaml");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const YAML::Node result = YAML::LoadFile(Path("x.calibration.yaml"));
  EXPECT_EQ(result["data"]["imu_topic"].as<std::string>(), "/imu");
  EXPECT_EQ(result["options"]["gyro_noise_density"].as<double>(), 4e-4);
  EXPECT_EQ(result["options"]["gyro_bias_walk"].as<double>(), 3e-5);
  EXPECT_EQ(result["options"]["accel_noise_density"].as<double>(), 3e-3);
  EXPECT_EQ(result["options"]["accel_bias_walk"].as<double>(), 4e-4);
}

// --- calibrate_bag: data that cannot be calibrated, exit status 2 ---

TEST_F(CalibrateBagTest, RefusesMotionThatDeterminesTooLittle) {
  for (const Motion motion : {Motion::kStatic, Motion::kPlanar, Motion::kHinge}) {
    SimulatorOptions options = Handheld();
    options.motion = motion;
    WriteSimulation(Simulate(options));
    ExpectFailure("x.bag", 2, {"turn"});
  }
}

TEST_F(CalibrateBagTest, RefusesTooFewPoses) {
  SessionData data = Simulate(Handheld());
  data.poses.resize(300);  // 3 s
  WriteSimulation(data);
  ExpectFailure("x.bag", 2, {"pose", "span 2.99 s", "at least 5 s"});
}

TEST_F(CalibrateBagTest, RefusesImuOfAnotherMotion) {
  SimulatorOptions other = Handheld();
  other.seed = 99;
  SessionData data = Simulate(Handheld());
  data.imus[0].gyro = Simulate(other).imus[0].gyro;
  data.imus[0].accel = Simulate(other).imus[0].accel;
  WriteSimulation(data);
  ExpectFailure("x.bag", 2, {"time shift"});
}

TEST_F(CalibrateBagTest, RefusesMostlyNan) {
  SessionData data = Simulate(Handheld());
  for (size_t k = 0; k < data.imus[0].gyro.size(); k += 2)
    data.imus[0].gyro[k].value.y() = std::numeric_limits<double>::quiet_NaN();
  WriteSimulation(data);
  ExpectFailure("x.bag", 2, {"gyroscope", "1500 of 3000", "not finite"});
}

TEST_F(CalibrateBagTest, RefusesReversedStamps) {
  SessionData data = Simulate(Handheld());
  std::reverse(data.poses.begin(), data.poses.end());
  WriteSimulation(data);
  ExpectFailure("x.bag", 2, {"of 1500 samples are stamped", "1 s before"});
}

TEST_F(CalibrateBagTest, RefusesWhatCannotBeAsItIsInOneLine) {
  struct Case {
    void (*spoil)(SessionData*);
    std::vector<std::string> parts;
  };
  const Case cases[] = {
      {[](SessionData* d) {
         for (ImuSample& s : d->imus[0].gyro) s.value *= 57.29578;
       },
       {"gyroscope", "set gyro_unit: 0.0174532925"}},
      {[](SessionData* d) {
         for (ImuSample& s : d->imus[0].accel) s.value /= 9.80665;
       },
       {"accelerometer", "set accel_unit: 9.80665"}},
      {[](SessionData* d) {
         for (PoseSample& s : d->poses) s.p_WM *= 1e3;
       },
       {"millimetres", "set position_unit: 1.0e-3"}},
      {[](SessionData* d) {
         for (PoseSample& s : d->poses) s.q_WM = s.q_WM.conjugate();
       },
       {"inverted", "set invert_poses: true"}},
      {[](SessionData* d) {
         for (PoseSample& s : d->poses) s.p_WM.setZero();
       },
       {"the position never changes"}},
      {[](SessionData* d) {
         for (ImuSample& s : d->imus[0].gyro) s.value.z() = 0.0;
       },
       {"gyroscope: its z axis is always 0"}},
  };
  for (const Case& c : cases) {
    SCOPED_TRACE(c.parts.back());
    SessionData data = Simulate(Handheld());
    c.spoil(&data);
    WriteSimulation(data);
    ExpectFailure("x.bag", 2, c.parts);
  }
}

TEST_F(CalibrateBagTest, RefusesABagBehindALoopOfLinks) {
  std::filesystem::create_symlink("x.bag", Path("x.bag"));
  for (const char* arguments : {"x.bag", "x.bag --check"})
    ExpectFailure(arguments, 1, {"bag 'x.bag' cannot be read: Too many levels of symbolic links"});
}

// --- calibrate_bag --check ---

TEST_F(CalibrateBagTest, ChecksABagWithoutCalibrating) {
  SessionData data = Simulate(Handheld());
  WriteSimulation(data);
  Write("x.calibration.yaml", std::string(kResultHeader) + "\n");
  Outcome outcome = Calibrate("x.bag --check");
  EXPECT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(outcome.err, "");
  EXPECT_EQ(outcome.out.compare(0, 6, "GOOD: "), 0) << outcome.out;
  EXPECT_TRUE(Contains(outcome.out, "rad/s rms about marker x, y, z")) << outcome.out;
  EXPECT_TRUE(std::filesystem::exists(Path("x.calibration.yaml")));  // not touched

  for (ImuSample& s : data.imus[0].gyro) s.value *= 57.29578;
  WriteSimulation(data);
  outcome = Calibrate("x.bag --check");
  EXPECT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_EQ(outcome.out.compare(0, 18, "USABLE: gyroscope:"), 0) << outcome.out;

  data.imus[0].gyro = Simulate(Handheld()).imus[0].gyro;
  data.poses.resize(300);
  WriteSimulation(data);
  outcome = Calibrate("x.bag --check");
  EXPECT_EQ(outcome.status, 2);
  EXPECT_EQ(outcome.out.compare(0, 14, "RECORD AGAIN: "), 0) << outcome.out;
  EXPECT_TRUE(Contains(outcome.err, "calibrate_bag: error: pose: 300 of 300")) << outcome.err;
  EXPECT_EQ(std::count(outcome.err.begin(), outcome.err.end(), '\n'), 1) << outcome.err;
  EXPECT_EQ(Calibrate("x.bag --check --quiet").out, "");
  EXPECT_EQ(Calibrate("missing.bag --check").status, 1);
}

// --- simulate_bag ---

TEST_F(CalibrateBagTest, SimulationRepeatsWithItsSeed) {
  ASSERT_EQ(Run("simulate_bag", "a.bag --duration 2 --seed 3").status, 0);
  ASSERT_EQ(Run("simulate_bag", "b.bag --duration 2 --seed 3").status, 0);
  ASSERT_EQ(Run("simulate_bag", "c.bag --duration 2 --seed 4").status, 0);
  EXPECT_EQ(ReadText(Path("a.bag")), ReadText(Path("b.bag")));
  EXPECT_NE(ReadText(Path("a.bag")), ReadText(Path("c.bag")));
  EXPECT_EQ(ReadText(Path("a.truth.yaml")), ReadText(Path("b.truth.yaml")));
}

TEST_F(CalibrateBagTest, SimulationWritesItsTruth) {
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

TEST_F(CalibrateBagTest, SimulationHasTheDelaysOfEffectsInItsTruth) {
  ASSERT_EQ(Run("simulate_bag",
                "a.bag --duration 2 --motion drone --gyro-filter 40 --imu-burst 5 --imu-drops 3")
                .status,
            0);
  const YAML::Node truth = YAML::LoadFile(Path("a.truth.yaml"));
  const double filter = 1.0 / (2.0 * M_PI * 40.0), burst = 0.010;
  EXPECT_NEAR(truth["time_shift"].as<double>(), 0.02 - filter - burst, 1e-4);
  EXPECT_NEAR(truth["accel_delay"].as<double>(), -filter, 1e-9);
}

TEST_F(CalibrateBagTest, SimulationRefusesBadOptions) {
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
  expect_refusal("a.bag --pose-drops 120", "--pose-drops = 120.0 must be within 0.0 and 90.0");
  expect_refusal("a.bag --pose-type Path", "'Path'");
  expect_refusal("a --format csv", "'csv' is unknown; must be bag, mcap, db3, asl or text");
  expect_refusal("a --format asl --split", "--split");
  expect_refusal("--format text", "path");
  expect_refusal("no/dir --format text --duration 2", "no/dir.poses.txt");
  expect_refusal("/proc/dir --format asl --duration 2", "/proc/dir");
  expect_refusal("a.bag --duration 2 --time-shift 1e10", "--time-shift");
  const std::string other = " would replace another file of this run; choose another";
  expect_refusal("a.bag --duration 2 --truth a.bag", "'a.bag'" + other);
  expect_refusal("a --duration 2 --format text --truth a.imu.csv", "'a.imu.csv'" + other);
  expect_refusal("a/mav0 --duration 2 --format asl --truth a", "'a/mav0/imu0/data.csv'" + other);
  for (const char* file : {"a", "a.bag", "a.imu.csv", "a.truth.yaml"})
    EXPECT_FALSE(std::filesystem::exists(Path(file))) << file;
  for (const std::string format : {"bag", "mcap", "db3"})
    expect_refusal("no/dir." + format + " --duration 2 --format " + format, "no/dir." + format);
}

}  // namespace
}  // namespace imu_pose_calib
