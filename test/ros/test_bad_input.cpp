// calibrate_bag on input that it must refuse: exit status, one line that says what is wrong and
// what to do, no result.

#include <geometry_msgs/PoseStamped.h>
#include <geometry_msgs/TransformStamped.h>
#include <rosbag/bag.h>
#include <sensor_msgs/Imu.h>
#include <tf2_msgs/TFMessage.h>

#include <functional>
#include <map>

#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "run_executable.h"

namespace imu_pose_calib {
namespace {

using Directory = std::filesystem::path;

struct BadInput {
  std::string name;
  /// Adds to a directory that holds x.bag (3 s, /imu and /mocap/pose) and tf.bag (the same poses on
  /// /tf: world -> base, fixed, then six joints to marker).
  std::function<void(const Directory&)> prepare;
  std::string arguments;
  int status;
  std::vector<std::string> parts;  ///< of the line on stderr
};

std::ostream& operator<<(std::ostream& stream, const BadInput& input) {
  return stream << input.name;
}

// --- Ways to prepare the directory ---

void Nothing(const Directory&) {}

std::function<void(const Directory&)> File(const std::string& name, const std::string& text) {
  return [=](const Directory& dir) { std::ofstream(dir / name, std::ios::binary) << text; };
}

std::function<void(const Directory&)> Folder(const std::string& name) {
  return [=](const Directory& dir) { std::filesystem::create_directory(dir / name); };
}

/// Changes the bytes of x.bag.
std::function<void(const Directory&)> Edit(const std::function<void(std::string*)>& edit) {
  return [=](const Directory& dir) {
    std::string text = ReadText((dir / "x.bag").string());
    edit(&text);
    std::ofstream(dir / "x.bag", std::ios::binary) << text;
  };
}

template <typename Msg>
Msg Stamped(double t, const std::string& frame) {
  Msg msg;
  msg.header.stamp = ros::Time(t);
  msg.header.frame_id = frame;
  return msg;
}

/// A message that is written to x.bag.
template <typename Msg>
std::function<void(const Directory&)> Message(const std::string& topic, double record_time,
                                              const Msg& msg) {
  return [=](const Directory& dir) {
    rosbag::Bag bag((dir / "x.bag").string(), rosbag::bagmode::Append);
    bag.write(topic, ros::Time(record_time), msg);
  };
}

constexpr double kStart = 1'600'000'000.0;  // [s] first record time of x.bag

sensor_msgs::Imu Imu(double gyro, double accel, double t = kStart) {
  auto msg = Stamped<sensor_msgs::Imu>(t, "imu");
  msg.angular_velocity.x = gyro;
  msg.linear_acceleration.x = accel;
  return msg;
}

geometry_msgs::TransformStamped Body(const std::string& name) {
  auto msg = Stamped<geometry_msgs::TransformStamped>(kStart, "world");
  msg.child_frame_id = name;
  msg.transform.rotation.w = 1.0;
  return msg;
}

/// A bag of its own.
std::function<void(const Directory&)> Bag(const std::function<void(rosbag::Bag*)>& write) {
  return [=](const Directory& dir) {
    rosbag::Bag bag((dir / "x.bag").string(), rosbag::bagmode::Write);
    write(&bag);
  };
}

template <typename Msg>
void Write(rosbag::Bag* bag, const std::string& topic, const Msg& msg) {
  bag->write(topic, ros::Time(kStart), msg);
}

const std::string kNoise =
    "gyroscope_noise_density: 1.0e-3\n"
    "gyroscope_random_walk: 1.0e-5\n"
    "accelerometer_noise_density: 1.0e-2\n"
    "accelerometer_random_walk: 1.0e-4\n";

// --- The table ---

const std::vector<BadInput> kUsage = {
    {"NoRecording", Nothing, "", 1, {"no recording is given: a bag, a folder, or the files"}},
    {"UnknownOption", Nothing, "x.bag --imu_topic /imu", 1, {"--imu_topic"}},
    {"ShortenedOption", Nothing, "x.bag --pose /p", 1, {"--pose"}},
    {"OptionWithoutValue", Nothing, "x.bag --output", 1, {"--output", "missing"}},
    {"OptionTwice", Nothing, "x.bag --start 1 --start 2", 1, {"--start", "more than once"}},
    {"StartIsNoNumber", Nothing, "x.bag --start abc", 1, {"'abc'", "--start"}},
    {"StartIsNan", Nothing, "x.bag --start nan", 1, {"start = nan s must be at least 0 s"}},
    {"StartIsNegative", Nothing, "x.bag --start=-1", 1, {"start = -1 s must be at least 0 s"}},
    {"StartBeyondTheEnd",
     Nothing,
     "x.bag --start 1000",
     1,
     {"start = 1000 s is beyond the end of the bag, which lasts 3.01 s"}},
    {"DurationIsNoNumber", Nothing, "x.bag --duration 5s", 1, {"'5s'", "--duration"}},
    {"DurationIsNegative",
     Nothing,
     "x.bag --duration=-2",
     1,
     {"duration = -2 s must be at least 0 s (0: all)"}},
    {"UnknownMethod", Nothing, "x.bag --method gpp", 1, {"method 'gpp'", "available: joint, gp"}},
    {"OutputIsTheBag",
     Nothing,
     "x.bag --output ./x.bag",
     1,
     {"output './x.bag' would replace the bag 'x.bag'; choose another"}},
    {"OutputIsTheConfig",
     File("c", "max_gap_s: 1.0\n"),
     "x.bag --config c --output ./c",
     1,
     {"output './c' would replace the config 'c'; choose another"}},
    {"OutputIsTheImuYaml",
     File("i", kNoise),
     "x.bag --imu-yaml i --output ./i",
     1,
     {"output './i' would replace the imu_yaml 'i'; choose another"}},
    {"OutputIsAnOldResultAsConfig",
     File("c", std::string(kResultHeader) + "\n"),
     "x.bag --config c --output c",
     1,
     {"output 'c' would replace the config 'c'"}},
    {"OutputIsALinkToTheConfig",
     [](const Directory& dir) {
       std::ofstream(dir / "c") << "max_gap_s: 1.0\n";
       std::filesystem::create_symlink("c", dir / "link");
     },
     "x.bag --config c --output link",
     1,
     {"output 'link' would replace the config 'c'"}},
    {"OutputIsTheNoiseOfAFolder",
     [](const Directory& dir) {
       WriteAslFolder((dir / "asl").string(), Simulate(ShortSimulation()));
       std::ofstream(dir / "asl/imu0/sensor.yaml") << kNoise;
     },
     "asl --output asl/imu0/sensor.yaml",
     1,
     {"output 'asl/imu0/sensor.yaml' would replace the imu_yaml 'asl/imu0/sensor.yaml'"}},
    {"OutputIsPartOfAFolder",
     [](const Directory& dir) {
       WriteAslFolder((dir / "asl").string(), Simulate(ShortSimulation()));
     },
     "asl --output asl/imu0/data.csv",
     1,
     {"output 'asl/imu0/data.csv' would replace the imu 'asl/imu0/data.csv'"}},
    {"MarkerIsImu",
     Nothing,
     "x.bag --marker-frame /imu",
     1,
     {"marker_frame and imu_frame are both 'imu'", "another name"}},
};

const std::vector<BadInput> kFiles = {
    {"MissingBag", Nothing, "no.bag", 1, {"bag 'no.bag' does not exist"}},
    {"MissingSecondBag", Nothing, "x.bag no.bag", 1, {"bag 'no.bag' does not exist"}},
    {"BagTwice", Nothing, "x.bag ./x.bag", 1, {"bag './x.bag' is given twice"}},
    {"FolderWithoutData", Folder("d.bag"), "d.bag", 1, {"folder 'd.bag' has no SENSOR/data.csv"}},
    {"PosesWithoutImu", Nothing, "--poses p.txt", 1, {"imu is missing"}},
    {"ImuWithoutPoses", Nothing, "--imu i.csv", 1, {"poses is missing"}},
    {"TextOfAllBesideABag",
     Nothing,
     "x.bag --poses p.txt --imu i.csv",
     1,
     {"leave out the bag 'x.bag'"}},
    {"PosesOfTextAndOfABag",
     Nothing,
     "x.bag --poses p.txt --pose-topic /p",
     1,
     {"poses names a text file", "pose_topic or tf of the bag 'x.bag'"}},
    {"ImuOfTextAndOfABag",
     Nothing,
     "x.bag --imu i.csv --imu-topic /imu",
     1,
     {"imu, gyro and accel name text files", "topics of the bag 'x.bag'"}},
    {"TopicOfText",
     Nothing,
     "--poses p.txt --imu i.csv --pose-topic /p",
     1,
     {"no topics and no tf; choose with poses"}},
    {"RecordTimeOfText", Nothing, "--poses p.txt --imu i.csv --record-time", 1, {"record_time"}},
    {"TextDoesNotExist",
     Nothing,
     "--poses p.txt --imu i.csv",
     1,
     {"'p.txt' cannot be read: No such file or directory"}},
    {"TextIsABag",
     Nothing,
     "--poses x.bag --imu x.bag --output y.yaml",
     1,
     {"'x.bag': line 2 is not text"}},
    {"TextIsDamaged",
     File("p.txt", "1 1 2 3 0 0 0 1\n2 1 2 3 0 0 O 1\n"),
     "--poses p.txt --imu i.csv",
     1,
     {"'p.txt': line 2 column qz is 'O', must be a number"}},
    {"OutputIsText",
     File("p.txt", "1 1 2 3 0 0 0 1\n"),
     "--poses p.txt --imu i.csv --output p.txt",
     1,
     {"output 'p.txt' would replace the poses 'p.txt'"}},
    {"BagIsEmptyFile", File("e.bag", ""), "e.bag", 1, {"'e.bag' is not a ROS 1 bag"}},
    {"BagIsText", File("t.bag", "t,x,y,z\n"), "t.bag", 1, {"'t.bag' is not a ROS 1 bag"}},
    {"BagOfAnotherVersion",
     Edit([](std::string* text) { text->replace(0, 13, "#ROSBAG V9.9\n"); }),
     "x.bag",
     1,
     {"bag 'x.bag' is of version 9.9, must be 2.0"}},
    {"BagWithoutMessages", Bag([](rosbag::Bag*) {}), "x.bag", 1, {"bag 'x.bag' holds no messages"}},
};

const std::vector<BadInput> kTopics = {
    {"NoSuchImuTopic",
     Nothing,
     "x.bag --imu-topic /foo",
     1,
     {"imu_topic '/foo' is not in x.bag; it has: /imu (sensor_msgs/Imu, 600), /mocap/pose "
      "(geometry_msgs/PoseStamped, 300)"}},
    {"NoSuchPoseTopic",
     Nothing,
     "x.bag --pose-topic /foo",
     1,
     {"pose_topic '/foo' is not in x.bag; it has: /imu"}},
    {"ImuTopicOfAnotherType",
     Nothing,
     "x.bag --imu-topic /mocap/pose",
     1,
     {"imu_topic '/mocap/pose' is geometry_msgs/PoseStamped, must be sensor_msgs/Imu"}},
    {"GyroTopicOfAnotherType",
     Nothing,
     "x.bag --gyro-topic /mocap/pose --accel-topic /imu",
     1,
     {"gyro_topic '/mocap/pose' is geometry_msgs/PoseStamped, must be sensor_msgs/Imu or "
      "geometry_msgs/Vector3Stamped"}},
    {"PoseTopicOfAnotherType",
     Nothing,
     "x.bag --pose-topic /imu",
     1,
     {"pose_topic '/imu' is sensor_msgs/Imu, must be geometry_msgs/PoseStamped or"}},
    {"GyroWithoutAccel", Nothing, "x.bag --gyro-topic /imu", 1, {"accel_topic is missing"}},
    {"ImuAndGyro",
     Nothing,
     "x.bag --imu-topic /imu --gyro-topic /imu --accel-topic /imu",
     1,
     {"either imu_topic, or gyro_topic and accel_topic"}},
    {"NoImu",
     Bag([](rosbag::Bag* bag) { Write(bag, "/body", Body("rig")); }),
     "x.bag",
     1,
     {"no topic of type sensor_msgs/Imu in x.bag; it has: /body"}},
    {"NoPoses",
     Bag([](rosbag::Bag* bag) { Write(bag, "/imu", Imu(0.1, 9.8)); }),
     "x.bag",
     1,
     {"no topic of type geometry_msgs/PoseStamped or", "it has: /imu (sensor_msgs/Imu, 1)"}},
    {"SeveralPoseTopics",
     Message("/body", kStart, Body("rig")),
     "x.bag",
     1,
     {"several pose topics: /body (geometry_msgs/TransformStamped, 1), /mocap/pose",
      "choose with pose_topic"}},
    {"SeveralImuTopics",
     Message("/imu2", kStart, Imu(0.1, 9.8)),
     "x.bag",
     1,
     {"several IMU topics: /imu (", "/imu2 (", "choose with imu_topic, or with gyro_topic"}},
    {"NameThatTheTerminalWouldObey",
     Message("/imu\x1b[2J", kStart, Imu(0.1, 9.8)),
     "x.bag",
     1,
     {"several IMU topics: /imu (", "/imu\\x1b[2J ("}},
    {"HalfAnImu",
     Message("/gyro", kStart, Imu(0.1, 0.0)),
     "x.bag --imu-topic /gyro",
     1,
     {"'/gyro' carries no linear acceleration"}},
    {"NoMessagesInTheSpan",
     Message("/late", kStart + 2.5, Body("rig")),
     "x.bag --pose-topic /late --duration 1",
     1,
     {"pose_topic '/late' has no messages within the span used (0 s to 1 s"}},
    {"NoStamps",
     Message("/unstamped", kStart, Imu(0.1, 9.8, 0.0)),
     "x.bag --imu-topic /unstamped",
     1,
     {"'/unstamped' has no header stamps", "record_time"}},
    {"TwoTypesOnOneTopic",
     Message("/imu", kStart, Body("rig")),
     "x.bag --imu-topic /imu",
     1,
     {"imu_topic '/imu' is geometry_msgs/TransformStamped and sensor_msgs/Imu, must be"}},
    {"VectorsOfUnknownMeaning",
     [](const Directory& dir) {
       WriteBag((dir / "x.bag").string(), Simulate(ShortSimulation()),
                {false, "PoseStamped", "Vector3Stamped"});
     },
     "x.bag",
     1,
     {"/imu/accel (geometry_msgs/Vector3Stamped", "with gyro_topic and accel_topic"}},
};

const std::vector<BadInput> kTf = {
    {"NoFrames",
     Nothing,
     "tf.bag",
     1,
     {"for poses from tf give tf_parent and tf_child", "world -> base (fixed), base -> joint1"}},
    {"OnlyOneFrame", Nothing, "tf.bag --tf-parent world", 1, {"tf_child is missing"}},
    {"FramesAndTopic",
     Nothing,
     "x.bag --tf-parent world --tf-child marker --pose-topic /mocap/pose",
     1,
     {"either pose_topic, or tf_parent and tf_child"}},
    {"TfAsPoseTopic",
     Nothing,
     "tf.bag --pose-topic /tf",
     1,
     {"is tf2_msgs/TFMessage; leave it empty; for poses from tf give tf_parent and tf_child, its"}},
    {"NoTf",
     Nothing,
     "x.bag --tf-parent world --tf-child marker",
     1,
     {"tf_parent 'world' is not in tf, which has: nothing"}},
    {"UnknownFrame",
     Nothing,
     "tf.bag --tf-parent world --tf-child tool",
     1,
     {"tf_child 'tool' is not in tf, which has: world -> base"}},
    {"FixedFrames",
     Nothing,
     "tf.bag --tf-parent world --tf-child base",
     1,
     {"tf_parent 'world' and tf_child 'base' are fixed to each other"}},
    {"UnconnectedFrames",
     [](const Directory& dir) {
       tf2_msgs::TFMessage msg;
       msg.transforms = {Body("other")};
       msg.transforms[0].header.frame_id = "elsewhere";
       rosbag::Bag bag((dir / "tf.bag").string(), rosbag::bagmode::Append);
       bag.write("/tf", ros::Time(kStart), msg);
     },
     "tf.bag --tf-parent world --tf-child other",
     1,
     {"tf_parent 'world' and tf_child 'other' are not connected in tf, which has: world -> base"}},
};

const std::vector<BadInput> kConfig = {
    {"MissingConfig", Nothing, "x.bag --config no.yaml", 1, {"config 'no.yaml': cannot be read"}},
    {"ConfigIsADirectory", Folder("c"), "x.bag --config c", 1, {"config 'c': is a directory"}},
    {"ConfigIsNoMap", File("c", "- 1\n"), "x.bag --config c", 1, {"must be a map"}},
    {"ConfigIsNoYaml", File("c", "a: [1\n"), "x.bag --config c", 1, {"config 'c': line "}},
    {"KeyThatTheTerminalWouldObey",
     File("c", "\"\\e[2J\": 1.0\n"),
     "x.bag --config c",
     1,
     {"there is no option '\\x1b[2J'"}},
    {"UnknownKey",
     File("c", "max_gaps: 1.0\n"),
     "x.bag --config c",
     1,
     {"config 'c': there is no option 'max_gaps'; did you mean 'max_gap_s'?"}},
    {"KeyTwice",
     File("c", "max_gap_s: 1.0\nmax_gap_s: 2.0\n"),
     "x.bag --config c",
     1,
     {"option 'max_gap_s' is given twice"}},
    {"WrongType",
     File("c", "max_gap_s: long\n"),
     "x.bag --config c",
     1,
     {"option max_gap_s must be a number, not long"}},
    {"WrongLength",
     File("c", "initial_translation: [1, 2]\n"),
     "x.bag --config c",
     1,
     {"option initial_translation must be [x, y, z], not [1, 2]"}},
    {"OutOfRange",
     File("c", "max_bad_fraction: 2.0\n"),
     "x.bag --config c",
     1,
     {"config 'c': option max_bad_fraction = 2 is out of range: must be within [0, 1]"}},
    {"MissingImuYaml",
     Nothing,
     "x.bag --imu-yaml no.yaml",
     1,
     {"imu_yaml 'no.yaml': cannot be read"}},
    {"ImuYamlWithoutKey",
     File("i", "rostopic: /imu\n"),
     "x.bag --imu-yaml i",
     1,
     {"imu_yaml 'i': gyroscope_noise_density is missing"}},
    {"ImuYamlUnknownKey",
     File("i", kNoise + "topic: /imu\n"),
     "x.bag --imu-yaml i",
     1,
     {"imu_yaml 'i': there is no key 'topic'; did you mean 'rostopic'?"}},
    {"ImuYamlOutOfRange",
     File("i", kNoise + "update_rate: -1\n"),
     "x.bag --imu-yaml i",
     1,
     {"imu_yaml 'i': update_rate = -1.0 is out of range: must be within [0.001, 1000000.0]"}},
};

const std::vector<BadInput> kData = {
    {"TooShort",
     Nothing,
     "x.bag",
     2,
     {"pose", "span 2.99 s", "at least 5 s); record 30 s or more"}},
    {"FewPoses", Message("/body", kStart, Body("rig")), "x.bag --pose-topic /body", 2, {"pose"}},
};

class BadInputTest : public ExecutableTest, public ::testing::WithParamInterface<BadInput> {
 protected:
  void SetUp() override {
    ExecutableTest::SetUp();
    const SessionData data = Simulate(ShortSimulation());
    WriteBag(Path("x.bag"), data, {});
    WriteBag(Path("tf.bag"), data, {false, "tf"});
  }

  /// The texts of the files by their paths, without those that hold what was printed.
  std::map<std::string, std::string> Files() const {
    std::map<std::string, std::string> files;
    for (const auto& entry : std::filesystem::recursive_directory_iterator(dir_))
      files[entry.path()] = entry.is_regular_file() ? ReadText(entry.path()) : "";
    files.erase(Path("out.txt"));
    files.erase(Path("err.txt"));
    return files;
  }
};

TEST_P(BadInputTest, IsRefusedInOneLineAndChangesNoFile) {
  GetParam().prepare(dir_);
  const auto before = Files();
  ExpectFailure(GetParam().arguments, GetParam().status, GetParam().parts);
  EXPECT_TRUE(Files() == before);
}

std::string Name(const ::testing::TestParamInfo<BadInput>& info) { return info.param.name; }

INSTANTIATE_TEST_SUITE_P(Usage, BadInputTest, ::testing::ValuesIn(kUsage), Name);
INSTANTIATE_TEST_SUITE_P(Files, BadInputTest, ::testing::ValuesIn(kFiles), Name);
INSTANTIATE_TEST_SUITE_P(Topics, BadInputTest, ::testing::ValuesIn(kTopics), Name);
INSTANTIATE_TEST_SUITE_P(Tf, BadInputTest, ::testing::ValuesIn(kTf), Name);
INSTANTIATE_TEST_SUITE_P(Config, BadInputTest, ::testing::ValuesIn(kConfig), Name);
INSTANTIATE_TEST_SUITE_P(Data, BadInputTest, ::testing::ValuesIn(kData), Name);

}  // namespace
}  // namespace imu_pose_calib
