#include <geometry_msgs/PoseStamped.h>
#include <geometry_msgs/TransformStamped.h>
#include <nav_msgs/Odometry.h>
#include <rosbag/bag.h>
#include <sensor_msgs/Imu.h>
#include <std_msgs/String.h>
#include <tf2_msgs/TFMessage.h>

#include "imu_pose_calib/ros/io/bag_reader.h"
#include "imu_pose_calib/ros/io/bag_writer.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/offline/offline.h"
#include "recompress.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

/// Writes messages one by one; record times follow each other by 10 ms from 100 s.
class Recorder {
 public:
  explicit Recorder(const std::string& path) : bag_(path, rosbag::bagmode::Write) {}

  template <typename Msg>
  Recorder& Add(const std::string& topic, const Msg& msg) {
    bag_.write(topic, ros::Time(100) + ros::Duration(0.01 * count_++), msg);
    return *this;
  }

 private:
  rosbag::Bag bag_;
  int count_ = 0;
};

sensor_msgs::Imu Imu(double gyro_x, double accel_x) {
  sensor_msgs::Imu msg;
  msg.header.stamp = ros::Time(50, 1);
  msg.header.frame_id = "/imu_link";
  msg.angular_velocity.x = gyro_x;
  msg.linear_acceleration.x = accel_x;
  return msg;
}

geometry_msgs::PoseStamped Pose() {
  geometry_msgs::PoseStamped msg;
  msg.header.stamp = ros::Time(60, 123456789);
  msg.header.frame_id = "/map";
  msg.pose.orientation.w = 1.0;
  return msg;
}

geometry_msgs::TransformStamped Transform(const std::string& child) {
  geometry_msgs::TransformStamped msg;
  msg.header.stamp = ros::Time(60, 123456789);
  msg.header.frame_id = "map";
  msg.child_frame_id = child;
  msg.transform.rotation.w = 1.0;
  return msg;
}

class BagReaderTest : public TempDirTest {
 protected:
  BagRequest Request() const {
    BagRequest request;
    request.paths = {Path("recording.bag")};
    return request;
  }
  Recorder Record() const { return Recorder(Path("recording.bag")); }
  static void ExpectRefusal(const BagRequest& request, const std::vector<std::string>& parts) {
    ExpectError<InputError>([&] { ReadBag(request); }, parts);
  }
};

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
  expect_same(a.gyro, b.gyro);
  expect_same(a.accel, b.accel);
}

TEST_F(BagReaderTest, ReadsBackWhatTheWriterWrote) {
  const SessionData data = Simulate(ShortSimulation());
  WriteBag(Path("recording.bag"), data, {});
  const Recording recording = ReadBag(Request());
  ExpectSameSamples(recording.data, data);
  EXPECT_EQ(recording.info.bag, Path("recording.bag"));
  EXPECT_EQ(recording.info.imu_topic, "/imu");
  EXPECT_EQ(recording.info.gyro_topic, "");
  EXPECT_EQ(recording.info.pose_topic, "/mocap/pose");
  EXPECT_EQ(recording.info.world_frame, "world");
  EXPECT_EQ(recording.info.marker_frame, "marker");
  EXPECT_EQ(recording.info.imu_frame, "imu");
}

TEST_F(BagReaderTest, TellsTheTopicsOfASplitImuApart) {
  SimulatorOptions simulator = ShortSimulation();
  simulator.accel_rate_hz = 150.0;
  const SessionData data = Simulate(simulator);
  WriteBag(Path("recording.bag"), data, {true, "TransformStamped"});
  const Recording recording = ReadBag(Request());
  ExpectSameSamples(recording.data, data);
  EXPECT_EQ(recording.info.imu_topic, "");
  EXPECT_EQ(recording.info.gyro_topic, "/imu/gyro");
  EXPECT_EQ(recording.info.accel_topic, "/imu/accel");
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
  BagRequest request = Request();
  request.gyro_topic = "/imu/gyro";
  request.accel_topic = "/imu/accel";
  const Recording recording = ReadBag(request);
  ExpectSameSamples(recording.data, data);
  EXPECT_EQ(recording.info.imu_frame, "imu");
}

TEST_F(BagReaderTest, ReadsTf) {
  const SessionData data = Simulate(ShortSimulation());
  WriteBag(Path("recording.bag"), data, {false, "tf"});
  BagRequest request = Request();
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

TEST_F(BagReaderTest, ReadsImuAndPosesFromABagEach) {
  SessionData data = Simulate(ShortSimulation()), poses, imu = data;
  poses.poses = data.poses;
  imu.poses.clear();
  WriteBag(Path("poses.bag"), poses, {});
  WriteBag(Path("imu.bag"), imu, {});
  BagRequest request;
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
  BagRequest request = Request();
  request.record_time = true;
  const SessionData data = ReadBag(request).data;
  EXPECT_EQ(data.gyro.at(0).t_ns, 100000000000);
  EXPECT_EQ(data.accel.at(0).t_ns, 100000000000);
  EXPECT_EQ(data.poses.at(0).t_ns, 100010000000);
}

TEST_F(BagReaderTest, StampsTfWithRecordTimes) {
  tf2_msgs::TFMessage first, second;
  first.transforms = {Transform("rig")};
  second.transforms = {Transform("rig")};
  second.transforms[0].transform.translation.x = 1.0;
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/tf", first).Add("/tf", second);
  BagRequest request = Request();
  request.tf_parent = "map";
  request.tf_child = "rig";
  request.record_time = true;
  const SessionData data = ReadBag(request).data;
  ASSERT_EQ(data.poses.size(), 2u);
  EXPECT_EQ(data.poses[0].t_ns, 100010000000);
  EXPECT_EQ(data.poses[1].t_ns, 100020000000);
}

TEST_F(BagReaderTest, TheUsualImuIsTakenWhenItIsThere) {
  Record().Add("/imu1", Imu(1, 9.8)).Add("/imu2", Imu(2, 9.8)).Add("/pose", Pose());
  BagRequest request = Request();
  request.usual_imu_topic = "/imu2";
  EXPECT_EQ(ReadBag(request).info.imu_topic, "/imu2");
  request.imu_topic = "/imu1";
  EXPECT_EQ(ReadBag(request).info.imu_topic, "/imu1");
  request.imu_topic = "";
  request.usual_imu_topic = "/imu3";
  ExpectRefusal(request, {"several IMU topics"});
}

TEST_F(BagReaderTest, OneTextNamesSeveralBags) {
  EXPECT_EQ(SplitBags("a.bag  b.bag"), (std::vector<std::string>{"a.bag", "b.bag"}));
  EXPECT_EQ(SplitBags(""), std::vector<std::string>());
  Write("my own.bag", "");
  EXPECT_EQ(SplitBags(Path("my own.bag")), std::vector<std::string>{Path("my own.bag")});
}

TEST_F(BagReaderTest, TellsASplitImuByItsZerosAlone) {
  Record().Add("/a", Imu(0, 9.8)).Add("/b", Imu(0.1, 0)).Add("/pose", Pose());
  const Recording recording = ReadBag(Request());
  EXPECT_EQ(recording.info.gyro_topic, "/b");
  EXPECT_EQ(recording.info.accel_topic, "/a");
}

TEST_F(BagReaderTest, TellsASplitImuByItsCovarianceAlone) {
  sensor_msgs::Imu gyro = Imu(0.1, 9.8), accel = Imu(0.1, 9.8);
  gyro.linear_acceleration_covariance[0] = -1;
  accel.angular_velocity_covariance[0] = -1;
  Record().Add("/a", accel).Add("/b", gyro).Add("/pose", Pose());
  EXPECT_EQ(ReadBag(Request()).info.gyro_topic, "/b");
}

TEST_F(BagReaderTest, PassesOverAnImuThatCarriesNothing) {
  Record().Add("/idle", Imu(0, 0)).Add("/imu", Imu(0.1, 9.8)).Add("/pose", Pose());
  EXPECT_EQ(ReadBag(Request()).info.imu_topic, "/imu");
}

TEST_F(BagReaderTest, KeepsNanosecondsAndFrames) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", Transform("/rig"));
  const Recording recording = ReadBag(Request());
  EXPECT_EQ(recording.data.poses.at(0).t_ns, 60123456789);
  EXPECT_EQ(recording.data.gyro.at(0).t_ns, 50000000001);
  EXPECT_EQ(recording.info.world_frame, "map");
  EXPECT_EQ(recording.info.marker_frame, "rig");
  EXPECT_EQ(recording.info.imu_frame, "imu_link");
}

TEST_F(BagReaderTest, KeepsTheOrderOfRecording) {
  geometry_msgs::PoseStamped earlier = Pose();
  earlier.header.stamp = ros::Time(59);
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", Pose()).Add("/pose", earlier);
  EXPECT_GT(ReadBag(Request()).data.poses.at(0).t_ns, ReadBag(Request()).data.poses.at(1).t_ns);
}

TEST_F(BagReaderTest, NamedTopicsWinOverOthers) {
  Record()
      .Add("/imu1", Imu(1, 9.8))
      .Add("/imu2", Imu(2, 9.8))
      .Add("/pose1", Pose())
      .Add("/pose2", Transform("rig"));
  BagRequest request = Request();
  request.imu_topic = "/imu2";
  request.pose_topic = "/pose2";
  const Recording recording = ReadBag(request);
  EXPECT_EQ(recording.data.gyro.at(0).value.x(), 2.0);
  EXPECT_EQ(recording.info.marker_frame, "rig");

  request.imu_topic = "";
  request.gyro_topic = "/imu1";
  request.accel_topic = "/imu2";
  EXPECT_EQ(ReadBag(request).data.gyro.at(0).value.x(), 1.0);
  EXPECT_EQ(ReadBag(request).info.accel_topic, "/imu2");
}

TEST_F(BagReaderTest, StartAndDurationAreRecordTimeAfterTheFirstMessage) {
  {
    Recorder recorder = Record();
    for (int k = 0; k < 10; ++k) recorder.Add("/imu", Imu(k + 1, 9.8)).Add("/pose", Pose());
  }
  BagRequest request = Request();
  request.start_s = 0.035;     // messages 4..19, the IMU's are the even ones
  request.duration_s = 0.100;  // to message 13
  const Recording recording = ReadBag(request);
  ASSERT_EQ(recording.data.gyro.size(), 5u);
  EXPECT_EQ(recording.data.gyro.front().value.x(), 3.0);
  EXPECT_EQ(recording.data.gyro.back().value.x(), 7.0);
  EXPECT_EQ(recording.data.poses.size(), 5u);
}

TEST_F(BagReaderTest, RecordTimesOfForeignClocksAreThePoses) {
  SimulatorOptions simulator = ShortSimulation();
  simulator.time_shift_s = 1034771.5;
  WriteBag(Path("recording.bag"), Simulate(simulator), {});
  BagRequest request = Request();
  request.duration_s = 1.0;
  const Recording recording = ReadBag(request);
  EXPECT_EQ(recording.data.poses.size(), 101u);
  EXPECT_EQ(recording.data.gyro.size(), 201u);
  EXPECT_EQ(recording.data.gyro[0].t_ns, simulator.start_ns - 1034771500000000);
}

// --- Refusals: files ---

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

TEST_F(BagReaderTest, RefusesACutOffBag) {
  WriteBag(Path("recording.bag"), Simulate(ShortSimulation()), {});
  const std::string whole = ReadText(Path("recording.bag"));
  for (const size_t size : {size_t{20}, size_t{4096}, whole.size() / 2, whole.size() - 10}) {
    Write("recording.bag", whole.substr(0, size));
    ExpectRefusal(Request(), {"recording.bag", "rosbag reindex " + Path("recording.bag")});
  }
}

TEST_F(BagReaderTest, RefusesABagWithoutIndex) {
  WriteBag(Path("recording.bag"), Simulate(ShortSimulation()), {});
  std::string text = ReadText(Path("recording.bag"));
  const std::string key = "index_pos=";
  const size_t value = text.find(key) + key.size();
  text.replace(value, 8, 8, '\0');  // as while recording
  Write("recording.bag", text);
  ExpectRefusal(Request(), {"no index", "rosbag reindex " + Path("recording.bag")});
}

TEST_F(BagReaderTest, RefusesAnEmptyBag) {
  Record();
  ExpectRefusal(Request(), {"recording.bag", "no messages"});
}

TEST_F(BagReaderTest, RefusesASpanOutsideOfTheBag) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", Pose());
  BagRequest request = Request();
  request.start_s = 5.0;
  ExpectRefusal(request, {"start = 5 s", "lasts 0.01 s"});
  request.start_s = -1.0;
  ExpectRefusal(request, {"start = -1 s", "at least 0 s"});
  request.start_s = 0.0;
  request.duration_s = -2.0;
  ExpectRefusal(request, {"duration = -2 s", "at least 0 s"});
}

// --- Refusals: topics ---

TEST_F(BagReaderTest, RefusesATopicThatIsNotThere) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/mocap/pose", Pose()).Add("/mocap/pose", Pose());
  BagRequest request = Request();
  request.imu_topic = "/foo";
  ExpectRefusal(request,
                {"imu_topic '/foo' is not in recording.bag; it has: /imu (sensor_msgs/Imu, 1), "
                 "/mocap/pose (geometry_msgs/PoseStamped, 2)"});
  request = Request();
  request.pose_topic = "/bar";
  ExpectRefusal(request, {"pose_topic '/bar' is not in recording.bag"});
}

TEST_F(BagReaderTest, RefusesATopicOfTheWrongType) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", Pose());
  BagRequest request = Request();
  request.imu_topic = "/pose";
  ExpectRefusal(request, {"imu_topic '/pose'", "geometry_msgs/PoseStamped", "sensor_msgs/Imu"});
  request = Request();
  request.pose_topic = "/imu";
  ExpectRefusal(request,
                {"pose_topic '/imu'", "is sensor_msgs/Imu", "geometry_msgs/TransformStamped"});
  request = Request();
  request.gyro_topic = "/imu";
  request.accel_topic = "/pose";
  ExpectRefusal(request, {"accel_topic '/pose'", "sensor_msgs/Imu"});
}

TEST_F(BagReaderTest, RefusesABagWithoutImuOrPoses) {
  std_msgs::String text;
  Record().Add("/pose", Pose()).Add("/chatter", text);
  ExpectRefusal(Request(), {"no topic of type sensor_msgs/Imu", "/chatter (std_msgs/String, 1)"});
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/chatter", text);
  ExpectRefusal(Request(),
                {"no topic of type geometry_msgs/PoseStamped", "/chatter (std_msgs/String, 1)"});
}

TEST_F(BagReaderTest, RefusesToChooseBetweenPoseTopics) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/p1", Pose()).Add("/p2", Transform("rig"));
  ExpectRefusal(Request(),
                {"/p1 (geometry_msgs/PoseStamped, 1)",
                 "/p2 (geometry_msgs/TransformStamped, 1)",
                 "choose with pose_topic"});
}

TEST_F(BagReaderTest, RefusesToChooseBetweenImus) {
  Record().Add("/imu1", Imu(0.1, 9.8)).Add("/imu2", Imu(0.1, 9.8)).Add("/pose", Pose());
  ExpectRefusal(Request(), {"/imu1 (sensor_msgs/Imu, 1)", "/imu2", "imu_topic", "gyro_topic"});
}

TEST_F(BagReaderTest, RefusesToChooseBetweenAWholeAndASplitImu) {
  Record()
      .Add("/imu", Imu(0.1, 9.8))
      .Add("/gyro", Imu(0.1, 0))
      .Add("/accel", Imu(0, 9.8))
      .Add("/pose", Pose());
  ExpectRefusal(Request(), {"/imu (", "/gyro (", "/accel (", "choose"});
}

TEST_F(BagReaderTest, RefusesHalfAnImu) {
  Record().Add("/gyro", Imu(0.1, 0)).Add("/pose", Pose());
  ExpectRefusal(Request(), {"'/gyro' carries no linear acceleration"});
  Record().Add("/accel", Imu(0, 9.8)).Add("/pose", Pose());
  ExpectRefusal(Request(), {"'/accel' carries no angular velocity"});
}

TEST_F(BagReaderTest, RefusesContradictingImuTopics) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", Pose());
  BagRequest request = Request();
  request.gyro_topic = "/imu";
  ExpectRefusal(request, {"accel_topic is missing"});
  request.accel_topic = request.imu_topic = "/imu";
  ExpectRefusal(request, {"either imu_topic, or gyro_topic and accel_topic"});
}

TEST_F(BagReaderTest, RefusesMessagesWithoutStamps) {
  sensor_msgs::Imu imu = Imu(0.1, 9.8);
  imu.header.stamp = ros::Time();
  Record().Add("/imu", imu).Add("/pose", Pose());
  ExpectRefusal(Request(), {"'/imu' has no header stamps"});
  geometry_msgs::PoseStamped pose = Pose();
  pose.header.stamp = ros::Time();
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", pose);
  ExpectRefusal(Request(), {"'/pose' has no header stamps"});
}

TEST_F(BagReaderTest, RefusesPosesOfSeveralBodies) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/poses", Transform("a")).Add("/poses", Transform("b"));
  ExpectRefusal(Request(), {"pose_topic '/poses'", "'a'", "'b'"});
}

// --- Writer ---

TEST_F(BagReaderTest, WriterKeepsTheOrderOfReversedStamps) {
  SessionData data = Simulate(ShortSimulation());
  std::reverse(data.poses.begin(), data.poses.end());
  WriteBag(Path("recording.bag"), data, {});
  ExpectSameSamples(ReadBag(Request()).data, data);
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
  uneven.accel.pop_back();
  ExpectError<InputError>([&] { WriteBag(Path("x.bag"), uneven, {}); }, {"600 and 599"});
  uneven = data;
  ++uneven.accel[0].t_ns;
  ExpectError<InputError>([&] { WriteBag(Path("x.bag"), uneven, {}); }, {"same stamps"});
}

}  // namespace
}  // namespace imu_pose_calib
