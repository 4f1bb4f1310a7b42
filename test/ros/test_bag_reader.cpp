#include <geometry_msgs/PoseStamped.h>
#include <nav_msgs/Odometry.h>
#include <tf2_msgs/TFMessage.h>

#include <filesystem>
#include <fstream>
#include <memory>

#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "recompress.h"
#include "record_bag.h"

namespace imu_pose_calib {
namespace {

// --- Reading ---

void ExpectSameSamples(const SessionData& a, const SessionData& b) {
  ASSERT_EQ(a.poses.size(), b.poses.size());
  for (size_t k = 0; k < a.poses.size(); ++k) {
    EXPECT_EQ(a.poses[k].t_ns, b.poses[k].t_ns);
    EXPECT_EQ(a.poses[k].p_WM, b.poses[k].p_WM);
    EXPECT_EQ(a.poses[k].q_WM.coeffs(), b.poses[k].q_WM.coeffs());
  }
  const auto expect_same = [](const std::vector<ImuSample>& x, const std::vector<ImuSample>& y) {
    ASSERT_EQ(x.size(), y.size());
    for (size_t k = 0; k < x.size(); ++k) {
      EXPECT_EQ(x[k].t_ns, y[k].t_ns);
      EXPECT_EQ(x[k].value, y[k].value);
    }
  };
  expect_same(a.imus[0].gyro, b.imus[0].gyro);
  expect_same(a.imus[0].accel, b.imus[0].accel);
}

TEST_F(BagReaderTest, ReadsBackWhatTheWriterWrote) {
  const SessionData data = Simulate(ShortSimulation());
  WriteBag(Path("recording.bag"), data, {});
  const Recording recording = ReadBag(Request());
  ExpectSameSamples(recording.data, data);
  EXPECT_EQ(recording.info.bag, Path("recording.bag"));
  EXPECT_EQ(recording.info.imus[0].imu_topic, "/imu");
  EXPECT_EQ(recording.info.imus[0].gyro_topic, "");
  EXPECT_EQ(recording.info.pose_topic, "/mocap/pose");
  EXPECT_EQ(recording.info.world_frame, "world");
  EXPECT_EQ(recording.info.marker_frame, "marker");
  EXPECT_EQ(recording.info.imus[0].imu_frame, "imu");
}

TEST_F(BagReaderTest, TellsTheTopicsOfASplitImuApart) {
  SimulatorOptions simulator = ShortSimulation();
  simulator.accel_rate_hz = 150.0;
  const SessionData data = Simulate(simulator);
  WriteBag(Path("recording.bag"), data, {true, "TransformStamped"});
  const Recording recording = ReadBag(Request());
  ExpectSameSamples(recording.data, data);
  EXPECT_EQ(recording.info.imus[0].imu_topic, "");
  EXPECT_EQ(recording.info.imus[0].gyro_topic, "/imu/gyro");
  EXPECT_EQ(recording.info.imus[0].accel_topic, "/imu/accel");
}

TEST_F(BagReaderTest, ReadsEveryTypeOfPose) {
  const SessionData data = Simulate(ShortSimulation());
  for (const char* type : {"TransformStamped", "PoseWithCovarianceStamped", "Odometry"}) {
    WriteBag(Path("recording.bag"), data, {false, type});
    const Recording recording = ReadBag(Request());
    ExpectSameSamples(recording.data, data);
    EXPECT_EQ(recording.info.pose_topic, "/mocap/pose");
    EXPECT_EQ(recording.info.world_frame, "world");
    EXPECT_EQ(recording.info.marker_frame, "marker");
    EXPECT_FALSE(recording.info.stated_pose_std);  // all zero
  }
}

TEST_F(BagReaderTest, ReadsVectors) {
  const SessionData data = Simulate(ShortSimulation());
  WriteBag(Path("recording.bag"), data, {false, "PoseStamped", "Vector3Stamped"});
  RecordingRequest request = Request();
  request.gyro_topic = "/imu/gyro";
  request.accel_topic = "/imu/accel";
  const Recording recording = ReadBag(request);
  ExpectSameSamples(recording.data, data);
  EXPECT_EQ(recording.info.imus[0].imu_frame, "imu");
}

TEST_F(BagReaderTest, ReadsTf) {
  const SessionData data = Simulate(ShortSimulation());
  WriteBag(Path("recording.bag"), data, {false, "tf"});
  RecordingRequest request = Request();
  request.tf_parent = "world";
  request.tf_child = "/marker";
  const Recording recording = ReadBag(request);
  EXPECT_EQ(recording.info.pose_topic, "/tf");
  EXPECT_EQ(recording.info.world_frame, "world");
  EXPECT_EQ(recording.info.marker_frame, "marker");
  ASSERT_EQ(recording.data.poses.size(), data.poses.size());
  for (size_t k = 0; k < data.poses.size(); ++k) {
    const PoseSample &pose = recording.data.poses[k], &truth = data.poses[k];
    EXPECT_EQ(pose.t_ns, truth.t_ns);
    EXPECT_LT((pose.p_WM - truth.p_WM).norm(), 1e-6);
    EXPECT_LT(pose.q_WM.angularDistance(truth.q_WM), 1e-6);
  }
  // the fixed transforms are sent once, before the span
  request.start_s = 1.0;
  EXPECT_GT(ReadBag(request).data.poses.size(), 150u);
}

TEST_F(BagReaderTest, ReadsCompressedBags) {
  const SessionData data = Simulate(ShortSimulation());
  WriteBag(Path("plain.bag"), data, {});
  for (const auto compression : {rosbag::compression::BZ2, rosbag::compression::LZ4}) {
    Recompress(Path("plain.bag"), Path("recording.bag"), compression);
    EXPECT_LT(std::filesystem::file_size(Path("recording.bag")),
              std::filesystem::file_size(Path("plain.bag")));
    ExpectSameSamples(ReadBag(Request()).data, data);
  }
}

TEST_F(BagReaderTest, ReadsLongBagsUpToDamage) {
  SimulatorOptions simulator = ShortSimulation();
  simulator.duration_s = 47.3;
  const SessionData data = Simulate(simulator);
  WriteBag(Path("plain.bag"), data, {});
  Recompress(Path("plain.bag"), Path("recording.bag"), rosbag::compression::BZ2);
  ExpectSameSamples(ReadBag(Request()).data, data);
  RecordingRequest request = Request();
  request.start_s = 1.5;
  request.duration_s = 40.0;
  const Recording part = ReadBag(request);
  EXPECT_NEAR(static_cast<double>(part.data.imus[0].gyro.size()), 40.0 * simulator.gyro_rate_hz,
              2.0);
  std::fstream file(Path("recording.bag"), std::ios::in | std::ios::out | std::ios::binary);
  file.seekp(static_cast<std::streamoff>(
      0.7 * static_cast<double>(std::filesystem::file_size(Path("recording.bag")))));
  file << std::string(2000, 'x');
  file.close();
  try {
    ReadBag(Request());
    FAIL() << "a damaged bag was read";
  } catch (const InputError& error) {
    EXPECT_NE(std::string(error.what()).find("is damaged"), std::string::npos) << error.what();
  }
}

TEST_F(BagReaderTest, ReadsImuAndPosesFromABagEach) {
  SessionData data = Simulate(ShortSimulation()), poses, imu = data;
  poses.poses = data.poses;
  imu.poses.clear();
  WriteBag(Path("poses.bag"), poses, {});
  WriteBag(Path("imu.bag"), imu, {});
  RecordingRequest request;
  request.paths = {Path("poses.bag"), Path("imu.bag")};
  ExpectSameSamples(ReadBag(request).data, data);
}

TEST_F(BagReaderTest, ReportsWhatTheCovariancesSay) {
  nav_msgs::Odometry odometry;
  odometry.header = Pose().header;
  odometry.pose.pose = Pose().pose;
  for (size_t i = 0; i < 36; i += 7) odometry.pose.covariance[i] = i < 21 ? 4e-4 : 1e-6;
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/odom", odometry);
  const auto stated = ReadBag(Request()).info.stated_pose_std;
  ASSERT_TRUE(stated);
  EXPECT_NEAR(stated->position, 0.02, 1e-12);
  EXPECT_NEAR(stated->rotation, 1e-3, 1e-12);
  odometry.pose.covariance[35] = -1.0;
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/odom", odometry);
  EXPECT_FALSE(ReadBag(Request()).info.stated_pose_std);
}

TEST_F(BagReaderTest, StampsWithRecordTimes) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", Pose());
  RecordingRequest request = Request();
  request.record_time = true;
  const SessionData data = ReadBag(request).data;
  EXPECT_EQ(data.imus[0].gyro.at(0).t_ns, 100000000000);
  EXPECT_EQ(data.imus[0].accel.at(0).t_ns, 100000000000);
  EXPECT_EQ(data.poses.at(0).t_ns, 100010000000);
}

TEST_F(BagReaderTest, StampsTfWithRecordTimes) {
  tf2_msgs::TFMessage first, second;
  first.transforms = {Transform("rig")};
  second.transforms = {Transform("rig")};
  second.transforms[0].transform.translation.x = 1.0;
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/tf", first).Add("/tf", second);
  RecordingRequest request = Request();
  request.tf_parent = "map";
  request.tf_child = "rig";
  request.record_time = true;
  const SessionData data = ReadBag(request).data;
  ASSERT_EQ(data.poses.size(), 2u);
  EXPECT_EQ(data.poses[0].t_ns, 100010000000);
  EXPECT_EQ(data.poses[1].t_ns, 100020000000);
}

TEST_F(BagReaderTest, OneTextNamesSeveralBags) {
  EXPECT_EQ(SplitPaths("a.bag  b.bag"), (std::vector<std::string>{"a.bag", "b.bag"}));
  EXPECT_EQ(SplitPaths(""), std::vector<std::string>());
  Write("my own.bag", "");
  EXPECT_EQ(SplitPaths(Path("my own.bag")), std::vector<std::string>{Path("my own.bag")});
}

TEST_F(BagReaderTest, KeepsNanosecondsAndFrames) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", Transform("/rig"));
  const Recording recording = ReadBag(Request());
  EXPECT_EQ(recording.data.poses.at(0).t_ns, 60123456789);
  EXPECT_EQ(recording.data.imus[0].gyro.at(0).t_ns, 50000000001);
  EXPECT_EQ(recording.info.world_frame, "map");
  EXPECT_EQ(recording.info.marker_frame, "rig");
  EXPECT_EQ(recording.info.imus[0].imu_frame, "imu_link");
}

TEST_F(BagReaderTest, KeepsTheOrderOfRecording) {
  geometry_msgs::PoseStamped earlier = Pose();
  earlier.header.stamp = ros::Time(59);
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", Pose()).Add("/pose", earlier);
  EXPECT_GT(ReadBag(Request()).data.poses.at(0).t_ns, ReadBag(Request()).data.poses.at(1).t_ns);
}

TEST_F(BagReaderTest, StartAndDurationAreRecordTimeAfterTheFirstMessage) {
  {
    Recorder recorder = Record();
    for (int k = 0; k < 10; ++k) recorder.Add("/imu", Imu(k + 1, 9.8)).Add("/pose", Pose());
  }
  RecordingRequest request = Request();
  request.start_s = 0.035;     // messages 4..19, the IMU's are the even ones
  request.duration_s = 0.100;  // to message 13
  const Recording recording = ReadBag(request);
  ASSERT_EQ(recording.data.imus[0].gyro.size(), 5u);
  EXPECT_EQ(recording.data.imus[0].gyro.front().value.x(), 3.0);
  EXPECT_EQ(recording.data.imus[0].gyro.back().value.x(), 7.0);
  EXPECT_EQ(recording.data.poses.size(), 5u);
}

TEST_F(BagReaderTest, RecordTimesOfForeignClocksAreThePoses) {
  SimulatorOptions simulator = ShortSimulation();
  simulator.time_shift_s = 1034771.5;
  WriteBag(Path("recording.bag"), Simulate(simulator), {});
  RecordingRequest request = Request();
  request.duration_s = 1.0;
  const Recording recording = ReadBag(request);
  EXPECT_EQ(recording.data.poses.size(), 101u);
  EXPECT_EQ(recording.data.imus[0].gyro.size(), 201u);
  EXPECT_EQ(recording.data.imus[0].gyro[0].t_ns, simulator.start_ns - 1034771500000000);
}

// --- Refusals ---

TEST_F(BagReaderTest, RefusesAMissingFile) {
  ExpectRefusal(Request(), {Path("recording.bag"), "does not exist"});
}

TEST_F(BagReaderTest, RefusesADirectory) {
  std::filesystem::create_directory(Path("recording.bag"));
  ExpectRefusal(Request(), {"recording.bag", "is not a file"});
}

TEST_F(BagReaderTest, RefusesWhatIsNoBag) {
  Write("recording.bag", "hello, world");
  ExpectRefusal(Request(), {"recording.bag", "not a ROS 1 bag"});
  Write("recording.bag", "");
  ExpectRefusal(Request(), {"recording.bag", "not a ROS 1 bag"});
}

/// As after a loss of power: read as far as chunks are whole, and refused when none is.
TEST_F(BagReaderTest, ReadsABagThatIsCutOff) {
  SimulatorOptions options;
  options.duration_s = 60.0;
  WriteBag(Path("plain.bag"), Simulate(options), {});
  for (const auto compression :
       {rosbag::compression::Uncompressed, rosbag::compression::BZ2, rosbag::compression::LZ4}) {
    Recompress(Path("plain.bag"), Path("recording.bag"), compression);
    const Recording all = ReadBag(Request());
    const std::string whole = ReadText(Path("recording.bag"));
    size_t last = 0;
    for (const size_t size : {whole.size() / 2, whole.size() * 3 / 4, whole.size() - 10}) {
      Write("recording.bag", whole.substr(0, size));
      const Recording part = ReadBag(Request());
      const size_t count = part.data.poses.size();
      EXPECT_GT(count, std::max<size_t>(last, 100)) << size;
      ASSERT_LE(count, all.data.poses.size());
      last = count;
      for (size_t k = 0; k < count; ++k) {
        ASSERT_EQ(part.data.poses[k].t_ns, all.data.poses[k].t_ns);
        ASSERT_EQ(part.data.poses[k].p_WM, all.data.poses[k].p_WM);
      }
      for (size_t k = 0; k < part.data.imus[0].gyro.size(); ++k)
        ASSERT_EQ(part.data.imus[0].gyro[k].value, all.data.imus[0].gyro[k].value);
      ASSERT_EQ(part.info.notes.size(), 1u);
      EXPECT_TRUE(Contains(part.info.notes[0], "of " + std::to_string(size))) << size;
    }
    EXPECT_EQ(last, all.data.poses.size());
  }
  const std::string whole = ReadText(Path("recording.bag"));
  for (const size_t size : {size_t{20}, size_t{4096}}) {
    Write("recording.bag", whole.substr(0, size));
    ExpectRefusal(Request(), {"recording.bag", "rosbag reindex " + Path("recording.bag")});
  }
}

/// A file of rosbag record that is still .active has no index.
TEST_F(BagReaderTest, ReadsABagWithoutIndex) {
  WriteBag(Path("recording.bag"), Simulate(ShortSimulation()), {});
  const Recording all = ReadBag(Request());
  std::string text = ReadText(Path("recording.bag"));
  const std::string key = "index_pos=";
  const size_t value = text.find(key) + key.size();
  text.replace(value, 8, 8, '\0');  // as while recording
  Write("recording.bag", text);
  const Recording same = ReadBag(Request());
  EXPECT_EQ(same.data.poses.size(), all.data.poses.size());
  EXPECT_EQ(same.data.imus[0].accel.size(), all.data.imus[0].accel.size());
  ASSERT_EQ(same.info.notes.size(), 1u);
  EXPECT_TRUE(Contains(same.info.notes[0], "has no index: all of it is read"))
      << same.info.notes[0];
}

TEST_F(BagReaderTest, RefusesAnEmptyBag) {
  Record();
  ExpectRefusal(Request(), {"recording.bag", "no messages"});
}

TEST_F(BagReaderTest, RefusesASpanOutsideOfTheBag) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", Pose());
  RecordingRequest request = Request();
  request.start_s = 5.0;
  ExpectRefusal(request, {"start = 5 s", "lasts 0.01 s"});
  request.start_s = -1.0;
  ExpectRefusal(request, {"start = -1 s", "at least 0 s"});
  request.start_s = 0.0;
  request.duration_s = -2.0;
  ExpectRefusal(request, {"duration = -2 s", "at least 0 s"});
}

// --- Writer ---

TEST_F(BagReaderTest, WriterKeepsTheOrderOfReversedStamps) {
  SessionData data = Simulate(ShortSimulation());
  std::reverse(data.poses.begin(), data.poses.end());
  WriteBag(Path("recording.bag"), data, {});
  ExpectSameSamples(ReadBag(Request()).data, data);
}

TEST_F(BagReaderTest, WriterLeavesOutAnImuWithoutSamples) {
  const SessionData data = Simulate(ShortSimulation(), 3);
  for (const size_t missing : {0u, 1u}) {
    SessionData incomplete = data;
    incomplete.imus[missing] = ImuData();
    WriteBag(Path("recording.bag"), incomplete, {});
    for (size_t i = 0; i < 3; ++i) {
      if (i == missing) continue;
      RecordingRequest request = Request();
      request.imu_topic = i == 0 ? "/imu" : "/imu" + std::to_string(i);
      const SessionData read = ReadBag(request).data;
      ExpectSameSamples(read, {data.poses, {data.imus[i]}, {}});
    }
  }
}

TEST_F(BagReaderTest, WriterRefusesWhatItCannotWrite) {
  const SessionData data = Simulate(ShortSimulation());
  ExpectError<InputError>([&] { WriteBag(Path("no/dir.bag"), data, {}); }, {"no/dir.bag"});
  ExpectError<InputError>(
      [&] {
        WriteBag(Path("x.bag"), data, {false, "Path"});
      },
      {"'Path'", "PoseStamped, TransformStamped"});
  SessionData uneven = data;
  uneven.imus[0].accel.pop_back();
  ExpectError<InputError>([&] { WriteBag(Path("x.bag"), uneven, {}); }, {"600 and 599"});
  uneven = data;
  ++uneven.imus[0].accel[0].t_ns;
  ExpectError<InputError>([&] { WriteBag(Path("x.bag"), uneven, {}); }, {"same stamps"});
  uneven = Simulate(ShortSimulation(), 2);
  uneven.imus[1].accel.clear();
  ExpectError<InputError>([&] { WriteBag(Path("x.bag"), uneven, {}); }, {"600 and 0"});
}

TEST_F(BagReaderTest, TakesTheOnlyPairOfTfFrames) {
  const SessionData data = Simulate(ShortSimulation());
  const auto record = [&](bool with_another) {
    WriteBag(Path("recording.bag"), data, {});
    rosbag::Bag from(Path("recording.bag")), to(Path("tf.bag"), rosbag::bagmode::Write);
    for (const rosbag::MessageInstance& message : rosbag::View(from)) {
      const auto pose = message.instantiate<geometry_msgs::PoseStamped>();
      if (!pose) {
        to.write(message.getTopic(), message.getTime(), message);
        continue;
      }
      tf2_msgs::TFMessage tf;
      tf.transforms.resize(with_another ? 2 : 1);
      for (geometry_msgs::TransformStamped& transform : tf.transforms) {
        transform.header = pose->header;
        transform.child_frame_id = &transform == &tf.transforms[0] ? "rig" : "other";
        transform.transform.rotation = pose->pose.orientation;
        transform.transform.translation.x = pose->pose.position.x;
        transform.transform.translation.y = pose->pose.position.y;
        transform.transform.translation.z = pose->pose.position.z;
      }
      to.write("/tf", message.getTime(), tf);
    }
  };
  RecordingRequest request;
  request.paths = {Path("tf.bag")};
  record(false);
  const Recording recording = ReadBag(request);
  EXPECT_EQ(recording.data.poses.size(), data.poses.size());
  EXPECT_EQ(recording.info.world_frame, "world");
  EXPECT_EQ(recording.info.marker_frame, "rig");
  record(true);
  ExpectRefusal(request, {"give tf_parent and tf_child", "world -> other, world -> rig"});
}

}  // namespace
}  // namespace imu_pose_calib
