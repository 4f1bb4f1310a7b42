#include <nav_msgs/Odometry.h>
#include <nav_msgs/Path.h>
#include <rosbag/bag.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <cstdio>
#include <random>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/trajectory_writer.h"

namespace imu_pose_calib {
namespace {

/// Between the poses of the path, which is there to be looked at.
constexpr int64_t kPathPeriodNs = 50'000'000;

/// Row by row, as messages have it.
template <typename Covariance>
void Fill(const Eigen::Matrix<double, 6, 6>& C, Covariance* covariance) {
  using RowMajor = Eigen::Matrix<double, 6, 6, Eigen::RowMajor>;
  Eigen::Map<RowMajor>(covariance->data()) = C;
}

nav_msgs::Odometry ToOdometry(const std_msgs::Header& header,
                              const std::string& child,
                              const ImuState& x) {
  const Eigen::Matrix3d R = x.q_WI.toRotationMatrix();
  const Eigen::Vector3d v_I = R.transpose() * x.v_W;
  nav_msgs::Odometry msg;
  msg.header = header;
  msg.child_frame_id = child;
  msg.pose.pose.position = ToPointMsg(x.p_WI);
  msg.pose.pose.orientation = ToQuaternionMsg(x.q_WI);
  msg.twist.twist.linear = ToVector3Msg(v_I);
  msg.twist.twist.angular = ToVector3Msg(x.omega_I);
  // Pose: position and rotation about the axes of W. Twist: both in I.
  Eigen::Matrix<double, 6, 12> pose = Eigen::Matrix<double, 6, 12>::Zero(), twist = pose;
  pose.block<3, 3>(0, 3).setIdentity();
  pose.block<3, 3>(3, 0) = R;
  twist.block<3, 3>(0, 0) << 0.0, -v_I.z(), v_I.y(), v_I.z(), 0.0, -v_I.x(), -v_I.y(), v_I.x(), 0.0;
  twist.block<3, 3>(0, 9) = R.transpose();
  twist.block<3, 3>(3, 6).setIdentity();
  Fill(pose * x.covariance * pose.transpose(), &msg.pose.covariance);
  Fill(twist * x.covariance * twist.transpose(), &msg.twist.covariance);
  return msg;
}

TrajectoryCount Write(const std::string& path, const TrajectoryOutput& output) {
  const std::string child = output.imu_frame + "_ground_truth";
  rosbag::Bag bag(path, rosbag::bagmode::Write);
  nav_msgs::Path track;
  track.header.frame_id = output.world_frame;
  int64_t next_ns = 0;
  const TrajectoryCount count = ForEachState(output, [&](int64_t stamp_ns, const ImuState& x) {
    const ros::Time stamp = std::max(ros::TIME_MIN, FromNanoseconds(stamp_ns));
    std_msgs::Header header;
    header.stamp = stamp;
    header.frame_id = output.world_frame;
    const nav_msgs::Odometry odometry = ToOdometry(header, child, x);
    bag.write("/ground_truth/odometry", stamp, odometry);

    geometry_msgs::TransformStamped transform;
    transform.header = header;
    transform.child_frame_id = child;
    transform.transform = ToTransformMsg({x.q_WI, x.p_WI});
    tf2_msgs::TFMessage tf;
    tf.transforms = {transform};
    bag.write("/tf", stamp, tf);

    if (!track.poses.empty() && stamp_ns < next_ns) return;
    next_ns = stamp_ns + kPathPeriodNs;
    track.poses.emplace_back();
    track.poses.back().header = header;
    track.poses.back().pose = odometry.pose.pose;
  });
  // At the start, so that whoever plays it sees the whole.
  if (!track.poses.empty()) {
    track.header.stamp = track.poses.front().header.stamp;
    bag.write("/ground_truth/path", track.header.stamp, track);
  }
  return count;
}

}  // namespace

TrajectoryCount WriteTrajectoryBag(const std::string& path, const TrajectoryOutput& output) {
  std::random_device random;
  const std::string draft = path + ".tmp" + std::to_string(random());
  try {
    const TrajectoryCount count = Write(draft, output);
    if (std::rename(draft.c_str(), path.c_str()) == 0) return count;
    std::remove(draft.c_str());
  } catch (const rosbag::BagException& error) {
    std::remove(draft.c_str());
    throw InputError("trajectory '" + path + "' cannot be written: " + error.what());
  } catch (const std::exception&) {
    std::remove(draft.c_str());
    throw;
  }
  throw InputError("trajectory '" + path + "' cannot be written: a bag cannot replace it");
}

}  // namespace imu_pose_calib
