// Bags of ROS 2, written here and by others, give what the same bag of ROS 1 gives.

#include <sqlite3.h>

#include "imu_pose_calib/ros/io/bag_file.h"
#include "imu_pose_calib/ros/io/recording.h"
#include "imu_pose_calib/ros/offline/offline.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "run_executable.h"
#include "to_ros2.h"

namespace imu_pose_calib {
namespace {

constexpr char kSample[] = IMU_POSE_CALIB_SOURCE_DIR "/data/estimator_own_clocks.bag";
constexpr char kForeign[] = IMU_POSE_CALIB_SOURCE_DIR "/test/ros/bags/";

Recording Read(const std::string& path, const std::string& body = "") {
  RecordingRequest request;
  request.paths = {path};
  request.body = body;
  return ReadBag(request);
}

/// All that a recording holds but its path, to the last bit.
std::string Bits(const Recording& recording) {
  std::ostringstream text;
  text << std::hexfloat;
  const auto put_latency = [&](const std::optional<Latency>& latency) {
    if (latency) text << latency->median_s << " " << latency->spread_s << "\n";
  };
  const auto put_poses = [&](const std::vector<PoseSample>& poses) {
    for (const PoseSample& pose : poses)
      text << pose.t_ns << " " << pose.q_WM.coeffs() << pose.p_WM << pose.stated_std.position << " "
           << pose.stated_std.rotation << "\n";
  };
  const RecordingInfo& info = recording.info;
  text << info.pose_topic << "|" << info.world_frame << "|" << info.marker_frame << "|"
       << info.notes.size() << "|" << info.imus.size() << "|" << info.pose_sensors.size() << "\n";
  for (const ImuInfo& imu : info.imus) {
    text << imu.GyroSource() << "|" << imu.AccelSource() << "|" << imu.imu_frame << "\n";
    put_latency(imu.gyro_latency);
    put_latency(imu.accel_latency);
  }
  put_latency(info.pose_latency);
  put_poses(recording.data.poses);
  for (const auto& poses : recording.data.pose_sensors) put_poses(poses);
  for (const ImuData& imu : recording.data.imus)
    for (const auto* samples : {&imu.gyro, &imu.accel})
      for (const ImuSample& sample : *samples) text << sample.t_ns << " " << sample.value << "\n";
  return text.str();
}

/// The sample of that stamp, which must be there.
template <typename Sample>
const Sample* At(const std::vector<Sample>& samples, int64_t t_ns) {
  for (const Sample& sample : samples)
    if (sample.t_ns == t_ns) return &sample;
  throw std::runtime_error("no sample at " + std::to_string(t_ns));
}

class Ros2BagTest : public ExecutableTest {
 protected:
  void SetUp() override {
    ExecutableTest::SetUp();
    WriteBag(Path("x.bag"), Simulate(ShortSimulation()), {});
  }

  /// Writes x.bag as a file of ROS 2.
  std::string Convert(const Ros2Way& way, const std::string& prefix = "x.") const {
    ToRos2(Path("x.bag"), Path(prefix + way.ending), way);
    return Path(prefix + way.ending);
  }
  void WriteBytes(const std::string& name, const std::string& bytes) const {
    std::ofstream(Path(name), std::ios::binary) << bytes;
  }
  static void ExpectRefusal(const std::string& path, const std::vector<std::string>& parts) {
    ExpectError<InputError>([&] { Read(path); }, parts);
  }

  /// A folder "bag" whose two files hold every second message each, and a metadata.yaml.
  void WriteFolder(const Ros2Way& way, const std::string& names) const {
    std::filesystem::create_directory(Path("bag"));
    ToRos2(Path("x.bag"), Path("bag/bag_0." + way.ending), way, 0, 2);
    ToRos2(Path("x.bag"), Path("bag/bag_1." + way.ending), way, 1, 2);
    WriteBytes("bag/metadata.yaml",
               "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n"
               "  relative_file_paths: " +
                   names + "\n  compression_mode: \"\"\n");
  }
};

TEST_F(Ros2BagTest, SampleIsTheSameInEveryFormat) {
  const std::string expected = Bits(Read(kSample));
  EXPECT_GT(expected.size(), 1'000'000u);
  for (const Ros2Way& way : Ros2Ways()) {
    const std::string path = Path("sample." + way.ending);
    ToRos2(kSample, path, way);
    EXPECT_TRUE(Bits(Read(path)) == expected) << way.ending;
    if (!way.chunk_compression.empty() || way.compress_messages) continue;
    WriteBytes("whole.zstd", CompressZstd(ReadText(path)));
    EXPECT_TRUE(Bits(Read(Path("whole.zstd"))) == expected) << way.ending << " in zstd";
  }
}

TEST_F(Ros2BagTest, FilesOfOtherWritersAreRead) {
  const Recording whole = Read(kSample);
  for (const char* name : {"sample_lz4.mcap", "sample_zstd.mcap", "sample.db3"}) {
    const Recording part = Read(std::string(kForeign) + name);
    EXPECT_EQ(part.info.pose_topic, whole.info.pose_topic) << name;
    EXPECT_EQ(part.info.imus[0].imu_topic, whole.info.imus[0].imu_topic) << name;
    EXPECT_EQ(part.info.world_frame, whole.info.world_frame) << name;
    EXPECT_TRUE(part.info.notes.empty()) << name;
    const SessionData &some = part.data, &all = whole.data;
    ASSERT_EQ(some.poses.size() + some.imus[0].gyro.size(), 100u) << name;
    ASSERT_GT(some.imus[0].gyro.size(), 20u) << name;
    for (const PoseSample& pose : some.poses) {
      const PoseSample& expected = *At(all.poses, pose.t_ns);
      EXPECT_EQ(pose.p_WM, expected.p_WM);
      EXPECT_EQ(pose.q_WM.coeffs(), expected.q_WM.coeffs());
    }
    for (size_t k = 0; k < some.imus[0].gyro.size(); ++k) {
      const int64_t t_ns = some.imus[0].gyro[k].t_ns;
      EXPECT_EQ(some.imus[0].gyro[k].value, At(all.imus[0].gyro, t_ns)->value);
      EXPECT_EQ(some.imus[0].accel[k].value, At(all.imus[0].accel, t_ns)->value);
    }
  }
}

TEST_F(Ros2BagTest, EveryTypeOfMessageIsTheSame) {
  for (const char* type :
       {"TransformStamped", "PoseWithCovarianceStamped", "Odometry", "PoseStamped"}) {
    WriteBag(Path("x.bag"), Simulate(ShortSimulation()), {true, type});
    const Ros2Way way = Ros2Ways().front();
    EXPECT_TRUE(Bits(Read(Convert(way))) == Bits(Read(Path("x.bag")))) << type;
  }
  WriteBag(Path("x.bag"), Simulate(ShortSimulation()), {false, "tf", "Vector3Stamped"});
  Convert(Ros2Ways().front());
  RecordingRequest request;
  request.gyro_topic = "/imu/gyro";
  request.accel_topic = "/imu/accel";
  request.tf_parent = "world";
  request.tf_child = "marker";
  request.start_s = 1.0;
  request.duration_s = 1.0;
  request.paths = {Path("x.bag")};
  const Recording expected = ReadBag(request);
  request.paths = {Path("x.mcap")};
  EXPECT_TRUE(Bits(ReadBag(request)) == Bits(expected));
  EXPECT_GT(expected.data.poses.size(), 90u);
}

TEST_F(Ros2BagTest, AFolderIsReadByItsMetadata) {
  const std::string expected = Bits(Read(Path("x.bag")));
  for (const Ros2Way& way : Ros2Ways()) {
    std::filesystem::remove_all(Path("bag"));
    // Old versions name the folder too; the order does not count, times do.
    const std::string first = "bag_0." + way.ending, second = "bag_1." + way.ending;
    WriteFolder(way, "[\"bag/" + second + "\", " + first + "]");
    EXPECT_TRUE(Bits(Read(Path("bag"))) == expected) << way.ending;
    std::filesystem::remove(Path("bag/metadata.yaml"));  // the recorder did not come to its end
    EXPECT_TRUE(Bits(Read(Path("bag/"))) == expected) << way.ending;
  }
}

TEST_F(Ros2BagTest, AFolderMayBeCompressedByFile) {
  const Ros2Way way = Ros2Ways().front();
  WriteFolder(way, "[bag_0.mcap.zstd, bag_1.mcap]");
  for (const char* name : {"bag/bag_0.mcap", "bag/bag_1.mcap"}) {
    WriteBytes(std::string(name) + ".zstd", CompressZstd(ReadText(Path(name))));
    std::filesystem::remove(Path(name));
  }
  EXPECT_TRUE(Bits(Read(Path("bag"))) == Bits(Read(Path("x.bag"))));
}

/// The file may end where a part that is unfolded at a time does.
TEST_F(Ros2BagTest, AFileOfAnySizeMayBeCompressed) {
  for (const size_t size : {9u, 1u << 17, 1u << 18, (1u << 17) + 1}) {
    std::string bytes = "\x89MCAP0\r\n";
    bytes.resize(size, 'x');
    WriteBytes("whole.zstd", CompressZstd(bytes));
    const std::string note = OpenBagFile(Path("whole.zstd"))->note();
    EXPECT_TRUE(Contains(note, "byte 8 of " + std::to_string(size) + ",")) << note;
  }
}

TEST_F(Ros2BagTest, RefusesMetadataThatDoNotFit) {
  WriteFolder(Ros2Ways().front(), "[bag_0.mcap, bag_7.mcap]");
  ExpectRefusal(Path("bag"), {"bag/metadata.yaml'", "'bag_7.mcap' that it names is missing"});
  WriteBytes("bag/metadata.yaml", "rosbag2_bagfile_information:\n  relative_file_paths: 3\n");
  ExpectRefusal(Path("bag"), {"metadata.yaml'", "relative_file_paths names no files"});
  WriteBytes("bag/metadata.yaml", "a: [\n");
  ExpectRefusal(Path("bag"), {"metadata.yaml': line 2"});
  WriteBytes("bag/metadata.yaml", "rosbag2_bagfile_information:\n  relative_file_paths: [..]\n");
  ExpectRefusal(Path("bag"), {"'..' that it names is missing"});
}

TEST_F(Ros2BagTest, ACutOffMcapIsReadAsFarAsItIsWhole) {
  for (const Ros2Way& way : Ros2Ways()) {
    if (!way.IsMcap()) continue;
    const std::string path = Convert(way), bytes = ReadText(path);
    WriteBytes("cut.mcap", bytes.substr(0, bytes.size() * 6 / 10));
    const Recording cut = Read(Path("cut.mcap")), whole = Read(Path("x.bag"));
    EXPECT_GT(cut.data.poses.size(), whole.data.poses.size() / 3) << way.ending;
    EXPECT_LT(cut.data.poses.size(), whole.data.poses.size() * 8 / 10) << way.ending;
    ASSERT_EQ(cut.info.notes.size(), 1u) << way.ending;
    for (const char* part : {"cut.mcap' is cut off", " of ", " messages"})
      EXPECT_TRUE(Contains(cut.info.notes[0], part)) << cut.info.notes[0];
    EXPECT_EQ(cut.data.poses.back().p_WM, whole.data.poses[cut.data.poses.size() - 1].p_WM);
    EXPECT_TRUE(Read(path).info.notes.empty()) << way.ending;
  }
  const Outcome outcome = Calibrate("--check cut.mcap");
  EXPECT_TRUE(Contains(outcome.out, "warning: 'cut.mcap' is cut off")) << outcome.out;
}

TEST_F(Ros2BagTest, RefusesDamage) {
  const std::string path = Convert({"mcap", "zstd"});
  const std::string whole = ReadText(path);
  // In the middle of the first chunk's frame.
  std::string bytes = whole;
  bytes[bytes.find("zstd") + 5000] ^= 1;
  WriteBytes("bad.mcap", bytes);
  ExpectRefusal(Path("bad.mcap"), {"bad.mcap' is damaged, record at byte"});
  // A chunk of another size than it says, and one that would fill the memory.
  const size_t size_at = whole.find("zstd") - 4 - 4 - 8;
  bytes = whole;
  ++bytes[size_at];
  WriteBytes("bad.mcap", bytes);
  ExpectRefusal(Path("bad.mcap"), {"bad.mcap' is damaged", "bytes, must be"});
  bytes[size_at + 5] = 1;
  WriteBytes("bad.mcap", bytes);
  ExpectRefusal(Path("bad.mcap"), {"bad.mcap' is damaged", "must be at most 1073741824"});
  // A checksum.
  bytes = ReadText(Convert(Ros2Ways().front()));
  bytes[bytes.size() / 2] ^= 1;
  WriteBytes("bad.mcap", bytes);
  ExpectRefusal(Path("bad.mcap"), {"bad.mcap' is damaged", "the checksum of the chunk is wrong"});
}

TEST_F(Ros2BagTest, RefusesADatabaseInSqlitesWords) {
  const std::string whole = ReadText(Convert(Ros2Ways()[5]));
  WriteBytes("bad.db3", whole.substr(0, whole.size() / 2));
  ExpectRefusal(Path("bad.db3"), {"bad.db3'", "database disk image is malformed"});
  const auto make = [&](const char* sql) {
    std::filesystem::remove(Path("made.db3"));
    sqlite3* database = nullptr;
    ASSERT_EQ(sqlite3_open(Path("made.db3").c_str(), &database), SQLITE_OK);
    ASSERT_EQ(sqlite3_exec(database, sql, nullptr, nullptr, nullptr), SQLITE_OK);
    sqlite3_close(database);
  };
  make("CREATE TABLE other(id INTEGER)");
  ExpectRefusal(Path("made.db3"), {"made.db3'", "no table topics"});
  const std::string topics =
      "CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, serialization_format TEXT);"
      "INSERT INTO topics VALUES(1, '/imu', 'sensor_msgs/msg/Imu', 'cdr');"
      "INSERT INTO topics VALUES(3, '/pose', 'geometry_msgs/msg/PoseStamped', 'cdr');";
  make((topics +
        "CREATE VIEW messages AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n) "
        "SELECT x AS topic_id, x AS timestamp FROM n")
           .c_str());
  ExpectRefusal(Path("made.db3"), {"made.db3'", "no table messages"});
  const std::string messages =
      "CREATE TABLE messages(topic_id INTEGER, timestamp INTEGER, data);"
      "INSERT INTO messages VALUES(3, 9, x'00');";
  make((topics + messages + "INSERT INTO messages VALUES(2, 1, x'00')").c_str());
  ExpectRefusal(Path("made.db3"), {"made.db3'", "topic 2, which is unknown"});
  make((topics + messages + "INSERT INTO messages VALUES(1, 'soon', x'00')").c_str());
  ExpectRefusal(Path("made.db3"), {"made.db3'", "no number or time"});
  make((topics + messages + "INSERT INTO messages VALUES(1, -5, x'00')").c_str());
  ExpectRefusal(Path("made.db3"), {"-5 ns"});
  make((topics + messages + "INSERT INTO messages VALUES(1, 5, 'text')").c_str());
  ExpectRefusal(Path("made.db3"), {"made.db3'", "message 2 has no data"});
  make((topics + messages + "INSERT INTO messages VALUES(1, 5, x'00010000')").c_str());
  ExpectRefusal(Path("made.db3"), {"'/imu'", "5 ns", "sensor_msgs/Imu", "too few"});
}

TEST_F(Ros2BagTest, NothingIsWrittenBesideADatabase) {
  const std::string path = Convert(Ros2Ways()[5]);
  std::set<std::string> before, after;
  for (const auto& entry : std::filesystem::directory_iterator(dir_)) before.insert(entry.path());
  Read(path);
  for (const auto& entry : std::filesystem::directory_iterator(dir_)) after.insert(entry.path());
  EXPECT_EQ(after, before);
}

TEST_F(Ros2BagTest, ChangesBesideADatabaseCount) {
  const std::string path = Convert(Ros2Ways()[5]);
  const size_t all = Read(path).data.poses.size();
  // As while it is being recorded, or after a crash.
  sqlite3* database = nullptr;
  ASSERT_EQ(sqlite3_open(path.c_str(), &database), SQLITE_OK);
  const char* sql =
      "PRAGMA journal_mode=WAL;"
      "DELETE FROM messages WHERE id IN (SELECT id FROM messages WHERE topic_id IN (SELECT id FROM "
      "topics WHERE name = '/mocap/pose') ORDER BY id LIMIT 5)";
  ASSERT_EQ(sqlite3_exec(database, sql, nullptr, nullptr, nullptr), SQLITE_OK);
  EXPECT_GT(std::filesystem::file_size(path + "-wal"), 0u);
  EXPECT_EQ(Read(path).data.poses.size(), all - 5);
  sqlite3_close(database);
}

TEST_F(Ros2BagTest, WhatIsNoBagIsNamed) {
  WriteBytes("empty.mcap", "");
  ExpectRefusal(Path("empty.mcap"), {"empty.mcap' is neither", "it is empty"});
  WriteBytes("text.db3", "hello");
  ExpectRefusal(Path("text.db3"), {"text.db3' is neither an mcap file nor a database"});
  WriteBytes("text.txt", "hello");
  ExpectRefusal(Path("text.txt"), {"text.txt' is not a ROS 1 bag, nor"});
  WriteBytes("cut.zstd", CompressZstd(ReadText(Convert(Ros2Ways().front()))).substr(0, 20000));
  ExpectRefusal(Path("cut.zstd"), {"cut.zstd'", "zstd: it is cut off"});
}

TEST_F(Ros2BagTest, BagsOfBothKindsAreNoOneRecording) {
  RecordingRequest request;
  request.paths = {Path("x.bag"), Convert(Ros2Ways().front())};
  ExpectError<InputError>([&] { ReadBag(request); }, {"ROS 1 and of ROS 2", "x.bag, x.mcap"});
}

TEST_F(Ros2BagTest, OneBodyOfSeveralIsChosenByName) {
  const SessionData data = Simulate(ShortSimulation());
  const auto write = [&](bool with_wand) {
    const auto storage = CreateMcap(Path("bodies.mcap"));
    storage->AddTopic("/imu", "sensor_msgs/msg/Imu", "");
    storage->AddTopic("/poses", "motion_capture_tracking_interfaces/msg/NamedPoseArray", "");
    for (const ImuSample& sample : data.imus[0].gyro) {
      sensor_msgs::Imu imu;
      imu.header.stamp = FromNanoseconds(sample.t_ns);
      imu.angular_velocity = ToVector3Msg(sample.value);
      imu.linear_acceleration.z = 9.8;
      storage->Write(0, sample.t_ns, ToCdr(imu));
    }
    for (const PoseSample& sample : data.poses) {
      CdrOutput output;
      std_msgs::Header header;
      header.stamp = FromNanoseconds(sample.t_ns);
      header.frame_id = "mocap";
      output.next(header);
      output.next(uint32_t{with_wand ? 2u : 1u});
      for (const char* name : {"rig", "wand"}) {
        if (!with_wand && std::string(name) == "wand") continue;
        const geometry_msgs::Pose pose =
            ToPoseMsg({sample.q_WM, sample.p_WM + Eigen::Vector3d(0, 0, name[0] == 'r' ? 0 : 5)});
        output.next(std::string(name));
        output.next(pose);
      }
      storage->Write(1, sample.t_ns, output.Message());
    }
    storage->Close();
  };
  write(true);
  ExpectRefusal(Path("bodies.mcap"), {"'/poses' has the bodies: rig, wand; choose with body"});
  ExpectError<InputError>([&] { Read(Path("bodies.mcap"), "drone"); },
                          {"body 'drone' is missing", "rig, wand"});
  const Recording rig = Read(Path("bodies.mcap"), "rig"), wand = Read(Path("bodies.mcap"), "wand");
  ASSERT_EQ(rig.data.poses.size(), data.poses.size());
  EXPECT_EQ(rig.data.poses[9].p_WM, data.poses[9].p_WM);
  EXPECT_EQ(wand.data.poses[9].p_WM, data.poses[9].p_WM + Eigen::Vector3d(0, 0, 5));
  EXPECT_EQ(rig.info.marker_frame, "rig");
  EXPECT_EQ(rig.info.world_frame, "mocap");
  // Another body of the same topic is a pose sensor.
  RecordingRequest request;
  request.paths = {Path("bodies.mcap")};
  request.body = "rig";
  request.pose_sensors = "/poses:wand";
  const Recording both = ReadBag(request);
  EXPECT_EQ(both.data.poses[9].p_WM, rig.data.poses[9].p_WM);
  EXPECT_EQ(both.data.pose_sensors.at(0)[9].p_WM, wand.data.poses[9].p_WM);
  EXPECT_EQ(both.info.pose_sensors.at(0).topic, "/poses:wand");
  EXPECT_EQ(both.info.pose_sensors[0].frame, "wand");
  request.pose_sensors = "/poses:rig";
  ExpectError<InputError>([&] { ReadBag(request); }, {"pose_sensor '/poses:rig' is the marker"});
  request.pose_sensors = "/poses";
  ExpectError<InputError>([&] { ReadBag(request); }, {"choose with '/poses:BODY'"});
  write(false);
  EXPECT_EQ(Read(Path("bodies.mcap")).info.marker_frame, "rig");
  ExpectError<InputError>([&] { Read(Path("x.bag"), "rig"); },
                          {"body 'rig' is given", "holds one body"});
}

TEST_F(Ros2BagTest, TopicsInAnotherEncodingFitNoRole) {
  std::string bytes = ReadText(Convert({"none.mcap", "none"}));
  // The channels are written twice: among the messages and in the summary.
  for (size_t at = 0; (at = bytes.find(std::string("\3\0\0\0cdr", 7), at)) != std::string::npos;)
    bytes.replace(at + 4, 3, "xml");
  WriteBytes("xml.mcap", bytes);
  ExpectRefusal(Path("xml.mcap"), {"no topic of type", "/imu (sensor_msgs/Imu in xml, "});
}

TEST_F(Ros2BagTest, SimulatedBagsGiveTheSameCheck) {
  for (const char* format : {"bag", "mcap", "db3"}) {
    const std::string name = std::string("s.") + format;
    const Outcome outcome = Run("simulate_bag", name + " --duration 8 --format " + format);
    ASSERT_EQ(outcome.status, 0) << outcome.err;
    const Outcome check = Calibrate("--check " + name);
    EXPECT_EQ(check.status, 0) << check.err;
    WriteBytes(name + ".txt", check.out);
  }
  EXPECT_EQ(ReadText(Path("s.mcap.txt")), ReadText(Path("s.bag.txt")));
  EXPECT_EQ(ReadText(Path("s.db3.txt")), ReadText(Path("s.bag.txt")));
  const Outcome wrong = Run("simulate_bag", "s.bag --format mcap");
  EXPECT_TRUE(Contains(wrong.err, "ending in .mcap")) << wrong.err;
}

TEST_F(Ros2BagTest, ResultsGoBesideTheBag) {
  OfflineRequest request;
  for (const auto& [path, output] : {std::pair<std::string, std::string>{"a/x.mcap", "a/x"},
                                     {"a/x.db3.zstd", "a/x"},
                                     {"x.mcap.zstd", "x"}}) {
    request.paths = {path};
    EXPECT_EQ(OutputPath(request), output + ".calibration.yaml");
  }
  WriteFolder(Ros2Ways().front(), "[bag_0.mcap, bag_1.mcap]");
  EXPECT_EQ(Calibrate("bag --output bag/bag_0.mcap").status, 1);
  EXPECT_TRUE(Contains(ReadText(Path("err.txt")), "would replace the bag"))
      << ReadText(Path("err.txt"));
  EXPECT_EQ(Calibrate("bag --output bag/metadata.yaml").status, 1);
  EXPECT_TRUE(std::filesystem::exists(Path("bag/metadata.yaml")));
}

}  // namespace
}  // namespace imu_pose_calib
