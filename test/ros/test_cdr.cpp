// Messages of ROS 2, put together here byte by byte from the layouts of their definitions.

#include <tf2_msgs/TFMessage.h>

#include <cstring>

#include "imu_pose_calib/ros/io/bags.h"
#include "imu_pose_calib/ros/io/cdr.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

template <typename Msg>
Msg FromCdr(std::string_view message) {
  MessageInput input(message, /*is_cdr=*/true);
  Msg msg;
  input.next(msg);
  input.Finish();
  return msg;
}

/// Fields in the order in which they are given; CDR is the same in both orders of bytes.
class Bytes {
 public:
  explicit Bytes(bool is_little) : is_little_(is_little) {}

  template <typename T>
  Bytes& Put(T value) {
    while (fields_.size() % sizeof(T) != 0) fields_ += '\x55';  // whatever fills the place
    char bytes[sizeof(T)];
    std::memcpy(bytes, &value, sizeof(T));
    if (!is_little_) std::reverse(bytes, bytes + sizeof(T));
    fields_.append(bytes, sizeof(T));
    return *this;
  }
  Bytes& Doubles(std::initializer_list<double> values) {
    for (const double value : values) Put(value);
    return *this;
  }
  Bytes& Doubles(int count, double first) {
    for (int k = 0; k < count; ++k) Put(first + k);
    return *this;
  }
  Bytes& Text(const std::string& text) {
    Put(static_cast<uint32_t>(text.size() + 1));
    fields_.append(text.c_str(), text.size() + 1);
    return *this;
  }
  Bytes& Header(int32_t sec, uint32_t nanosec, const std::string& frame) {
    return Put(sec).Put(nanosec).Text(frame);
  }
  std::string Message() const {
    return std::string(1, '\0') + (is_little_ ? '\1' : '\0') + std::string(2, '\0') + fields_;
  }

 private:
  bool is_little_;
  std::string fields_;
};

/// Runs a test in both orders of bytes.
class CdrTest : public ::testing::TestWithParam<bool> {
 protected:
  Bytes Begin() const { return Bytes(GetParam()); }

  /// Decodes, after it has seen that no shorter message and none much longer is one.
  template <typename Msg>
  static Msg Decode(const std::string& message) {
    for (size_t size = 0; size < message.size(); ++size)
      EXPECT_THROW(FromCdr<Msg>(message.substr(0, size)), InputError) << size;
    EXPECT_NO_THROW(FromCdr<Msg>(message + std::string(3, '\0')));  // fills the last four bytes
    EXPECT_THROW(FromCdr<Msg>(message + std::string(4, '\0')), InputError);
    return FromCdr<Msg>(message);
  }
};

INSTANTIATE_TEST_SUITE_P(BothOrders, CdrTest, ::testing::Bool());

TEST_P(CdrTest, Imu) {
  const auto msg = Decode<sensor_msgs::Imu>(Begin()
                                                .Header(12, 345678901, "imu")
                                                .Doubles({1, 2, 3, 4})
                                                .Doubles(9, 10)
                                                .Doubles({20, 21, 22})
                                                .Doubles(9, 30)
                                                .Doubles({40, 41, 42})
                                                .Doubles(9, 50)
                                                .Message());
  EXPECT_EQ(msg.header.stamp, ros::Time(12, 345678901));
  EXPECT_EQ(msg.header.frame_id, "imu");
  EXPECT_EQ(msg.orientation.w, 4.0);
  EXPECT_EQ(msg.orientation_covariance[8], 18.0);
  EXPECT_EQ(msg.angular_velocity.y, 21.0);
  EXPECT_EQ(msg.angular_velocity_covariance[0], 30.0);
  EXPECT_EQ(msg.linear_acceleration.z, 42.0);
  EXPECT_EQ(msg.linear_acceleration_covariance[8], 58.0);
}

TEST_P(CdrTest, Odometry) {
  const auto msg = Decode<nav_msgs::Odometry>(Begin()
                                                  .Header(1, 2, "odom")
                                                  .Text("base_link")
                                                  .Doubles(7, 1)
                                                  .Doubles(36, 100)
                                                  .Doubles(6, 200)
                                                  .Doubles(36, 300)
                                                  .Message());
  EXPECT_EQ(msg.child_frame_id, "base_link");
  EXPECT_EQ(msg.pose.pose.position.z, 3.0);
  EXPECT_EQ(msg.pose.pose.orientation.w, 7.0);
  EXPECT_EQ(msg.pose.covariance[35], 135.0);
  EXPECT_EQ(msg.twist.twist.angular.z, 205.0);
  EXPECT_EQ(msg.twist.covariance[35], 335.0);
}

TEST_P(CdrTest, PosesAndVectors) {
  const auto pose =
      Decode<geometry_msgs::PoseStamped>(Begin().Header(1, 2, "map").Doubles(7, 1).Message());
  EXPECT_EQ(pose.pose.position.x, 1.0);
  EXPECT_EQ(pose.pose.orientation.x, 4.0);
  const auto uncertain = Decode<geometry_msgs::PoseWithCovarianceStamped>(
      Begin().Header(1, 2, "").Doubles(7, 1).Doubles(36, 10).Message());
  EXPECT_EQ(uncertain.header.frame_id, "");
  EXPECT_EQ(uncertain.pose.covariance[35], 45.0);
  const auto vector = Decode<geometry_msgs::Vector3Stamped>(
      Begin().Header(1, 2, "imu_link").Doubles(3, 7).Message());
  EXPECT_EQ(vector.vector.z, 9.0);
}

TEST_P(CdrTest, Transforms) {
  Bytes bytes = Begin();
  bytes.Put(uint32_t{2});
  for (const char* child : {"a", "base"}) bytes.Header(5, 6, "map").Text(child).Doubles(7, 1);
  const auto msg = Decode<tf2_msgs::TFMessage>(bytes.Message());
  ASSERT_EQ(msg.transforms.size(), 2u);
  EXPECT_EQ(msg.transforms[1].child_frame_id, "base");
  EXPECT_EQ(msg.transforms[1].transform.translation.x, 1.0);
  EXPECT_EQ(msg.transforms[1].transform.rotation.w, 7.0);
}

/// What ReadBodies() makes of a message of a type.
std::vector<FramedPose> Bodies(const std::string& type, const std::string& message) {
  const std::string topic = "/bodies";
  return ReadBodies(BagMessage{topic, type, ros::Time(1), message});
}

TEST_P(CdrTest, RigidBodies) {
  Bytes bytes = Begin();
  bytes.Header(7, 8, "world").Put(uint32_t{99}).Put(uint32_t{2});
  bytes.Text("drone").Put(uint32_t{2});
  for (const char* marker : {"m1", "left"})
    bytes.Put(int8_t{1}).Put(int32_t{-4}).Text(marker).Doubles({0.1, 0.2, 0.3});
  bytes.Doubles(7, 1);
  bytes.Text("wand").Put(uint32_t{0}).Doubles(7, 11);
  const std::string type = "mocap4r2_msgs/RigidBodies";
  const auto bodies = Bodies(type, bytes.Message());
  ASSERT_EQ(bodies.size(), 2u);
  EXPECT_EQ(bodies[0].marker_frame, "drone");
  EXPECT_EQ(bodies[0].world_frame, "world");
  EXPECT_EQ(bodies[0].pose.t_ns, 7'000'000'008);
  EXPECT_EQ(bodies[1].marker_frame, "wand");
  EXPECT_EQ(bodies[1].pose.p_WM, Eigen::Vector3d(11, 12, 13));
  EXPECT_EQ(bodies[1].pose.q_WM.coeffs(), Eigen::Vector4d(14, 15, 16, 17));
  const std::string whole = bytes.Message();
  ExpectError<InputError>([&] { Bodies(type, whole.substr(0, whole.size() - 1)); },
                          {"'/bodies'", "1000000000 ns", "RigidBodies", "too few"});
}

TEST_P(CdrTest, NamedPoses) {
  const auto bodies =
      Bodies("motion_capture_tracking_interfaces/NamedPoseArray",
             Begin().Header(7, 8, "mocap").Put(uint32_t{1}).Text("cf1").Doubles(7, 1).Message());
  ASSERT_EQ(bodies.size(), 1u);
  EXPECT_EQ(bodies[0].marker_frame, "cf1");
  EXPECT_EQ(bodies[0].pose.q_WM.w(), 7.0);
}

TEST_P(CdrTest, RefusesLengthsThatAreNotThere) {
  for (const uint32_t length : {1000u, 0x7fffffffu, 0xffffffffu}) {
    const std::string text = Begin().Put(int32_t{1}).Put(uint32_t{2}).Put(length).Message();
    ExpectError<InputError>([&] { FromCdr<geometry_msgs::PoseStamped>(text + "abc"); },
                            {std::to_string(length), "only 3 bytes are left"});
    ExpectError<InputError>([&] { FromCdr<tf2_msgs::TFMessage>(Begin().Put(length).Message()); },
                            {std::to_string(length), "only 0 bytes are left"});
  }
}

TEST_P(CdrTest, RefusesANegativeStamp) {
  ExpectError<InputError>(
      [&] {
        FromCdr<geometry_msgs::PoseStamped>(Begin().Header(-1, 0, "m").Doubles(7, 1).Message());
      },
      {"-1 s", "negative"});
}

TEST(CdrEncodingTest, RefusesOthersByName) {
  for (const int kind : {2, 3, 6, 7, 8, 9, 10, 11}) {
    const std::string message =
        std::string("\0", 1) + static_cast<char>(kind) + std::string(60, '\0');
    char name[8];
    std::snprintf(name, sizeof(name), "00 %02x", static_cast<unsigned>(kind));
    ExpectError<InputError>([&] { FromCdr<geometry_msgs::Vector3Stamped>(message); },
                            {name, kind >= 6 ? "XCDR2" : "must be 00 00 or 00 01"});
  }
}

TEST(CdrEncodingTest, WritesTheLayout) {
  geometry_msgs::TransformStamped msg;
  msg.header.stamp = ros::Time(3, 4);
  msg.header.frame_id = "w";
  msg.child_frame_id = "abc";
  msg.transform.rotation.w = 1.0;
  const std::string expected =
      Bytes(true).Header(3, 4, "w").Text("abc").Doubles({0, 0, 0, 0, 0, 0, 1}).Message();
  std::string written = ToCdr(msg);
  EXPECT_EQ(written.size(), expected.size());
  // Two places are filled up: after "w" with its 0, and after "abc" with its 0.
  EXPECT_EQ(FromCdr<geometry_msgs::TransformStamped>(written), msg);
  EXPECT_EQ(FromCdr<geometry_msgs::TransformStamped>(expected), msg);
  msg.header.stamp.sec = 0x80000000u;
  ExpectError<InputError>([&] { ToCdr(msg); }, {"2147483648 s", "at most 2147483647 s"});
}

/// Encoded by ROS itself.
TEST(Ros1, MessagesAreReadWhole) {
  tf2_msgs::TFMessage msg;
  msg.transforms.resize(2);
  msg.transforms[1].header.seq = 7;
  msg.transforms[1].header.stamp = ros::Time(4'000'000'000, 5);  // beyond those of ROS 2
  msg.transforms[1].header.frame_id = "world";
  msg.transforms[1].child_frame_id = "marker";
  msg.transforms[1].transform.rotation.w = 0.5;
  std::string text(ros::serialization::serializationLength(msg), '\0');
  ros::serialization::OStream stream(reinterpret_cast<uint8_t*>(text.data()),
                                     static_cast<uint32_t>(text.size()));
  ros::serialization::serialize(stream, msg);
  const auto read = [](const std::string& bytes) {
    MessageInput input(bytes, /*is_cdr=*/false);
    tf2_msgs::TFMessage found;
    input.next(found);
    input.Finish();
    return found;
  };
  EXPECT_EQ(read(text), msg);
  for (size_t size = 0; size < text.size(); ++size)
    EXPECT_THROW(read(text.substr(0, size)), InputError) << size;
  EXPECT_THROW(read(text + "x"), InputError);
  text.replace(0, 4, "\xff\xff\xff\x7f");
  ExpectError<InputError>([&] { read(text); }, {"a length in it is 2147483647, but only"});
}

}  // namespace
}  // namespace imu_pose_calib
