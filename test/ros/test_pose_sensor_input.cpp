// Poses of pose sensors from bags and text files, with and without IMUs.

#include <nav_msgs/Odometry.h>
#include <tf2_msgs/TFMessage.h>

#include <boost/algorithm/string/join.hpp>

#include "imu_pose_calib/ros/offline/offline.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "record_bag.h"

namespace imu_pose_calib {
namespace {

/// A recording with two pose sensors.
SessionData WithSensors(double time_shift_s = 0.03) {
  SimulatorOptions options = ShortSimulation();
  options.pose_sensors.resize(2);
  options.pose_sensors[0].time_shift_s = time_shift_s;
  options.pose_sensors[1].rate_hz = 20.0;
  return Simulate(options);
}

SessionData WithoutImu(SessionData data) {
  data.imus.clear();
  return data;
}

void ExpectSamePoses(const std::vector<PoseSample>& a, const std::vector<PoseSample>& b) {
  ASSERT_EQ(a.size(), b.size());
  for (size_t k = 0; k < a.size(); ++k) {
    EXPECT_EQ(a[k].t_ns, b[k].t_ns);
    EXPECT_EQ(a[k].p_WM, b[k].p_WM);
    EXPECT_EQ(a[k].q_WM.coeffs(), b[k].q_WM.coeffs());
  }
}

nav_msgs::Odometry Odometry(const std::string& child) {
  nav_msgs::Odometry msg;
  msg.header = Pose().header;
  msg.header.frame_id = "odom";
  msg.child_frame_id = child;
  msg.pose.pose = Pose().pose;
  return msg;
}

class PoseSensorInputTest : public BagReaderTest {
 protected:
  RecordingRequest Sensors(const std::vector<std::string>& names) const {
    RecordingRequest request = Request();
    request.pose_sensors = boost::join(names, " ");
    return request;
  }
  OfflineRequest Offline(const std::vector<std::string>& bags, const std::string& names) const {
    OfflineRequest request;
    for (const std::string& bag : bags) request.paths.push_back(Path(bag));
    request.pose_sensors = names;
    return request;
  }
};

TEST_F(PoseSensorInputTest, TopicsOfEveryFormatGiveBackWhatWasWritten) {
  const SessionData data = WithSensors();
  for (const auto& format :
       {std::optional<Ros2Format>(), {Ros2Format::kMcap}, {Ros2Format::kSqlite}}) {
    BagFormat shape;
    shape.ros2 = format;
    std::filesystem::remove(Path("recording.bag"));
    WriteBag(Path("recording.bag"), data, shape);
    const Recording recording = ReadBag(Sensors({"/pose_sensor1", "/pose_sensor"}));
    EXPECT_EQ(recording.info.pose_topic, "/mocap/pose");
    ExpectSamePoses(recording.data.poses, data.poses);
    EXPECT_EQ(recording.data.imus.size(), 1u);
    ASSERT_EQ(recording.data.pose_sensors.size(), 2u);
    ExpectSamePoses(recording.data.pose_sensors[0], data.pose_sensors[1]);
    ExpectSamePoses(recording.data.pose_sensors[1], data.pose_sensors[0]);
    ASSERT_EQ(recording.info.pose_sensors.size(), 2u);
    EXPECT_EQ(recording.info.pose_sensors[0].topic, "/pose_sensor1");
    EXPECT_EQ(recording.info.pose_sensors[0].frame, "pose_sensor1");
    EXPECT_EQ(recording.info.pose_sensors[0].world_frame, "pose_sensor1_world");
  }
}

TEST_F(PoseSensorInputTest, FramesAreThoseOfTheMessagesOrOfTheTopic) {
  geometry_msgs::PoseStamped nameless = Pose();
  nameless.header.frame_id = "";
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", Pose()).Add("/lidar", Odometry("/base"));
  const Recording lidar = ReadBag(Sensors({"/lidar"}));
  EXPECT_EQ(lidar.info.pose_sensors.at(0).frame, "base");
  EXPECT_EQ(lidar.info.pose_sensors[0].world_frame, "odom");
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", Pose()).Add("/cam/pose", nameless);
  const Recording camera = ReadBag(Sensors({"/cam/pose"}));
  EXPECT_EQ(camera.info.pose_sensors.at(0).frame, "cam_pose");
  EXPECT_EQ(camera.info.pose_sensors[0].world_frame, "cam_pose_world");
}

TEST_F(PoseSensorInputTest, StartAndDurationAreThoseOfTheBag) {
  WriteBag(Path("recording.bag"), WithSensors(), {});
  RecordingRequest request = Sensors({"/pose_sensor", "/pose_sensor1"});
  request.start_s = 0.5;
  request.duration_s = 1.0;
  const Recording recording = ReadBag(request);
  EXPECT_EQ(recording.data.poses.size(), 101u);
  EXPECT_NEAR(static_cast<double>(recording.data.pose_sensors[0].size()), 31.0, 1.0);
}

TEST_F(PoseSensorInputTest, TfIsReadByTheNamesOfItsFrames) {
  const SessionData data = WithSensors();
  SessionData tf = data;
  tf.pose_sensors.clear();
  WriteBag(Path("tf.bag"), tf, {false, "tf"});
  SessionData poses = WithoutImu(data);
  poses.pose_sensors.clear();
  WriteBag(Path("poses.bag"), poses, {});
  RecordingRequest request = Sensors({"tf:world:/marker"});
  request.paths = {Path("tf.bag"), Path("poses.bag")};
  const Recording recording = ReadBag(request);
  EXPECT_EQ(recording.info.pose_topic, "/mocap/pose");
  EXPECT_EQ(recording.info.pose_sensors.at(0).topic, "tf:world:marker");
  EXPECT_EQ(recording.info.pose_sensors[0].frame, "marker");
  EXPECT_EQ(recording.info.pose_sensors[0].world_frame, "world");
  ASSERT_EQ(recording.data.pose_sensors[0].size(), data.poses.size());
  EXPECT_LT((recording.data.pose_sensors[0][7].p_WM - data.poses[7].p_WM).norm(), 1e-6);

  request.pose_sensors = "tf:world:marker tf:world:marker";
  ExpectRefusal(request, {"'tf:world:marker' is given twice"});
  request.pose_sensors = "tf:world";
  ExpectRefusal(request, {"'tf:world' must be tf:PARENT:CHILD"});
  request.pose_sensors = "tf:world:camera";
  ExpectRefusal(request, {"pose_sensor 'tf:world:camera'", "'camera' is not in tf"});
  request.may_lack_sensors = true;
  EXPECT_TRUE(ReadBag(request).data.pose_sensors.at(0).empty());
  request.pose_sensors = "tf:world:marker";
  request.tf_parent = "world";
  request.tf_child = "marker";
  ExpectRefusal(request, {"'tf:world:marker' is the marker"});
}

TEST_F(PoseSensorInputTest, TheMarkerIsChosenAmongTheOthers) {
  // Of two topics the one that is no sensor; none is left when there is but one.
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/cam", Pose()).Add("/rig", Transform("rig"));
  EXPECT_EQ(ReadBag(Sensors({"/cam"})).info.marker_frame, "rig");
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/cam", Pose());
  ExpectRefusal(Sensors({"/cam"}), {"no topic of type geometry_msgs/PoseStamped"});
  // Nor is the only pair of tf frames.
  tf2_msgs::TFMessage first, second;
  first.transforms = second.transforms = {Transform("cam")};
  second.transforms[0].transform.translation.x = 1.0;
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/tf", first).Add("/tf", second);
  EXPECT_EQ(ReadBag(Request()).info.marker_frame, "cam");
  ExpectRefusal(Sensors({"tf:map:cam"}), {"no topic of type geometry_msgs/PoseStamped"});
}

TEST_F(PoseSensorInputTest, RefusesNamesThatAreNoSensor) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", Pose()).Add("/cam", Pose());
  ExpectRefusal(Sensors({"/camera"}), {"pose_sensor '/camera' is not in recording.bag", "/cam ("});
  ExpectRefusal(Sensors({"/imu"}), {"pose_sensor '/imu' is sensor_msgs/Imu", "must be"});
  ExpectRefusal(Sensors({"/cam", "/cam"}), {"pose_sensor '/cam' is given twice"});
  ExpectRefusal(Sensors({"/cam:tag"}), {"body 'tag' is given", "'/cam'", "holds one body"});
  RecordingRequest request = Sensors({"/cam"});
  request.pose_topic = "/cam";
  ExpectRefusal(request, {"pose_sensor '/cam' is the marker"});
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", Pose()).Add("/tf", tf2_msgs::TFMessage());
  ExpectRefusal(Sensors({"/tf"}), {"pose_sensor '/tf' is tf2_msgs/TFMessage", "tf:PARENT:CHILD"});
  Record()
      .Add("/imu", Imu(0.1, 9.8))
      .Add("/pose", Pose())
      .Add("/a", Odometry("x"))
      .Add("/a", Odometry("y"));
  ExpectRefusal(Sensors({"/a"}), {"pose_sensor '/a' mixes poses of several frames"});
  Record()
      .Add("/imu", Imu(0.1, 9.8))
      .Add("/pose", Pose())
      .Add("/a", Odometry("x"))
      .Add("/a", Odometry("/x"));
  EXPECT_EQ(ReadBag(Sensors({"/a"})).data.pose_sensors[0].size(), 2u);
}

TEST_F(PoseSensorInputTest, ARecordingWithThemNeedsNoImu) {
  const SessionData data = WithoutImu(WithSensors());
  WriteBag(Path("recording.bag"), data, {});
  const Recording recording = ReadBag(Sensors({"/pose_sensor", "/pose_sensor1"}));
  EXPECT_TRUE(recording.data.imus.empty());
  EXPECT_TRUE(recording.info.imus.empty());
  ExpectSamePoses(recording.data.pose_sensors.at(1), data.pose_sensors[1]);
  RecordingRequest request = Request();
  request.pose_topic = "/mocap/pose";
  ExpectRefusal(request, {"no topic of type sensor_msgs/Imu"});
  request = Sensors({"/pose_sensor", "/pose_sensor1"});
  request.imu_topic = "/imu";
  ExpectRefusal(request, {"imu_topic '/imu' is not in recording.bag"});
}

// --- Text files ---

TEST_F(PoseSensorInputTest, FilesGiveBackWhatWasWritten) {
  const SessionData data = WithSensors();
  WriteTables(Path("x"), data, false);
  WriteAslFolder(Path("asl"), data);
  RecordingRequest request;
  request.poses = Path("x.poses.txt");
  request.pose_sensors = Path("asl/pose_sensor1/data.csv") + " " + Path("x.pose_sensor.txt");
  const Recording alone = ReadText(request);
  EXPECT_TRUE(alone.data.imus.empty());
  EXPECT_TRUE(alone.info.imus.empty());
  ExpectSamePoses(alone.data.pose_sensors.at(0), data.pose_sensors[1]);
  ExpectSamePoses(alone.data.pose_sensors.at(1), data.pose_sensors[0]);
  EXPECT_EQ(alone.info.pose_sensors.at(1).topic, Path("x.pose_sensor.txt"));
  EXPECT_EQ(alone.info.pose_sensors[1].frame, "x.pose_sensor");
  EXPECT_EQ(alone.info.pose_sensors[1].world_frame, "x.pose_sensor_world");

  // In a folder they are not what is found by its columns.
  request = {};
  request.paths = {Path("asl")};
  ExpectError<InputError>([&] { FindFiles(request); }, {"several files of poses"});
  request.pose_sensors =
      Path("asl/pose_sensor0/data.csv") + " " + Path("asl/pose_sensor1/data.csv");
  EXPECT_EQ(FindFiles(request).poses, Path("asl/mocap0/data.csv"));
  std::filesystem::remove_all(Path("asl/imu0"));
  EXPECT_EQ(FindFiles(request).imu, "");
  request.pose_sensors = Path("asl/mocap0/data.csv");
  request.poses = Path("asl/mocap0/data.csv");
  ExpectError<InputError>([&] { ReadText(request); }, {"data.csv' is the marker"});
}

TEST_F(PoseSensorInputTest, FilesAreCutToTheMarkerUnlessTheirClockIsAnother) {
  for (const double time_shift_s : {0.03, 1e6}) {
    const SessionData data = WithSensors(time_shift_s);
    WriteTables(Path("x"), data, false);
    RecordingRequest request;
    request.poses = Path("x.poses.txt");
    request.imu = Path("x.imu.csv");
    request.pose_sensors = Path("x.pose_sensor.txt");
    request.start_s = 1.0;
    request.duration_s = 1.0;
    const Recording recording = ReadText(request);
    EXPECT_EQ(recording.data.imus[0].gyro.size(), 201u);
    const std::vector<PoseSample>& sensor = recording.data.pose_sensors.at(0);
    if (time_shift_s > 1.0) {
      EXPECT_EQ(sensor.size(), data.pose_sensors[0].size());
    } else {
      EXPECT_NEAR(static_cast<double>(sensor.size()), 30.0, 1.0);
      EXPECT_GE(sensor.front().t_ns, recording.data.poses.front().t_ns);
    }
  }
}

// --- Sessions, as calibrate_bag has them ---

TEST_F(PoseSensorInputTest, AFileGoesWithOneBag) {
  const SessionData data = WithSensors();
  WriteTables(Path("x"), data, false);
  SessionData marker = data;
  marker.pose_sensors.clear();
  WriteBag(Path("a.bag"), marker, {});
  WriteBag(Path("b.bag"), marker, {});
  ExpectError<InputError>(
      [&] {
        CheckOffline(Offline({"a.bag", "b.bag"}, Path("x.pose_sensor.txt")));
      },
      {"x.pose_sensor.txt' is a file, which goes with one recording, not 2"});
  OfflineRequest request = Offline({"a.bag"}, Path("x.pose_sensor.txt"));
  const auto checks = CheckOffline(request);
  EXPECT_EQ(checks.at(0).info.pose_sensors.at(0).frame, "x.pose_sensor");
  request.paths.clear();
  request.poses = Path("x.poses.txt");
  EXPECT_EQ(CheckOffline(request).at(0).info.imus.size(), 0u);
  request.pose_sensors += " /pose_sensor1";
  ExpectError<InputError>([&] { CheckOffline(request); },
                          {"pose_sensor '/pose_sensor1' is no file, nor is there a bag"});
  request = Offline({"a.bag"}, Path("x.pose_sensor.txt"));
  request.output = Path("x.pose_sensor.txt");
  ExpectError<InputError>([&] { CalibrateOffline(request); }, {"would replace the pose_sensor"});
}

TEST_F(PoseSensorInputTest, OneSessionMayLackThem) {
  const SessionData data = WithSensors();
  SessionData marker = data, camera = WithoutImu(data);
  marker.pose_sensors.clear();
  WriteBag(Path("a.bag"), marker, {});
  WriteBag(Path("a2.bag"), marker, {});
  WriteBag(Path("b.bag"), camera, {});
  const auto checks = CheckOffline(Offline({"a.bag", "b.bag"}, "/pose_sensor1 /pose_sensor"));
  ASSERT_EQ(checks.size(), 2u);
  for (const OfflineCheck& check : checks) {
    ASSERT_EQ(check.info.pose_sensors.size(), 2u);
    EXPECT_EQ(check.info.pose_sensors[0].frame, "pose_sensor1");
    EXPECT_EQ(check.info.imus.size(), 1u);
    EXPECT_EQ(check.check.imus.size(), 1u);
  }
  EXPECT_EQ(checks[0].info.pose_sensors[0].topic, "");
  EXPECT_EQ(checks[1].info.pose_sensors[0].topic, "/pose_sensor1");
  ExpectError<InputError>(
      [&] {
        CheckOffline(Offline({"a.bag", "a2.bag"}, "/pose_sensor2"));
      },
      {"pose_sensor '/pose_sensor2' has no poses in any recording"});
}

TEST_F(PoseSensorInputTest, FramesOfTheRigDiffer) {
  RecordingInfo info;
  info.marker_frame = "base";
  info.imus[0].imu_frame = "imu";
  for (const char* frame : {"base", "camera", "camera", "imu"})
    info.pose_sensors.push_back({"/topic", frame, "map"});
  NameFrames("", "", &info);
  std::vector<std::string> frames;
  for (const PoseSensorInfo& sensor : info.pose_sensors) frames.push_back(sensor.frame);
  EXPECT_EQ(frames,
            (std::vector<std::string>{"base_sensor0", "camera", "camera_sensor2", "imu_sensor3"}));
}

}  // namespace
}  // namespace imu_pose_calib
