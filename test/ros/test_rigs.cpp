// Several IMUs and several recordings with calibrate_bag, as a user runs it.

#include <yaml-cpp/yaml.h>

#include <algorithm>

#include "imu_pose_calib/ros/io/recording.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "run_executable.h"

namespace imu_pose_calib {
namespace {

class RigsTest : public ExecutableTest {
 protected:
  static SimulatorOptions Handheld(uint32_t seed, double duration_s = 12.0) {
    SimulatorOptions options;
    options.seed = seed;
    options.duration_s = duration_s;
    return options;
  }
  void WriteSession(const std::string& name, const SimulatorOptions& options, size_t imus) const {
    WriteBag(Path(name), Simulate(options, imus), {});
  }
};

double Distance(const YAML::Node& translation, const Eigen::Vector3d& truth) {
  Eigen::Vector3d p;
  for (int i = 0; i < 3; ++i) p[i] = translation[i].as<double>();
  return (p - truth).norm();
}

TEST_F(RigsTest, TwoImusGiveOneResultWithBoth) {
  ASSERT_EQ(Run("simulate_bag", "x.bag --duration 15 --imus 2").status, 0);
  const Outcome outcome = Calibrate("x.bag --imu-topic /imu --imu-topic /imu1");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_TRUE(Contains(outcome.out, "\n  imu0 ")) << outcome.out;
  EXPECT_TRUE(Contains(outcome.out, "in imu0"));
  EXPECT_TRUE(Contains(outcome.out, "  marker imu1\n"));  // the command for tf
  const YAML::Node result = YAML::LoadFile(Path("x.calibration.yaml"));
  const SimulatorOptions first = SimulatorOptions(), second = FurtherImu(first, 1);
  EXPECT_LT(Distance(result["transform"]["translation"], first.T_MI.p), 2e-3);
  ASSERT_EQ(result["imus"].size(), 2u);
  const YAML::Node imu = result["imus"][1];
  EXPECT_EQ(imu["name"].as<std::string>(), "imu1");
  EXPECT_EQ(imu["topic"].as<std::string>(), "/imu1");
  EXPECT_EQ(imu["frame"].as<std::string>(), "imu1");
  EXPECT_LT(Distance(imu["transform"]["translation"], second.T_MI.p), 2e-3);
  EXPECT_NEAR(imu["accel_delay"].as<double>(), second.accel_delay_s, 2e-4);
  ASSERT_EQ(result["between_imus"].size(), 1u);
  const YAML::Node between = result["between_imus"][0];
  EXPECT_EQ(between["first"].as<std::string>(), "imu0");
  EXPECT_EQ(between["second"].as<std::string>(), "imu1");
  EXPECT_LT(Distance(between["transform"]["translation"], (first.T_MI.Inverse() * second.T_MI).p),
            2e-3);
  const YAML::Node clock = result["sessions"][0]["imus"][1];
  EXPECT_NEAR(clock["time_shift"].as<double>(), second.time_shift_s, 2e-4);
  EXPECT_EQ(clock["biases"]["gyro_std"].size(), 3u);
}

TEST_F(RigsTest, BagsOfTheSameTimeAndTopicsAreSessions) {
  for (const uint32_t seed : {1u, 2u, 3u})
    WriteSession("s" + std::to_string(seed) + ".bag", Handheld(seed), 1);
  const Outcome brief = Calibrate("s1.bag s2.bag s3.bag --output x.yaml");
  EXPECT_TRUE(Contains(brief.out, "  3 sessions; farthest from the others: session ")) << brief.out;
  const Outcome outcome = Calibrate("s1.bag s2.bag s3.bag --output x.yaml --verbose");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  for (const char* part : {"\n  1  s1.bag\n", "\n  3  s3.bag\n", "Data of session 2: s2.bag"})
    EXPECT_TRUE(Contains(outcome.out, part)) << outcome.out;
  const YAML::Node result = YAML::LoadFile(Path("x.yaml"));
  ASSERT_EQ(result["sessions"].size(), 3u);
  for (const YAML::Node& session : result["sessions"]) {
    EXPECT_LT(session["agreement"]["chi2"].as<double>(), 40.0);
    EXPECT_EQ(session["agreement"]["dof"].as<int>(), 7);
    EXPECT_LT(Distance(session["own"]["translation"], SimulatorOptions().T_MI.p), 2e-3);
  }
  EXPECT_EQ(result["sessions"][1]["source"].as<std::string>(), "s2.bag");
  ExpectFailure("s1.bag s2.bag --one-recording --output y.yaml", 2, {});
}

TEST_F(RigsTest, BagsThatContinueEachOtherAreOneSession) {
  const SessionData whole = Simulate(Handheld(4, 20.0));
  const int64_t begin = whole.poses.front().t_ns;
  SessionData parts[3];
  const auto deal = [&](const auto& samples, auto member) {
    for (const auto& sample : samples)
      member(&parts[std::clamp<int64_t>((sample.t_ns - begin) / 7'000'000'000, 0, 2)])
          .push_back(sample);
  };
  deal(
      whole.poses, [](SessionData * d) -> auto& { return d->poses; });
  deal(
      whole.imus[0].gyro, [](SessionData * d) -> auto& { return d->imus[0].gyro; });
  deal(
      whole.imus[0].accel, [](SessionData * d) -> auto& { return d->imus[0].accel; });
  WriteBag(Path("a_0.bag"), parts[0], {});
  WriteBag(Path("a_1.bag"), parts[1], {});
  WriteBag(Path("a_2.bag"), parts[2], {});
  WriteSession("b.bag", Handheld(5, 20.0), 1);
  const std::vector<std::string> paths = {Path("a_2.bag"), Path("b.bag"), Path("a_0.bag"),
                                          Path("a_1.bag")};
  const auto groups = GroupBags(paths);
  // b starts when a does and has its topics: another session.
  ASSERT_EQ(groups.size(), 2u);
  EXPECT_EQ(groups[0], (std::vector<std::string>{paths[0], paths[2], paths[3]}));
  EXPECT_EQ(groups[1], std::vector<std::string>{paths[1]});

  // Poses and IMU recorded side by side.
  SessionData poses = whole, imu = whole;
  poses.imus[0] = ImuData();
  imu.poses.clear();
  WriteBag(Path("poses.bag"), poses, {});
  WriteBag(Path("imu.bag"), imu, {});
  EXPECT_EQ(GroupBags({Path("poses.bag"), Path("imu.bag")}).size(), 1u);
}

TEST_F(RigsTest, ASessionMayLackAnImu) {
  WriteSession("s1.bag", Handheld(6, 15.0), 2);
  WriteSession("s2.bag", Handheld(7, 15.0), 1);
  const std::string topics = " --imu-topic /imu --imu-topic /imu1";
  const Outcome outcome = Calibrate("s1.bag s2.bag --output x.yaml" + topics);
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const YAML::Node sessions = YAML::LoadFile(Path("x.yaml"))["sessions"];
  EXPECT_EQ(sessions[0]["imus"].size(), 2u);
  EXPECT_EQ(sessions[1]["imus"].size(), 1u);
  ExpectFailure("s1.bag s2.bag --imu-topic /imu --imu-topic /imu2", 1,
                {"imu_topic '/imu2' is in no recording"});
  ExpectFailure("s2.bag" + topics, 1, {"imu_topic '/imu1' is not in s2.bag"});
  ExpectFailure("s1.bag --imu-topic /imu --imu-topic /imu", 1, {"'/imu' is given twice"});
  ExpectFailure("s2.bag --imu-frame a --imu-frame b", 1, {"imu_frame names 2 frames for 1 imus"});
}

TEST_F(RigsTest, TextFilesAndFoldersMayBeSeveral) {
  ASSERT_EQ(Run("simulate_bag", "f1 --format asl --duration 12 --seed 8").status, 0);
  ASSERT_EQ(Run("simulate_bag", "f2 --format asl --duration 12 --seed 9").status, 0);
  const Outcome folders = Calibrate("f1 f2 --output x.yaml --quiet");
  ASSERT_EQ(folders.status, 0) << folders.err;
  EXPECT_EQ(YAML::LoadFile(Path("x.yaml"))["sessions"].size(), 2u);
  SessionData data = Simulate(Handheld(8), 2);
  WriteTables(Path("a"), data, false);
  std::swap(data.imus[0], data.imus[1]);
  WriteTables(Path("b"), data, false);
  const std::string both = "--poses a.poses.txt --imu a.imu.csv --imu ";
  const Outcome files = Calibrate(both + "b.imu.csv --output y.yaml --quiet");
  ASSERT_EQ(files.status, 0) << files.err;
  const YAML::Node between = YAML::LoadFile(Path("y.yaml"))["between_imus"][0]["transform"];
  EXPECT_LT(Distance(between["translation"],
                     (Handheld(8).T_MI.Inverse() * FurtherImu(Handheld(8), 1).T_MI).p),
            2e-3);
  std::filesystem::copy_file(Path("a.imu.csv"), Path("c.imu.csv"));
  ExpectFailure(both + "c.imu.csv", 1,
                {"imu1 has the samples of imu0: give each IMU of the rig once"});
}

}  // namespace
}  // namespace imu_pose_calib
