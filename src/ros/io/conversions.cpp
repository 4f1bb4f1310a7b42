#include "imu_pose_calib/ros/io/conversions.h"

#include <tf2_eigen/tf2_eigen.h>

#include <cmath>

#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

template <typename Value, typename Msg>
Value FromMsg(const Msg& msg) {
  Value value;
  tf2::fromMsg(msg, value);
  return value;
}

/// A pose or a transform, by its two parts.
template <typename Vector>
PoseSample ToPoseSample(const ros::Time& stamp, const geometry_msgs::Quaternion& q,
                        const Vector& p) {
  return {ToNanoseconds(stamp), FromMsg<Eigen::Quaterniond>(q), FromMsg<Eigen::Vector3d>(p), {}};
}

ImuSample ToSample(const ros::Time& stamp, const geometry_msgs::Vector3& v) {
  return {ToNanoseconds(stamp), FromMsg<Eigen::Vector3d>(v)};
}

}  // namespace

int64_t ToNanoseconds(const ros::Time& stamp) { return static_cast<int64_t>(stamp.toNSec()); }

ros::Time FromNanoseconds(int64_t t_ns) {
  if (t_ns < 0 || t_ns / 1'000'000'000 > int64_t{ros::TIME_MAX.sec})
    Reject("stamp ", t_ns, " ns does not fit a ROS time: must be from 0 to ", ros::TIME_MAX.sec,
           " s");
  return ros::Time().fromNSec(static_cast<uint64_t>(t_ns));
}

geometry_msgs::Point ToPointMsg(const Eigen::Vector3d& p) { return tf2::toMsg(p); }

geometry_msgs::Vector3 ToVector3Msg(const Eigen::Vector3d& v) {
  geometry_msgs::Vector3 msg;
  return tf2::toMsg(v, msg);
}

geometry_msgs::Transform ToTransformMsg(const Rigid3& T) {
  geometry_msgs::Transform msg;
  msg.translation = ToVector3Msg(T.p);
  msg.rotation = tf2::toMsg(T.q);
  return msg;
}

geometry_msgs::Pose ToPoseMsg(const Rigid3& T) {
  geometry_msgs::Pose msg;
  msg.position = ToPointMsg(T.p);
  msg.orientation = tf2::toMsg(T.q);
  return msg;
}

std_msgs::Header MakeHeader(const ros::Time& stamp, const std::string& frame) {
  std_msgs::Header header;
  header.stamp = stamp;
  header.frame_id = frame;
  return header;
}

geometry_msgs::TransformStamped ToTransformStamped(const std_msgs::Header& header,
                                                   const std::string& child, const Rigid3& T) {
  geometry_msgs::TransformStamped msg;
  msg.header = header;
  msg.child_frame_id = child;
  msg.transform = ToTransformMsg(T);
  return msg;
}

PoseSample ToPoseSample(const ros::Time& stamp, const geometry_msgs::Pose& pose) {
  return ToPoseSample(stamp, pose.orientation, pose.position);
}

PoseSample ToPoseSample(const ros::Time& stamp, const geometry_msgs::PoseWithCovariance& pose) {
  PoseSample sample = ToPoseSample(stamp, pose.pose);
  sample.stated_std = ToPoseStd(pose);
  return sample;
}

PoseSample ToPoseSample(const ros::Time& stamp, const geometry_msgs::Transform& transform) {
  return ToPoseSample(stamp, transform.rotation, transform.translation);
}

PoseStd ToPoseStd(const geometry_msgs::PoseWithCovariance& pose) {
  // x, y, z, about x, about y, about z
  const Vector6d variance = Eigen::Map<const Matrix6d>(pose.covariance.data()).diagonal();
  if (!variance.allFinite() || variance.minCoeff() <= 0.0) return {};
  return {std::sqrt(variance.head<3>().mean()), std::sqrt(variance.tail<3>().mean())};
}

ImuContent ToImuContent(const geometry_msgs::Vector3Stamped& msg) {
  const ImuSample sample = ToSample(msg.header.stamp, msg.vector);
  return {sample, sample, msg.header.frame_id};
}

ImuContent ToImuContent(const sensor_msgs::Imu& msg) {
  ImuContent content{{}, {}, msg.header.frame_id};
  // By definition of the message the covariance of what it does not give starts with -1.
  if (msg.angular_velocity_covariance[0] != -1.0)
    content.gyro = ToSample(msg.header.stamp, msg.angular_velocity);
  if (msg.linear_acceleration_covariance[0] != -1.0)
    content.accel = ToSample(msg.header.stamp, msg.linear_acceleration);
  return content;
}

std::vector<geometry_msgs::TransformStamped> ToTransforms(const Calibration& result,
                                                          const RecordingInfo& info,
                                                          const ros::Time& stamp) {
  std::vector<geometry_msgs::TransformStamped> transforms;
  for (const auto& [name, T_MF] : BodyFrames(result, info))
    transforms.push_back(ToTransformStamped(MakeHeader(stamp, info.marker_frame), name, T_MF));
  return transforms;
}

CalibrationResult ToMsg(const Calibration& result, const RecordingInfo& info,
                        const ros::Time& stamp) {
  static_assert(static_cast<int>(Status::kOk) == CalibrationResult::STATUS_OK &&
                static_cast<int>(Status::kWeak) == CalibrationResult::STATUS_WEAK &&
                static_cast<int>(Status::kDegenerate) == CalibrationResult::STATUS_DEGENERATE);
  CalibrationResult msg;
  msg.header = MakeHeader(stamp, info.marker_frame);
  msg.status = static_cast<uint8_t>(result.status);
  msg.status_text = ToString(result.status);
  msg.method = ToString(result.method);
  msg.message = result.message;
  msg.unobservable = result.unobservable;
  msg.warnings = result.warnings;
  if (result.imus.empty()) return msg;
  const ImuCalibration& imu = result.imus[0];
  const ImuSession& session = result.sessions[0].imus[0];
  msg.child_frame_id = info.imus[0].imu_frame;
  msg.transform = ToTransformMsg(imu.T_MI);
  // Symmetric: row-major and column-major are the same.
  std::copy_n(imu.covariance.data(), msg.covariance.size(), msg.covariance.begin());
  msg.time_shift = session.time_shift;
  msg.time_shift_std = session.time_shift_std;
  msg.accel_delay = imu.accel_delay;
  msg.accel_delay_std = imu.accel_delay_std;
  msg.clock_drift = session.clock_drift;
  msg.clock_drift_std = session.clock_drift_std;
  msg.clock_reference = session.clock_reference;
  msg.pose_smoothing = result.pose_smoothing;
  msg.pose_smoothing_std = result.pose_smoothing_std;
  msg.position_smoothing = result.position_smoothing;
  msg.position_smoothing_std = result.position_smoothing_std;
  using Pair = Eigen::Map<Eigen::Vector2d>;
  Pair(msg.pose_cumulants.data()) = result.pose_cumulants;
  Pair(msg.pose_cumulants_std.data()) = result.pose_cumulants_std;
  Pair(msg.position_cumulants.data()) = result.position_cumulants;
  Pair(msg.position_cumulants_std.data()) = result.position_cumulants_std;
  msg.position_delay = result.position_delay;
  msg.position_delay_std = result.position_delay_std;
  msg.pose_scale = result.pose_scale;
  msg.pose_scale_std = result.pose_scale_std;
  msg.gravity = ToVector3Msg(result.sessions[0].g_W);
  msg.gyro_bias = ToVector3Msg(session.gyro_bias);
  msg.accel_bias = ToVector3Msg(session.accel_bias);
  msg.imus = ToTransforms(result, info, stamp);
  msg.imus.resize(result.imus.size());
  return msg;
}

}  // namespace imu_pose_calib
