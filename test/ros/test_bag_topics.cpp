// Which topics of a bag are read, and when it says that it cannot choose.

#include <std_msgs/String.h>
#include <topic_tools/shape_shifter.h>

#include "record_bag.h"

namespace imu_pose_calib {
namespace {

using BagTopicsTest = BagReaderTest;

// --- Choices ---

TEST_F(BagTopicsTest, TheUsualImuIsTakenWhenItIsThere) {
  Record().Add("/imu1", Imu(1, 9.8)).Add("/imu2", Imu(2, 9.8)).Add("/pose", Pose());
  RecordingRequest request = Request();
  request.usual_imu_topic = "/imu2";
  EXPECT_EQ(ReadBag(request).info.imus[0].imu_topic, "/imu2");
  request.imu_topic = "/imu1";
  EXPECT_EQ(ReadBag(request).info.imus[0].imu_topic, "/imu1");
  request.imu_topic = "";
  request.usual_imu_topic = "/imu3";
  ExpectRefusal(request, {"several IMU topics"});
}

TEST_F(BagTopicsTest, TellsASplitImuByItsZerosAlone) {
  Record().Add("/a", Imu(0, 9.8)).Add("/b", Imu(0.1, 0)).Add("/pose", Pose());
  const Recording recording = ReadBag(Request());
  EXPECT_EQ(recording.info.imus[0].gyro_topic, "/b");
  EXPECT_EQ(recording.info.imus[0].accel_topic, "/a");
}

TEST_F(BagTopicsTest, TellsASplitImuByItsCovarianceAlone) {
  sensor_msgs::Imu gyro = Imu(0.1, 9.8), accel = Imu(0.1, 9.8);
  gyro.linear_acceleration_covariance[0] = -1;
  accel.angular_velocity_covariance[0] = -1;
  Record().Add("/a", accel).Add("/b", gyro).Add("/pose", Pose());
  EXPECT_EQ(ReadBag(Request()).info.imus[0].gyro_topic, "/b");
}

TEST_F(BagTopicsTest, PassesOverAnImuThatCarriesNothing) {
  Record().Add("/idle", Imu(0, 0)).Add("/imu", Imu(0.1, 9.8)).Add("/pose", Pose());
  EXPECT_EQ(ReadBag(Request()).info.imus[0].imu_topic, "/imu");
}

TEST_F(BagTopicsTest, NamedTopicsWinOverOthers) {
  Record()
      .Add("/imu1", Imu(1, 9.8))
      .Add("/imu2", Imu(2, 9.8))
      .Add("/pose1", Pose())
      .Add("/pose2", Transform("rig"));
  RecordingRequest request = Request();
  request.imu_topic = "/imu2";
  request.pose_topic = "/pose2";
  const Recording recording = ReadBag(request);
  EXPECT_EQ(recording.data.imus[0].gyro.at(0).value.x(), 2.0);
  EXPECT_EQ(recording.info.marker_frame, "rig");

  request.imu_topic = "";
  request.gyro_topic = "/imu1";
  request.accel_topic = "/imu2";
  EXPECT_EQ(ReadBag(request).data.imus[0].gyro.at(0).value.x(), 1.0);
  EXPECT_EQ(ReadBag(request).info.imus[0].accel_topic, "/imu2");
}

// --- Refusals ---

TEST_F(BagTopicsTest, RefusesATopicThatIsNotThere) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/mocap/pose", Pose()).Add("/mocap/pose", Pose());
  RecordingRequest request = Request();
  request.imu_topic = "/foo";
  ExpectRefusal(request,
                {"imu_topic '/foo' is not in recording.bag; it has: /imu (sensor_msgs/Imu, 1), "
                 "/mocap/pose (geometry_msgs/PoseStamped, 2)"});
  request = Request();
  request.pose_topic = "/bar";
  ExpectRefusal(request, {"pose_topic '/bar' is not in recording.bag"});
}

TEST_F(BagTopicsTest, RefusesATopicOfTheWrongType) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", Pose());
  RecordingRequest request = Request();
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

TEST_F(BagTopicsTest, RefusesABagWithoutImuOrPoses) {
  std_msgs::String text;
  Record().Add("/pose", Pose()).Add("/chatter", text);
  ExpectRefusal(Request(), {"no topic of type sensor_msgs/Imu", "/chatter (std_msgs/String, 1)"});
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/chatter", text);
  ExpectRefusal(Request(),
                {"no topic of type geometry_msgs/PoseStamped", "/chatter (std_msgs/String, 1)"});
}

TEST_F(BagTopicsTest, RefusesToChooseBetweenPoseTopics) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/p1", Pose()).Add("/p2", Transform("rig"));
  ExpectRefusal(Request(), {"/p1 (geometry_msgs/PoseStamped, 1)",
                            "/p2 (geometry_msgs/TransformStamped, 1)", "choose with pose_topic"});
}

TEST_F(BagTopicsTest, RefusesToChooseBetweenImus) {
  Record().Add("/imu1", Imu(0.1, 9.8)).Add("/imu2", Imu(0.1, 9.8)).Add("/pose", Pose());
  ExpectRefusal(Request(), {"/imu1 (sensor_msgs/Imu, 1)", "/imu2", "imu_topic", "gyro_topic"});
}

TEST_F(BagTopicsTest, RefusesToChooseBetweenAWholeAndASplitImu) {
  Record()
      .Add("/imu", Imu(0.1, 9.8))
      .Add("/gyro", Imu(0.1, 0))
      .Add("/accel", Imu(0, 9.8))
      .Add("/pose", Pose());
  ExpectRefusal(Request(), {"/imu (", "/gyro (", "/accel (", "choose"});
}

TEST_F(BagTopicsTest, ShowsNamesWithoutControlCharacters) {
  topic_tools::ShapeShifter odd;
  odd.morph("*", "odd/\x07Type", "", "");
  Record().Add("/\x1b[2J\xff", Imu(0.1, 9.8)).Add("/imu", Imu(0.1, 9.8)).Add("/odd", odd);
  ExpectRefusal(Request(), {"several IMU topics: /\\x1b[2J\\xff (sensor_msgs/Imu, 1), /imu"});
  RecordingRequest request = Request();
  request.imu_topic = "/imu";
  ExpectRefusal(request, {"/\\x1b[2J\\xff (sensor_msgs/Imu, 1)", "/odd (odd/\\x07Type, 1)"});

  Record().Add("/imu", Imu(0.1, 9.8)).Add("/p", Transform("\x1b[2J")).Add("/p", Transform("b"));
  ExpectRefusal(Request(), {"'map' -> '\\x1b[2J' and 'map' -> 'b'"});
  // the data keep the names as they are
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/p", Transform("\x1b[2J"));
  EXPECT_EQ(ReadBag(Request()).info.marker_frame, "\x1b[2J");
}

TEST_F(BagTopicsTest, RefusesHalfAnImu) {
  Record().Add("/gyro", Imu(0.1, 0)).Add("/pose", Pose());
  ExpectRefusal(Request(), {"'/gyro' carries no linear acceleration"});
  Record().Add("/accel", Imu(0, 9.8)).Add("/pose", Pose());
  ExpectRefusal(Request(), {"'/accel' carries no angular velocity"});
}

TEST_F(BagTopicsTest, RefusesContradictingImuTopics) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", Pose());
  RecordingRequest request = Request();
  request.gyro_topic = "/imu";
  ExpectRefusal(request, {"accel_topic is missing"});
  request.accel_topic = request.imu_topic = "/imu";
  ExpectRefusal(request, {"either imu_topic, or gyro_topic and accel_topic"});
}

TEST_F(BagTopicsTest, RefusesMessagesWithoutStamps) {
  sensor_msgs::Imu imu = Imu(0.1, 9.8);
  imu.header.stamp = ros::Time();
  Record().Add("/imu", imu).Add("/pose", Pose());
  ExpectRefusal(Request(), {"'/imu' has no header stamps"});
  geometry_msgs::PoseStamped pose = Pose();
  pose.header.stamp = ros::Time();
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/pose", pose);
  ExpectRefusal(Request(), {"'/pose' has no header stamps"});
}

TEST_F(BagTopicsTest, RefusesPosesOfSeveralBodies) {
  Record().Add("/imu", Imu(0.1, 9.8)).Add("/poses", Transform("a")).Add("/poses", Transform("b"));
  ExpectRefusal(Request(), {"pose_topic '/poses'", "'a'", "'b'"});
}

}  // namespace
}  // namespace imu_pose_calib
