#include "imu_pose_calib/ros/io/conversions.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace imu_pose_calib {
namespace {

constexpr int64_t kNanosecondsPerSecond = 1'000'000'000;

template <typename Msg>
Msg ToXyz(const Eigen::Vector3d& v) {
  Msg msg;
  msg.x = v.x();
  msg.y = v.y();
  msg.z = v.z();
  return msg;
}

Eigen::Quaterniond FromMsg(const geometry_msgs::Quaternion& q) { return {q.w, q.x, q.y, q.z}; }

}  // namespace

int64_t ToNanoseconds(const ros::Time& stamp) {
  return kNanosecondsPerSecond * static_cast<int64_t>(stamp.sec) + static_cast<int64_t>(stamp.nsec);
}

ros::Time FromNanoseconds(int64_t t_ns) {
  constexpr int64_t kMaxSeconds = std::numeric_limits<uint32_t>::max();
  if (t_ns < 0 || t_ns / kNanosecondsPerSecond > kMaxSeconds)
    throw InputError("stamp " + std::to_string(t_ns) +
                     " ns does not fit a ROS time: must be from " + "0 to " +
                     std::to_string(kMaxSeconds) + " s");
  return {static_cast<uint32_t>(t_ns / kNanosecondsPerSecond),
          static_cast<uint32_t>(t_ns % kNanosecondsPerSecond)};
}

geometry_msgs::Point ToPointMsg(const Eigen::Vector3d& p) { return ToXyz<geometry_msgs::Point>(p); }

geometry_msgs::Vector3 ToVector3Msg(const Eigen::Vector3d& v) {
  return ToXyz<geometry_msgs::Vector3>(v);
}

geometry_msgs::Quaternion ToQuaternionMsg(const Eigen::Quaterniond& q) {
  geometry_msgs::Quaternion msg;
  msg.x = q.x();
  msg.y = q.y();
  msg.z = q.z();
  msg.w = q.w();
  return msg;
}

geometry_msgs::Transform ToTransformMsg(const Rigid3& T) {
  geometry_msgs::Transform msg;
  msg.translation = ToVector3Msg(T.p);
  msg.rotation = ToQuaternionMsg(T.q);
  return msg;
}

PoseSample ToPoseSample(const ros::Time& stamp, const geometry_msgs::Pose& pose) {
  const auto& p = pose.position;
  return {ToNanoseconds(stamp), FromMsg(pose.orientation), {p.x, p.y, p.z}, {}};
}

PoseSample ToPoseSample(const ros::Time& stamp, const geometry_msgs::PoseWithCovariance& pose) {
  PoseSample sample = ToPoseSample(stamp, pose.pose);
  sample.stated_std = ToPoseStd(pose);
  return sample;
}

PoseSample ToPoseSample(const ros::Time& stamp, const geometry_msgs::Transform& transform) {
  const auto& p = transform.translation;
  return {ToNanoseconds(stamp), FromMsg(transform.rotation), {p.x, p.y, p.z}, {}};
}

FramedPose ToFramedPose(const geometry_msgs::PoseStamped& msg) {
  return {ToPoseSample(msg.header.stamp, msg.pose), msg.header.frame_id, ""};
}

FramedPose ToFramedPose(const geometry_msgs::TransformStamped& msg) {
  return {ToPoseSample(msg.header.stamp, msg.transform), msg.header.frame_id, msg.child_frame_id};
}

FramedPose ToFramedPose(const geometry_msgs::PoseWithCovarianceStamped& msg) {
  return {ToPoseSample(msg.header.stamp, msg.pose), msg.header.frame_id, ""};
}

FramedPose ToFramedPose(const nav_msgs::Odometry& msg) {
  return {ToPoseSample(msg.header.stamp, msg.pose), msg.header.frame_id, msg.child_frame_id};
}

PoseStd ToPoseStd(const geometry_msgs::PoseWithCovariance& pose) {
  Vector6d variance;  // x, y, z, about x, about y, about z
  for (Eigen::Index i = 0; i < 6; ++i) variance[i] = pose.covariance[static_cast<size_t>(7 * i)];
  if (!variance.allFinite() || variance.minCoeff() <= 0.0) return {};
  return {std::sqrt(variance.head<3>().mean()), std::sqrt(variance.tail<3>().mean())};
}

bool IsGiven(const sensor_msgs::Imu::_angular_velocity_covariance_type& covariance) {
  return covariance[0] != -1.0;
}

ImuSample ToImuSample(const geometry_msgs::Vector3Stamped& msg) {
  return {ToNanoseconds(msg.header.stamp), {msg.vector.x, msg.vector.y, msg.vector.z}};
}

ImuSample ToGyroSample(const sensor_msgs::Imu& msg) {
  const auto& w = msg.angular_velocity;
  return {ToNanoseconds(msg.header.stamp), {w.x, w.y, w.z}};
}

ImuSample ToAccelSample(const sensor_msgs::Imu& msg) {
  const auto& f = msg.linear_acceleration;
  return {ToNanoseconds(msg.header.stamp), {f.x, f.y, f.z}};
}

std::string FrameName(const std::string& frame, const std::string& fallback) {
  const size_t first = frame.find_first_not_of('/');
  return first == std::string::npos ? fallback : frame.substr(first);
}

geometry_msgs::TransformStamped ToTransformStamped(const Calibration& result,
                                                   const RecordingInfo& info,
                                                   const ros::Time& stamp) {
  geometry_msgs::TransformStamped msg;
  msg.header.stamp = stamp;
  msg.header.frame_id = info.marker_frame;
  msg.child_frame_id = info.imu_frame;
  msg.transform = ToTransformMsg(result.T_MI);
  return msg;
}

CalibrationResult ToMsg(const Calibration& result,
                        const RecordingInfo& info,
                        const ros::Time& stamp) {
  const auto status_code = [](Status status) -> uint8_t {
    switch (status) {
      case Status::kNotRun:
        return CalibrationResult::STATUS_NOT_RUN;
      case Status::kOk:
        return CalibrationResult::STATUS_OK;
      case Status::kWeak:
        return CalibrationResult::STATUS_WEAK;
      case Status::kDegenerate:
        return CalibrationResult::STATUS_DEGENERATE;
    }
    return CalibrationResult::STATUS_NOT_RUN;
  };

  CalibrationResult msg;
  msg.header.stamp = stamp;
  msg.header.frame_id = info.marker_frame;
  msg.child_frame_id = info.imu_frame;
  msg.status = status_code(result.status);
  msg.status_text = ToString(result.status);
  msg.method = ToString(result.method);
  msg.message = result.message;
  msg.transform = ToTransformMsg(result.T_MI);
  // Symmetric: row-major and column-major are the same.
  std::copy_n(result.covariance.data(), msg.covariance.size(), msg.covariance.begin());
  msg.time_shift = result.time_shift;
  msg.time_shift_std = result.time_shift_std;
  msg.accel_delay = result.accel_delay;
  msg.accel_delay_std = result.accel_delay_std;
  msg.clock_drift = result.clock_drift;
  msg.clock_drift_std = result.clock_drift_std;
  msg.clock_reference = result.clock_reference;
  msg.pose_smoothing = result.pose_smoothing;
  msg.pose_smoothing_std = result.pose_smoothing_std;
  msg.gravity = ToVector3Msg(result.g_W);
  msg.gyro_bias = ToVector3Msg(result.gyro_bias);
  msg.accel_bias = ToVector3Msg(result.accel_bias);
  msg.unobservable = result.unobservable;
  msg.warnings = result.warnings;
  return msg;
}

}  // namespace imu_pose_calib
