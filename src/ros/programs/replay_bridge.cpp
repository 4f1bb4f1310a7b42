// Stands in for a motion-capture bridge: republishes the poses of a played bag as the bridge would.

#include <geometry_msgs/PoseStamped.h>
#include <geometry_msgs/TransformStamped.h>
#include <ros/ros.h>
#include <tf2_ros/transform_broadcaster.h>
#include <topic_tools/shape_shifter.h>

#include <algorithm>
#include <boost/algorithm/string/replace.hpp>
#include <optional>
#include <random>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/live/parameter.h"
#include "imu_pose_calib/ros/offline/command_line.h"

namespace imu_pose_calib {
namespace {

/// How a bridge publishes the body BODY.
struct Style {
  const char* name;
  const char* topic;  ///< BODY stands for the name
  const char* frame;  ///< of the body in tf
  bool transform;     ///< geometry_msgs/TransformStamped, else geometry_msgs/PoseStamped
  bool repeats;       ///< goes on with the last pose while the body is not seen
};
constexpr Style kStyles[] = {
    {"vicon_bridge", "/vicon/BODY/BODY", "vicon/BODY/BODY", true, false},
    {"vrpn_client_ros", "/vrpn_client_node/BODY/pose", "BODY", false, true},
    {"mocap_optitrack", "/mocap_node/BODY/pose", "BODY/base_link", false, false},
};

const Style& FindStyle(const std::string& name) {
  std::string names;
  for (const Style& style : kStyles) {
    if (name == style.name) return style;
    names += std::string(names.empty() ? "" : ", ") + style.name;
  }
  throw InputError("style '" + name + "' does not exist; available: " + names);
}

class ReplayBridge {
 public:
  ReplayBridge() {
    ros::NodeHandle root;
    const std::string topic = ForBody(style_.topic);
    publisher_ = style_.transform ? root.advertise<geometry_msgs::TransformStamped>(topic, 1000)
                                  : root.advertise<geometry_msgs::PoseStamped>(topic, 1000);
    input_ = root.subscribe(RosParameter<std::string>("input", "/mocap/pose"), 0,
                            &ReplayBridge::OnMessage, this, ros::TransportHints().tcpNoDelay());
  }

 private:
  std::string ForBody(const char* text) const {
    return boost::replace_all_copy<std::string>(text, "BODY", body_);
  }

  void OnMessage(const topic_tools::ShapeShifter::ConstPtr& message) {
    if (IsPoseType(message->getDataType()))
      Republish(ReadPose(message->getDataType(), *message).pose);
  }

  void Republish(PoseSample pose) {
    const int64_t captured = pose.t_ns;
    if (!first_ || captured < *first_) first_ = captured;  // the bag starts again
    const double elapsed = Seconds(captured - *first_);
    const bool is_lost = elapsed >= loss_start_ && elapsed < loss_start_ + loss_duration_;
    if (is_lost && !(style_.repeats && seen_)) return;
    if (is_lost) pose = *seen_;
    seen_ = pose;

    // Bridges stamp what they get when they get it.
    const double delay = latency_ + jitter_ * exponential_(random_);
    const ros::Time stamp = FromNanoseconds(captured + static_cast<int64_t>(1e9 * delay));
    const Rigid3 T_WM{pose.q_WM, pose.p_WM};
    const auto transform = ToTransformStamped(MakeHeader(stamp, "world"), frame_, T_WM);
    broadcaster_.sendTransform(transform);
    if (style_.transform) return publisher_.publish(transform);
    geometry_msgs::PoseStamped msg;
    msg.header = transform.header;
    msg.pose = ToPoseMsg(T_WM);
    publisher_.publish(msg);
  }

  const std::string body_ = RosParameter<std::string>("body", "rig");
  const Style& style_ = FindStyle(RosParameter<std::string>("style", "vicon_bridge"));
  const std::string frame_ = ForBody(style_.frame);
  const double latency_ = RosParameter("latency", 0.004);  ///< [s]
  /// [s] mean of what comes on top
  const double jitter_ = std::max(0.0, RosParameter("jitter", 0.0001));
  /// [s] of the body, after the first pose
  const double loss_start_ = RosParameter("loss_start", 0.0);
  const double loss_duration_ = RosParameter("loss_duration", 0.0);
  std::optional<int64_t> first_;  ///< stamp of the first pose
  std::optional<PoseSample> seen_;
  std::mt19937 random_{1};
  std::exponential_distribution<double> exponential_;
  ros::Publisher publisher_;
  tf2_ros::TransformBroadcaster broadcaster_;
  ros::Subscriber input_;
};

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  ros::init(argc, argv, "replay_bridge");
  const ros::NodeHandle node;  // outlives the error message
  return imu_pose_calib::RunToExitStatus(
      [&] {
        imu_pose_calib::ReplayBridge bridge;
        ros::spin();
      },
      [](const std::string& error) { ROS_FATAL("%s", error.c_str()); });
}
