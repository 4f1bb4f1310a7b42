// The live node with messages that the test itself publishes, much faster than real time.

#include <geometry_msgs/PoseStamped.h>
#include <gtest/gtest.h>
#include <ros/ros.h>
#include <sensor_msgs/Imu.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <map>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "live_util.h"

namespace imu_pose_calib {
namespace {

constexpr double kShort = 30.0;  // [s] more than any step but a long solve needs

SimulatorOptions Handheld(double duration_s) {
  SimulatorOptions options;
  options.duration_s = duration_s;
  return options;
}

geometry_msgs::PoseStamped ToPoseStamped(const PoseSample& sample, const std::string& frame) {
  geometry_msgs::PoseStamped pose;
  pose.header.stamp = FromNanoseconds(sample.t_ns);
  pose.header.frame_id = frame;
  pose.pose = ToPoseMsg({sample.q_WM, sample.p_WM});
  return pose;
}

/// Publishes the IMU and the poses for the node of a test, once that listens.
class Rig {
 public:
  explicit Rig(const std::string& name)
      : imu_(node_.advertise<sensor_msgs::Imu>("/" + name + "/imu", 0)),
        poses_(node_.advertise<geometry_msgs::PoseStamped>("/" + name + "/pose", 0)),
        parameters({"_imu_topic:=/" + name + "/imu", "_pose_topic:=/" + name + "/pose"}) {}

  void Publish(const SessionData& data) {
    ASSERT_TRUE(WaitFor(
        [&] { return imu_.getNumSubscribers() > 0 && poses_.getNumSubscribers() > 0; }, kShort));
    size_t gyro = 0;
    for (size_t k = 0; k < data.poses.size(); ++k) {
      PublishPose(data.poses[k]);
      for (; gyro < data.imus[0].gyro.size() * (k + 1) / data.poses.size(); ++gyro)
        PublishImu(data.imus[0].gyro[gyro], data.imus[0].accel[gyro]);
    }
  }
  void PublishImu(const ImuSample& gyro, const ImuSample& accel) {
    imu.header.stamp = FromNanoseconds(gyro.t_ns);
    imu.angular_velocity = ToVector3Msg(gyro.value);
    imu.linear_acceleration = ToVector3Msg(accel.value);
    imu_.publish(imu);
  }
  void PublishPose(const PoseSample& sample) { poses_.publish(ToPoseStamped(sample, world_frame)); }

 private:
  ros::NodeHandle node_;
  ros::Publisher imu_, poses_;

 public:
  const Arguments parameters;
  sensor_msgs::Imu imu;  ///< all but stamp and values
  std::string world_frame = "world";
};

tf2_msgs::TFMessage Link(const std::string& parent, const std::string& child) {
  tf2_msgs::TFMessage message;
  message.transforms.resize(1);
  message.transforms[0].header.stamp = ros::Time::now();
  message.transforms[0].header.frame_id = parent;
  message.transforms[0].child_frame_id = child;
  message.transforms[0].transform.rotation.w = 1.0;
  return message;
}

using LiveNodeFiles = TempDirTest;

void WaitUntilAllSaw(const ros::Publisher& publisher, uint32_t subscribers) {
  EXPECT_TRUE(WaitFor([&] { return publisher.getNumSubscribers() >= subscribers; }, kShort));
  ros::WallDuration(0.5).sleep();
}

/// What is asked for after a reset is never answered with what was solved before it, whether that
/// has ended by then or not: test_live_solver has each.
TEST(LiveNode, DoesNotAnswerWithASolveFromBeforeTheReset) {
  Rig rig("stale");
  Node node("stale", Concatenate(rig.parameters, {"_min_duration:=40"}));
  rig.Publish(Simulate(Handheld(60.0)));
  ASSERT_TRUE(WaitFor([&] { return node.status.solve_time > 0.0 || node.result; }, kShort))
      << node.status;
  EXPECT_TRUE(node.Call("reset").success);

  SimulatorOptions at_rest = Handheld(5.0);
  at_rest.motion = Motion::kStatic;
  at_rest.start_ns += 60'000'000'000;
  rig.Publish(Simulate(at_rest));
  ASSERT_TRUE(
      WaitFor([&] { return node.status.buffered > 4.0 && node.status.buffered < 6.0; }, kShort))
      << node.status;
  const auto calibrated = node.Call("calibrate");
  EXPECT_FALSE(calibrated.success) << calibrated;
}

/// As sensor_msgs/Imu has it, and as bags are read.
TEST(LiveNode, TakesACovarianceOfMinusOneForASensorThatIsNotThere) {
  Rig rig("absent");
  Node node("absent", rig.parameters);
  rig.imu.linear_acceleration_covariance[0] = -1.0;
  const SessionData data = Simulate(Handheld(2.0));
  rig.Publish(data);
  ASSERT_TRUE(WaitFor([&] { return node.status.gyro_count == data.imus[0].gyro.size(); }, kShort))
      << node.status;
  EXPECT_EQ(node.status.accel_count, 0u);
  EXPECT_EQ(node.status.phase, CalibrationStatus::WAITING);
  EXPECT_TRUE(Contains(node.status.message, "/absent/imu gives no accelerometer")) << node.status;
}

/// Not only of one that has never brought anything: of one that stopped, too, and after a reset.
TEST(LiveNode, SaysWhyATopicIsSilent) {
  Rig rig("silent");
  Node node("silent", rig.parameters);
  rig.Publish(Simulate(Handheld(2.0)));
  const auto says = [&](const std::string& text) { return Contains(node.status.message, text); };
  ASSERT_TRUE(WaitFor([&] { return says("no poses for"); }, kShort)) << node.status;
  EXPECT_TRUE(WaitFor(
      [&] { return says("/silent/pose (geometry_msgs/PoseStamped, publishers connected: 1)"); },
      kShort))
      << node.status;

  EXPECT_TRUE(node.Call("reset").success);
  EXPECT_TRUE(node.WaitForPhase(CalibrationStatus::WAITING)) << node.status;
  EXPECT_TRUE(WaitFor(
      [&] {
        return says("/silent/imu (sensor_msgs/Imu, publishers connected: 1): no message for");
      },
      kShort))
      << node.status;
}

/// Latched, it comes only once: before the frame of the IMU is known.
TEST(LiveNode, NoticesAnotherParentThatCameBeforeTheImu) {
  Rig rig("early");
  Node node("early", Concatenate(rig.parameters, {"_method:=gp"}));
  ros::NodeHandle handle;
  ros::Publisher tf = handle.advertise<tf2_msgs::TFMessage>("/tf_static", 1, true);
  tf.publish(Link("base_link", "early_imu"));
  WaitUntilAllSaw(tf, 1);
  rig.imu.header.frame_id = "early_imu";
  const SessionData data = Simulate(Handheld(15.0));
  rig.Publish(data);
  ASSERT_TRUE(node.WaitForResult());
  const auto warns = [&] {
    return Contains(node.status.message, "tf has another parent of early_imu, base_link");
  };
  EXPECT_TRUE(WaitFor(warns, kShort)) << node.status;

  // Nor does it come again after a reset.
  EXPECT_TRUE(node.Call("reset").success);
  ASSERT_TRUE(WaitFor([&] { return !warns(); }, kShort)) << node.status;
  rig.Publish(data);
  EXPECT_TRUE(WaitFor(warns, kShort)) << node.status;
}

TEST(LiveNode, ForgetsFramesWithTheReset) {
  Rig rig("frames");
  Node node("frames", Concatenate(rig.parameters, {"_method:=gp"}));
  rig.imu.header.frame_id = "frames_imu";
  const SessionData data = Simulate(Handheld(15.0));
  rig.Publish(data);
  ASSERT_TRUE(node.WaitForResult());
  ros::NodeHandle handle;
  ros::Publisher tf = handle.advertise<tf2_msgs::TFMessage>("/tf", 1);
  WaitUntilAllSaw(tf, 1);
  tf.publish(Link("gimbal", "frames_imu"));
  rig.world_frame = "map";
  rig.PublishPose(data.poses.back());
  const auto says = [&](const std::string& text) { return Contains(node.status.message, text); };
  EXPECT_TRUE(WaitFor([&] { return says("another parent") && says("were dropped"); }, kShort))
      << node.status;

  EXPECT_TRUE(node.Call("reset").success);
  node.result.reset();
  const uint64_t poses = node.status.pose_count;
  rig.Publish(data);
  ASSERT_TRUE(WaitFor([&] { return node.status.pose_count == poses + data.poses.size(); }, kShort))
      << node.status;
  ASSERT_TRUE(node.WaitForResult());
  EXPECT_TRUE(WaitFor([&] { return node.status.solve_time == 0.0; }, kShort));
  EXPECT_FALSE(says("another parent")) << node.status;
  EXPECT_FALSE(says("were dropped")) << node.status;
}

/// The second of three has nothing to say, and the third has a place in tf already. The marker is
/// found among the other topics.
TEST_F(LiveNodeFiles, OffersPoseSensors) {
  Rig rig("camera");
  ros::NodeHandle handle;
  ros::Publisher camera = handle.advertise<geometry_msgs::PoseStamped>("/camera/sensor", 0);
  Node node("camera", {rig.parameters[0], "_method:=gp", "_output:=" + Path("result.yaml"),
                       "_pose_sensor:=/camera/sensor /camera/silent tf:map:camera"});
  std::map<std::string, geometry_msgs::Transform> transforms;  // by child
  const ros::Subscriber tf = handle.subscribe<tf2_msgs::TFMessage>(
      "/tf_static", 100, [&](const tf2_msgs::TFMessage::ConstPtr& msg) {
        for (const auto& link : msg->transforms) transforms[link.child_frame_id] = link.transform;
      });
  ros::Publisher slam = handle.advertise<tf2_msgs::TFMessage>("/tf", 0);
  ASSERT_TRUE(WaitFor(
      [&] { return camera.getNumSubscribers() > 0 && slam.getNumSubscribers() > 0; }, kShort));
  SimulatorOptions options = Handheld(15.0);
  options.pose_sensors.resize(1);
  const SessionData data = Simulate(options);
  for (const PoseSample& pose : data.pose_sensors[0]) {
    camera.publish(ToPoseStamped(pose, "camera_world"));
    tf2_msgs::TFMessage link = Link("map", "camera");
    link.transforms[0].header.stamp = FromNanoseconds(pose.t_ns);
    link.transforms[0].transform = ToTransformMsg({pose.q_WM, pose.p_WM});
    slam.publish(link);
  }
  rig.Publish(data);
  ASSERT_TRUE(node.WaitForResult()) << node.status;
  ASSERT_TRUE(WaitFor([&] { return transforms.count("camera_sensor") > 0; }, kShort));
  const geometry_msgs::Vector3& p = transforms["camera_sensor"].translation;
  EXPECT_LT((Eigen::Vector3d(p.x, p.y, p.z) - options.pose_sensors[0].T_MS.p).norm(), 0.01);
  EXPECT_EQ(transforms.count("camera_silent") + transforms.count("camera"), 0u);
  EXPECT_TRUE(WaitFor([&] { return Contains(node.status.message, "/camera/silent (PoseStamped,"); },
                      kShort))
      << node.status;
  EXPECT_TRUE(node.Call("save").success);
  const StoredResult stored = LoadResult(Path("result.yaml"));
  EXPECT_EQ(stored.infos[0].pose_sensors.at(0).topic, "/camera/sensor");
  EXPECT_EQ(stored.infos[0].pose_sensors[0].world_frame, "camera_world");
  EXPECT_EQ(stored.result.pose_sensors[0].status, Status::kOk);
  EXPECT_EQ(stored.result.pose_sensors.at(1).status, Status::kDegenerate);
  EXPECT_EQ(stored.result.pose_sensors.at(2).status, Status::kOk);
  EXPECT_EQ(stored.infos[0].pose_sensors[2].frame, "camera");
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  testing::InitGoogleTest(&argc, argv);
  ros::init(argc, argv, "test_live_node");
  ros::NodeHandle keep_alive;
  return RUN_ALL_TESTS();
}
