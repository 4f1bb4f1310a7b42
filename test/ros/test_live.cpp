// The live node beside played bags and stand-ins for bridges, each test with processes of its own.

#include <diagnostic_msgs/DiagnosticArray.h>
#include <geometry_msgs/PoseStamped.h>
#include <gtest/gtest.h>
#include <nav_msgs/Path.h>
#include <std_srvs/SetBool.h>
#include <tf2_msgs/TFMessage.h>
#include <visualization_msgs/MarkerArray.h>
#include <yaml-cpp/yaml.h>

#include <fstream>
#include <map>
#include <optional>
#include <set>

#include "imu_pose_calib/ros/offline/offline.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "live_util.h"

namespace imu_pose_calib {
namespace {

/// rosbag play.
class Player {
 public:
  Player(const std::string& bag, const Arguments& options)
      : process_(Concatenate({"rosbag", "play", "--quiet", "--hz=200", "--queue=100000"},
                             Concatenate(options, {bag, "__name:=player"}))) {}

  bool IsPlaying() { return process_.IsRunning(); }
  void Pause(bool pause) {
    if (pause == is_paused_) return;
    std_srvs::SetBool service;
    service.request.data = pause;
    if (ros::service::call("/player/pause_playback", service)) is_paused_ = pause;
  }

 private:
  Process process_;
  bool is_paused_ = false;
};

Process Bridge(const std::string& style, const Arguments& options = {}) {
  return Process(Concatenate({IMU_POSE_CALIB_BIN_DIR "/replay_bridge", "__name:=" + style,
                              "_input:=/mocap/pose", "_style:=" + style},
                             options));
}

bool AnyContains(const std::set<std::string>& texts, const std::string& part) {
  return std::any_of(texts.begin(), texts.end(),
                     [&](const auto& text) { return Contains(text, part); });
}

Rigid3 ToRigid3(const geometry_msgs::Transform& transform) {
  const auto& q = transform.rotation;
  const auto& p = transform.translation;
  return {{q.w, q.x, q.y, q.z}, {p.x, p.y, p.z}};
}

/// Largest difference of two results, in sigma of the difference.
double Distance(const Calibration& a, const CalibrationResult& b) {
  Vector6d variance = a.imus[0].covariance.diagonal();
  for (Eigen::Index i = 0; i < 6; ++i) variance[i] += b.covariance[static_cast<size_t>(7 * i)];
  const Rigid3 T_MI = ToRigid3(b.transform);
  Vector6d difference;
  difference.head<3>() = T_MI.p - a.imus[0].T_MI.p;
  const Eigen::AngleAxisd turn(a.imus[0].T_MI.q.conjugate() * T_MI.q);
  difference.tail<3>() = turn.angle() * turn.axis();
  const double time_shift = std::abs(b.time_shift - a.sessions[0].imus[0].time_shift) /
                            std::hypot(a.sessions[0].imus[0].time_shift_std, b.time_shift_std);
  return std::max(time_shift, difference.cwiseAbs().cwiseQuotient(variance.cwiseSqrt()).maxCoeff());
}

/// Simulated bags; `use_sim_time` is that of the nodes started afterwards.
class Live : public TempDirTest {
 protected:
  void SetUp() override {
    TempDirTest::SetUp();
    ros::param::set("/use_sim_time", true);
    static_ = node_.subscribe<tf2_msgs::TFMessage>(
        "/tf_static", 100, [this](const tf2_msgs::TFMessage::ConstPtr& msg) {
          for (const auto& transform : msg->transforms)
            transforms_[transform.header.frame_id + " -> " + transform.child_frame_id] = transform;
        });
  }

  std::string Simulated(double duration_s) const {
    SimulatorOptions options = truth_;
    options.duration_s = duration_s;
    WriteBag(Path("simulated.bag"), Simulate(options), BagFormat());
    return Path("simulated.bag");
  }

  void ExpectTruth(const Node& node, double time_shift) const {
    ASSERT_TRUE(node.result);
    const Rigid3 T_MI = ToRigid3(node.result->transform);
    EXPECT_LT((T_MI.p - truth_.T_MI.p).norm(), 3e-3);
    EXPECT_LT(T_MI.q.angularDistance(truth_.T_MI.q), 3e-3);
    EXPECT_NEAR(node.result->time_shift, time_shift, 5e-4);
  }

  const SimulatorOptions truth_;
  ros::NodeHandle node_;
  ros::Subscriber static_;
  std::map<std::string, geometry_msgs::TransformStamped> transforms_;  ///< of /tf_static
};

/// Two IMUs on one body, with clocks of their own: one result and a static transform for each.
TEST_F(Live, CalibratesTwoImusTogether) {
  SimulatorOptions options = truth_;
  options.duration_s = 30.0;
  const std::string bag = Path("two.bag");
  WriteBag(bag, Simulate(options, 2), BagFormat());
  Node node("two", {"_imu_topic:=/imu /imu1", "_pose_topic:=/mocap/pose",
                    "_imu_frame:=two_imu0 two_imu1", "_min_duration:=8"});
  Player player(bag, {"--clock", "--rate=3", "--delay=2"});
  ASSERT_TRUE(WaitFor([&] { return node.result && node.result->imus.size() == 2; })) << node.status;
  ExpectTruth(node, truth_.time_shift_s);
  for (size_t i = 0; i < 2; ++i) {
    const SimulatorOptions truth = FurtherImu(options, i);
    const Rigid3 T_MI = ToRigid3(node.result->imus[i].transform);
    EXPECT_LT((T_MI.p - truth.T_MI.p).norm(), 3e-3);
    EXPECT_LT(T_MI.q.angularDistance(truth.T_MI.q), 3e-3);
    const std::string name = "marker -> two_imu" + std::to_string(i);
    ASSERT_TRUE(WaitFor([&] { return transforms_.count(name) > 0; })) << name;
    EXPECT_LT((ToRigid3(transforms_.at(name).transform).p - truth.T_MI.p).norm(), 3e-3);
  }
}

/// The sample at eight times real time. Playing waits for slow solves, and nothing gets lost: so
/// the last solve has the data of the offline one.
TEST_F(Live, AgreesWithOfflineOnTheSample) {
  const std::string sample = IMU_POSE_CALIB_SOURCE_DIR "/data/estimator_own_clocks.bag";
  OfflineRequest request;
  request.paths = {sample};
  request.output = Path("offline.yaml");
  const Calibration offline = CalibrateOffline(request).result;

  Node node("sample", {"_imu_topic:=/imu", "_pose_topic:=/vicon/rig/rig", "_window:=100",
                       "_output:=" + Path("live.yaml")});
  const Process bridge = Bridge("vicon_bridge", {"_latency:=0", "_jitter:=0"});
  Player player(sample, {"--clock", "--rate=8", "--delay=2"});
  ASSERT_TRUE(WaitFor([&] {
    player.Pause(node.status.solve_time > 0.5);
    return node.phases.count(CalibrationStatus::CONVERGED) > 0;
  })) << node.status;
  EXPECT_GE(node.status.solves, 3u);

  player.Pause(false);
  ASSERT_TRUE(WaitFor([&] {
    return node.status.pose_count == offline.sessions[0].poses.received &&
           node.status.gyro_count == offline.sessions[0].imus[0].gyro.received &&
           node.status.accel_count == offline.sessions[0].imus[0].accel.received &&
           node.status.solve_time == 0.0;
  })) << node.status;
  node.result.reset();
  EXPECT_TRUE(node.Call("calibrate").success);
  ASSERT_TRUE(node.WaitForResult()) << node.status;
  EXPECT_LT(Distance(offline, *node.result), 2.0) << *node.result << "\n" << offline.imus[0].T_MI.p;
  EXPECT_TRUE(node.Call("save").success);
  const YAML::Node yaml = YAML::LoadFile(Path("live.yaml"));
  EXPECT_EQ(yaml["frames"]["marker"].as<std::string>(), "vicon/rig/rig");
  EXPECT_EQ(yaml["time_shift"].as<double>(), node.result->time_shift);
}

/// Three bridges of one body and three nodes at once; two of the bridges lose the body for 5 s.
TEST_F(Live, CalibratesFromEveryBridge) {
  const std::string bag = Simulated(60.0);
  Node vicon("vicon", {"_imu_topic:=/imu", "_pose_topic:=/vicon/rig/rig", "_imu_frame:=imu_1"});
  Node vrpn("vrpn", {"_imu_topic:=/imu", "_pose_topic:=/vrpn_client_node/rig/pose",
                     "_marker_frame:=rig", "_imu_frame:=imu_2"});
  // from tf, where this bridge puts the body as well
  Node optitrack("optitrack", {"_imu_topic:=/imu", "_tf_parent:=world", "_tf_child:=rig/base_link",
                               "_imu_frame:=imu_3"});
  const Process vicon_bridge =
      Bridge("vicon_bridge", {"_latency:=0.002", "_loss_start:=20", "_loss_duration:=5"});
  const Process vrpn_bridge =
      Bridge("vrpn_client_ros", {"_latency:=0.004", "_loss_start:=20", "_loss_duration:=5"});
  const Process optitrack_bridge = Bridge("mocap_optitrack", {"_latency:=0.006"});
  int warnings = 0;
  const ros::Subscriber diagnostics = node_.subscribe<diagnostic_msgs::DiagnosticArray>(
      "/diagnostics", 100, [&](const diagnostic_msgs::DiagnosticArray::ConstPtr& msg) {
        for (const auto& status : msg->status)
          if (Contains(status.message, "degraded: no poses for"))
            warnings += status.level == diagnostic_msgs::DiagnosticStatus::WARN;
      });

  // The second of the imu frames has a parent already.
  ros::Publisher static_publisher = node_.advertise<tf2_msgs::TFMessage>("/tf_static", 1, true);
  tf2_msgs::TFMessage elsewhere;
  elsewhere.transforms.resize(1);
  elsewhere.transforms[0].header.frame_id = "base_link";
  elsewhere.transforms[0].child_frame_id = "imu_2";
  elsewhere.transforms[0].transform.rotation.w = 1.0;
  static_publisher.publish(elsewhere);

  Player player(bag, {"--clock", "--rate=5", "--delay=2"});
  EXPECT_TRUE(vicon.WaitForResult()) << vicon.status;
  EXPECT_TRUE(vrpn.WaitForResult()) << vrpn.status;
  EXPECT_TRUE(optitrack.WaitForResult()) << optitrack.status;
  EXPECT_TRUE(WaitFor([&] { return !player.IsPlaying(); }));

  ExpectTruth(vicon, truth_.time_shift_s + 0.002);
  ExpectTruth(vrpn, truth_.time_shift_s + 0.004);
  ExpectTruth(optitrack, truth_.time_shift_s + 0.006);
  EXPECT_TRUE(transforms_.count("vicon/rig/rig -> imu_1"));
  EXPECT_TRUE(transforms_.count("rig -> imu_2"));
  EXPECT_TRUE(transforms_.count("rig/base_link -> imu_3"));

  const std::string warning = "tf has another parent of imu_2, base_link";
  EXPECT_TRUE(WaitFor([&] { return Contains(vrpn.status.message, warning); })) << vrpn.status;
  EXPECT_FALSE(Contains(vicon.status.message, "another parent")) << vicon.status;

  EXPECT_TRUE(AnyContains(vicon.degraded, "no poses for"));
  EXPECT_TRUE(AnyContains(vrpn.degraded, "the marker is lost"));
  EXPECT_TRUE(optitrack.degraded.empty()) << *optitrack.degraded.begin();
  EXPECT_NE(vicon.status.phase, CalibrationStatus::DEGRADED) << vicon.status;
  EXPECT_NE(vrpn.status.phase, CalibrationStatus::DEGRADED) << vrpn.status;
  EXPECT_GT(warnings, 0);
}

/// In real time as well as with /clock, a node waits for its topics and can be told to start anew.
TEST_F(Live, WaitsForTopicsAndStartsAnewWhenAsked) {
  ros::param::set("/use_sim_time", false);
  const std::string bag = Simulated(100.0);
  Node node("late", {"_imu_topic:=/imu", "_pose_topic:=/mocap/pose"});
  ASSERT_TRUE(WaitFor([&] { return Contains(node.status.message, "nobody has published it"); }));
  EXPECT_EQ(node.status.phase, CalibrationStatus::WAITING);
  EXPECT_TRUE(Contains(node.status.message, "/imu")) << node.status;
  EXPECT_TRUE(Contains(node.status.message, "/mocap/pose")) << node.status;
  Node wrong("wrong", {"_imu_topic:=/rosout", "_pose_topic:=/mocap/pose"});
  const std::string mismatch = "/rosout is rosgraph_msgs/Log, must be sensor_msgs/Imu";
  EXPECT_TRUE(WaitFor([&] { return Contains(wrong.status.message, mismatch); })) << wrong.status;
  wrong.Kill();
  EXPECT_FALSE(node.Call("save").success);
  EXPECT_FALSE(node.Call("calibrate").success);
  EXPECT_TRUE(transforms_.empty());

  Player player(bag, {"--rate=5"});
  ASSERT_TRUE(WaitFor([&] { return node.status.buffered > 5.0; }));
  EXPECT_FALSE(node.result);
  EXPECT_TRUE(node.Call("reset").success);
  ASSERT_TRUE(WaitFor([&] { return node.status.buffered < 5.0; })) << node.status;

  std::optional<geometry_msgs::PoseStamped> pose;
  std::optional<nav_msgs::Path> path;
  std::set<std::string> markers;
  const std::vector<ros::Subscriber> subscribers = {
      node_.subscribe<geometry_msgs::PoseStamped>(
          node.prefix() + "imu_pose", 100,
          [&](const geometry_msgs::PoseStamped::ConstPtr& msg) { pose = *msg; }),
      node_.subscribe<nav_msgs::Path>(node.prefix() + "imu_path", 10,
                                      [&](const nav_msgs::Path::ConstPtr& msg) { path = *msg; }),
      node_.subscribe<visualization_msgs::MarkerArray>(
          node.prefix() + "markers", 10, [&](const visualization_msgs::MarkerArray::ConstPtr& msg) {
            for (const auto& marker : msg->markers) markers.insert(marker.ns);
          })};
  ASSERT_TRUE(node.WaitForResult()) << node.status;
  ExpectTruth(node, truth_.time_shift_s);
  ASSERT_TRUE(WaitFor([&] { return transforms_.count("marker -> imu") > 0; }));
  ASSERT_TRUE(WaitFor([&] { return pose && path && markers.count("lever arm") > 0; }));
  EXPECT_EQ(pose->header.frame_id, "world");
  EXPECT_GT(path->poses.size(), 10u);
  for (const char* name : {"world", "marker", "imu", "bars", "gravity", "sigma", "imu path"})
    EXPECT_TRUE(markers.count(name)) << name;

  const auto calibrated = node.Call("calibrate");
  EXPECT_TRUE(calibrated.success) << calibrated;
  EXPECT_TRUE(Contains(calibrated.message, "ok")) << calibrated;
}

TEST_F(Live, StartsAnewWhenTheBagDoes) {
  Node node("loop", {"_imu_topic:=/imu", "_pose_topic:=/mocap/pose"});
  Player player(Simulated(25.0), {"--clock", "--rate=5", "--loop", "--delay=2"});
  ASSERT_TRUE(node.WaitForResult()) << node.status;
  ASSERT_TRUE(WaitFor([&] { return AnyContains(node.degraded, "back"); })) << node.status;
  ASSERT_TRUE(WaitFor([&] { return node.status.solves == 0; })) << node.status;
  node.result.reset();
  ASSERT_TRUE(node.WaitForResult()) << node.status;
  ExpectTruth(node, truth_.time_shift_s);
}

TEST_F(Live, SurvivesBeingKilled) {
  const std::string bag = Simulated(120.0);
  // Noise and topic of the IMU come from its file; the topic of the poses is found.
  std::ofstream(Path("imu.yaml")) << "rostopic: /imu\n"
                                     "gyroscope_noise_density: 1.0e-4\n"
                                     "gyroscope_random_walk: 2.0e-5\n"
                                     "accelerometer_noise_density: 1.0e-3\n"
                                     "accelerometer_random_walk: 2.0e-4\n";
  Node node("phoenix", {"_output:=" + Path("phoenix.yaml"), "_imu_yaml:=" + Path("imu.yaml")});
  Player player(bag, {"--clock", "--rate=5", "--delay=2"});
  ASSERT_TRUE(WaitFor([&] { return node.status.buffered > 5.0; })) << node.status;
  node.Kill();
  node.status = CalibrationStatus();
  node.Start();
  ASSERT_TRUE(node.WaitForResult()) << node.status;
  ExpectTruth(node, truth_.time_shift_s);
  const auto saved = node.Call("save");
  EXPECT_TRUE(saved.success) << saved;
  EXPECT_TRUE(Contains(saved.message, Path("phoenix.yaml"))) << saved;
  ASSERT_TRUE(node.WaitForPhase(CalibrationStatus::SAVED));
  const YAML::Node yaml = YAML::LoadFile(Path("phoenix.yaml"));
  EXPECT_EQ(yaml["data"]["imu_topic"].as<std::string>(), "/imu");
  EXPECT_EQ(yaml["data"]["imu_yaml"].as<std::string>(), Path("imu.yaml"));
  EXPECT_EQ(yaml["options"]["gyro_noise_density"].as<double>(), 1e-4);
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  testing::InitGoogleTest(&argc, argv);
  ros::init(argc, argv, "test_live");
  ros::NodeHandle keep_alive;
  return RUN_ALL_TESTS();
}
