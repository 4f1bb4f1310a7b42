#include <gtest/gtest.h>

#include "imu_pose_calib/ros/io/conversions.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

TEST(Stamps, KeepEveryNanosecond) {
  EXPECT_EQ(ToNanoseconds(ros::Time(1600000000, 123456789)), 1600000000123456789);
  EXPECT_EQ(ToNanoseconds(ros::Time(4294967295, 999999999)), 4294967295999999999);
  for (const int64_t t_ns : {int64_t{0}, int64_t{1}, int64_t{1600000000123456789}})
    EXPECT_EQ(ToNanoseconds(FromNanoseconds(t_ns)), t_ns);
}

TEST(Stamps, RefuseWhatRosTimeCannotHold) {
  ExpectError<InputError>([] { FromNanoseconds(-1); }, {"-1 ns"});
  ExpectError<InputError>([] { FromNanoseconds(4294967296000000000); }, {"4294967296000000000 ns"});
}

TEST(Samples, KeepValuesAndOrder) {
  geometry_msgs::Pose pose;
  pose.position.x = 1.0;
  pose.position.y = 2.0;
  pose.position.z = 3.0;
  pose.orientation.x = 0.1;
  pose.orientation.y = 0.2;
  pose.orientation.z = 0.3;
  pose.orientation.w = 0.9;
  geometry_msgs::Transform transform;
  transform.translation.x = 1.0;
  transform.translation.y = 2.0;
  transform.translation.z = 3.0;
  transform.rotation = pose.orientation;
  const ros::Time stamp(7, 8);
  for (const PoseSample& sample : {ToPoseSample(stamp, pose), ToPoseSample(stamp, transform)}) {
    EXPECT_EQ(sample.t_ns, 7000000008);
    EXPECT_EQ(sample.p_WM, Eigen::Vector3d(1.0, 2.0, 3.0));
    EXPECT_EQ(sample.q_WM.coeffs(), Eigen::Vector4d(0.1, 0.2, 0.3, 0.9));
  }
}

TEST(Samples, TellGyroscopeFromAccelerometer) {
  sensor_msgs::Imu msg;
  msg.header.stamp = ros::Time(7, 8);
  msg.header.frame_id = "i";
  msg.angular_velocity.x = 1.0;
  msg.angular_velocity.z = 3.0;
  msg.linear_acceleration.y = 5.0;
  const ImuContent content = ToImuContent(msg);  // covariances all zero: unknown
  EXPECT_EQ(content.gyro->t_ns, 7000000008);
  EXPECT_EQ(content.gyro->value, Eigen::Vector3d(1.0, 0.0, 3.0));
  EXPECT_EQ(content.accel->value, Eigen::Vector3d(0.0, 5.0, 0.0));
  EXPECT_EQ(content.frame, "i");
}

TEST(Samples, AreMissingWhenTheirCovarianceStartsWithMinusOne) {
  sensor_msgs::Imu msg;
  msg.angular_velocity_covariance[0] = -1.0;
  msg.linear_acceleration_covariance[4] = -1.0;
  EXPECT_FALSE(ToImuContent(msg).gyro);
  EXPECT_TRUE(ToImuContent(msg).accel);
  msg.linear_acceleration_covariance[0] = -1.0;
  EXPECT_FALSE(ToImuContent(msg).accel);
}

TEST(Samples, OfVectorsMayBeOfEitherSensor) {
  geometry_msgs::Vector3Stamped msg;
  msg.header.stamp = ros::Time(7, 8);
  msg.vector.y = 2.0;
  const ImuContent content = ToImuContent(msg);
  EXPECT_EQ(content.gyro->t_ns, 7000000008);
  EXPECT_EQ(content.gyro->value, Eigen::Vector3d(0.0, 2.0, 0.0));
  EXPECT_EQ(content.accel->value, Eigen::Vector3d(0.0, 2.0, 0.0));
}

TEST(Samples, StatedStdNeedsACovarianceThatMakesSense) {
  geometry_msgs::PoseWithCovariance pose;
  EXPECT_EQ(ToPoseStd(pose).position, 0.0);  // all zero
  for (size_t i = 0; i < 36; i += 7) pose.covariance[i] = i < 21 ? 0.04 : 0.01;
  pose.covariance[0] = 0.10;
  EXPECT_NEAR(ToPoseStd(pose).position, std::sqrt(0.06), 1e-12);
  EXPECT_NEAR(ToPoseStd(pose).rotation, 0.1, 1e-12);
  for (const double bad : {-1.0, 0.0, std::nan(""), HUGE_VAL}) {
    pose.covariance[14] = bad;
    EXPECT_EQ(ToPoseStd(pose).rotation, 0.0) << bad;
  }
}

TEST(Frames, LoseTheLeadingSlash) {
  EXPECT_EQ(FrameName("/map", "world"), "map");
  EXPECT_EQ(FrameName("rig/map", "world"), "rig/map");
  EXPECT_EQ(FrameName("", "world"), "world");
  EXPECT_EQ(FrameName("/", "world"), "world");
}

class ResultMessages : public ::testing::Test {
 protected:
  void SetUp() override {
    info_.marker_frame = "rig";
    info_.imus[0].imu_frame = "imu_link";
    result_.status = Status::kWeak;
    result_.method = Method::kGp;
    result_.message = "why";
    result_.imus[0].T_MI = {Eigen::Quaterniond(0.5, -0.5, 0.5, 0.5), {0.1, 0.2, 0.3}};
    result_.sessions[0].imus[0].time_shift = 1.5;
    result_.sessions[0].imus[0].time_shift_std = 0.1;
    result_.imus[0].accel_delay = 0.25;
    result_.imus[0].accel_delay_std = 0.2;
    result_.pose_smoothing = 0.03;
    result_.pose_smoothing_std = 0.04;
    result_.position_smoothing = 0.05;
    result_.position_smoothing_std = 0.06;
    result_.pose_cumulants = {0.075, 0.076};
    result_.pose_cumulants_std = {0.077, 0.078};
    result_.position_cumulants = {0.085, 0.086};
    result_.position_cumulants_std = {0.087, 0.088};
    result_.position_delay = 0.07;
    result_.position_delay_std = 0.08;
    result_.pose_scale = 1.07;
    result_.pose_scale_std = 0.08;
    result_.sessions[0].g_W = {0.0, 0.0, -9.8};
    result_.sessions[0].imus[0].gyro_bias = {1.0, 2.0, 3.0};
    result_.sessions[0].imus[0].accel_bias = {4.0, 5.0, 6.0};
    result_.imus[0].covariance(0, 5) = result_.imus[0].covariance(5, 0) = 0.7;
    result_.unobservable = {"p_MI along z"};
    result_.warnings = {"slow"};
  }

  Calibration result_;
  RecordingInfo info_;
};

TEST_F(ResultMessages, TransformGoesFromImuToMarker) {
  const auto msg = ToTransforms(result_, info_, ros::Time(7, 8)).front();
  EXPECT_EQ(msg.header.stamp, ros::Time(7, 8));
  EXPECT_EQ(msg.header.frame_id, "rig");
  EXPECT_EQ(msg.child_frame_id, "imu_link");
  EXPECT_EQ(msg.transform.translation.y, 0.2);
  EXPECT_EQ(msg.transform.rotation.x, -0.5);
  EXPECT_EQ(msg.transform.rotation.w, 0.5);
}

/// Also without an IMU, whose part of the result is empty then.
TEST_F(ResultMessages, TransformsOfPoseSensorsFollow) {
  result_.pose_sensors.resize(2);
  result_.pose_sensors[0].status = Status::kDegenerate;
  result_.pose_sensors[1].status = Status::kOk;
  result_.pose_sensors[1].T_MS.p = {7.0, 8.0, 9.0};
  info_.pose_sensors = {{"/a", "a", ""}, {"/b", "b", ""}};
  auto transforms = ToTransforms(result_, info_, ros::Time(7, 8));
  ASSERT_EQ(transforms.size(), 2u);
  EXPECT_EQ(transforms[1].header.frame_id, "rig");
  EXPECT_EQ(transforms[1].child_frame_id, "b");
  EXPECT_EQ(transforms[1].transform.translation.y, 8.0);
  EXPECT_EQ(ToMsg(result_, info_, ros::Time()).imus.size(), 1u);
  result_.imus.clear();
  result_.sessions[0].imus.clear();
  info_.imus.clear();
  transforms = ToTransforms(result_, info_, ros::Time(7, 8));
  ASSERT_EQ(transforms.size(), 1u);
  EXPECT_EQ(transforms[0].child_frame_id, "b");
  const auto msg = ToMsg(result_, info_, ros::Time());
  EXPECT_EQ(msg.message, "why");
  EXPECT_EQ(msg.warnings, result_.warnings);
  EXPECT_TRUE(msg.imus.empty());
}

TEST_F(ResultMessages, ResultKeepsEveryField) {
  const auto msg = ToMsg(result_, info_, ros::Time(7, 8));
  EXPECT_EQ(msg.header.stamp, ros::Time(7, 8));
  EXPECT_EQ(msg.header.frame_id, "rig");
  EXPECT_EQ(msg.child_frame_id, "imu_link");
  EXPECT_EQ(msg.status, CalibrationResult::STATUS_WEAK);
  EXPECT_EQ(msg.status_text, "weak");
  EXPECT_EQ(msg.method, "gp");
  EXPECT_EQ(msg.message, "why");
  EXPECT_EQ(msg.transform.translation.z, 0.3);
  EXPECT_EQ(msg.covariance[5], 0.7);
  EXPECT_EQ(msg.covariance[30], 0.7);
  EXPECT_EQ(msg.time_shift, 1.5);
  EXPECT_EQ(msg.time_shift_std, 0.1);
  EXPECT_EQ(msg.accel_delay, 0.25);
  EXPECT_EQ(msg.accel_delay_std, 0.2);
  EXPECT_EQ(msg.pose_smoothing, 0.03);
  EXPECT_EQ(msg.pose_smoothing_std, 0.04);
  EXPECT_EQ(msg.position_smoothing, 0.05);
  EXPECT_EQ(msg.position_smoothing_std, 0.06);
  EXPECT_EQ(msg.pose_cumulants[0], 0.075);
  EXPECT_EQ(msg.pose_cumulants[1], 0.076);
  EXPECT_EQ(msg.pose_cumulants_std[0], 0.077);
  EXPECT_EQ(msg.pose_cumulants_std[1], 0.078);
  EXPECT_EQ(msg.position_cumulants[0], 0.085);
  EXPECT_EQ(msg.position_cumulants[1], 0.086);
  EXPECT_EQ(msg.position_cumulants_std[0], 0.087);
  EXPECT_EQ(msg.position_cumulants_std[1], 0.088);
  EXPECT_EQ(msg.position_delay, 0.07);
  EXPECT_EQ(msg.position_delay_std, 0.08);
  EXPECT_EQ(msg.pose_scale, 1.07);
  EXPECT_EQ(msg.pose_scale_std, 0.08);
  EXPECT_EQ(msg.gravity.z, -9.8);
  EXPECT_EQ(msg.gyro_bias.y, 2.0);
  EXPECT_EQ(msg.accel_bias.x, 4.0);
  EXPECT_EQ(msg.unobservable, result_.unobservable);
  EXPECT_EQ(msg.warnings, result_.warnings);
}

TEST_F(ResultMessages, EveryStatusHasACode) {
  const auto code = [&](Status status) {
    result_.status = status;
    return ToMsg(result_, info_, ros::Time()).status;
  };
  EXPECT_EQ(code(Status::kNotRun), CalibrationResult::STATUS_NOT_RUN);
  EXPECT_EQ(code(Status::kOk), CalibrationResult::STATUS_OK);
  EXPECT_EQ(code(Status::kDegenerate), CalibrationResult::STATUS_DEGENERATE);
}

}  // namespace
}  // namespace imu_pose_calib
