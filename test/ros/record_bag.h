#pragma once

#include <geometry_msgs/PoseStamped.h>
#include <geometry_msgs/TransformStamped.h>
#include <rosbag/bag.h>
#include <sensor_msgs/Imu.h>

#include "imu_pose_calib/ros/io/recording.h"
#include "test_util.h"

namespace imu_pose_calib {

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

inline sensor_msgs::Imu Imu(double gyro_x, double accel_x) {
  sensor_msgs::Imu msg;
  msg.header.stamp = ros::Time(50, 1);
  msg.header.frame_id = "/imu_link";
  msg.angular_velocity.x = gyro_x;
  msg.linear_acceleration.x = accel_x;
  return msg;
}

inline geometry_msgs::PoseStamped Pose() {
  geometry_msgs::PoseStamped msg;
  msg.header.stamp = ros::Time(60, 123456789);
  msg.header.frame_id = "/map";
  msg.pose.orientation.w = 1.0;
  return msg;
}

inline geometry_msgs::TransformStamped Transform(const std::string& child) {
  geometry_msgs::TransformStamped msg;
  msg.header.stamp = ros::Time(60, 123456789);
  msg.header.frame_id = "map";
  msg.child_frame_id = child;
  msg.transform.rotation.w = 1.0;
  return msg;
}

/// Tests of ReadBag() on recording.
class BagReaderTest : public TempDirTest {
 protected:
  RecordingRequest Request() const {
    RecordingRequest request;
    request.paths = {Path("recording.bag")};
    return request;
  }
  Recorder Record() const { return Recorder(Path("recording.bag")); }
  static void ExpectRefusal(const RecordingRequest& request,
                            const std::vector<std::string>& parts) {
    ExpectError<InputError>([&] { ReadBag(request); }, parts);
  }
};

}  // namespace imu_pose_calib
