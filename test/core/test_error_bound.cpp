#include <gtest/gtest.h>

#include <Eigen/Cholesky>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/simulation/error_bound.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

SimulatorOptions Handheld(double duration_s) {
  SimulatorOptions truth;
  truth.seed = 11;
  truth.duration_s = duration_s;
  truth.accel_delay_s = 2e-3;
  return truth;
}

/// All IMU samples of a recording without noise; x: p_MI, rotation of R_MI, time shift, accel
/// delay, two turns of gravity, both biases.
Eigen::VectorXd Samples(SimulatorOptions truth, const Eigen::VectorXd& x) {
  truth.position_std = truth.rotation_std = truth.gyro_std = truth.accel_std = 0.0;
  truth.gyro_bias_walk = truth.accel_bias_walk = 0.0;
  truth.T_MI.p += x.segment<3>(0);
  truth.T_MI.q = truth.T_MI.q * Exp<double>(x.segment<3>(3));
  truth.accel_delay_s += x[7];
  truth.g_W = Exp<double>(Eigen::Vector3d(x[8], x[9], 0.0)) * truth.g_W;
  truth.gyro_bias += x.segment<3>(10);
  truth.accel_bias += x.segment<3>(13);
  const SessionData data = Simulate(truth);
  Eigen::VectorXd samples(6 * data.imus[0].gyro.size());
  Eigen::Index row = 0;
  for (const ImuSample& gyro : data.imus[0].gyro) samples.segment<3>(3 * row++) = gyro.value / 5e-3;
  for (const ImuSample& accel : data.imus[0].accel)
    samples.segment<3>(3 * row++) = accel.value / 2e-2;
  return samples;
}

/// With a trajectory that is known, the bound is that of a regression, whose derivatives are
/// differences of simulated recordings.
TEST(ErrorBoundTest, IsThatOfARegressionWhenPosesAreExact) {
  SimulatorOptions truth = Handheld(4.0);
  truth.position_std = truth.rotation_std = 1e-7;
  truth.gyro_bias_walk = truth.accel_bias_walk = 1e-9;
  Eigen::MatrixXd J = NumericJacobian([&](const Eigen::VectorXd& x) { return Samples(truth, x); },
                                      Eigen::VectorXd::Zero(16), 1e-4);
  // A later shift is an earlier time of the samples: by the derivative over time of the samples of
  // a recording whose IMU samples come one step apart, which the delay gives for the accelerometer.
  const Eigen::Index gyros = J.rows() / 2;
  for (Eigen::Index row = gyros; row < J.rows(); ++row) J(row, 6) = -J(row, 7);
  const TrueTrajectory trajectory(truth);
  const Eigen::Matrix3d R_IM = truth.T_MI.q.toRotationMatrix().transpose();
  for (Eigen::Index k = 0; k < gyros / 3; ++k)
    J.block<3, 1>(3 * k, 6) =
        R_IM * trajectory.At(static_cast<double>(k) / truth.gyro_rate_hz).alpha_M / 5e-3;
  const Eigen::VectorXd variance =
      (J.transpose() * J).ldlt().solve(Eigen::MatrixXd::Identity(16, 16)).diagonal();

  const ErrorNorms bound = FindErrorBounds({truth}, {Simulate(truth)}, 0.02).least;
  EXPECT_NEAR(bound.translation / std::sqrt(variance.segment<3>(0).sum()), 1.0, 0.02);
  EXPECT_NEAR(bound.rotation / std::sqrt(variance.segment<3>(3).sum()), 1.0, 0.02);
  EXPECT_NEAR(bound.time_shift / std::sqrt(variance[6]), 1.0, 0.02);
  EXPECT_NEAR(bound.accel_delay / std::sqrt(variance[7]), 1.0, 0.02);
}

/// Two derivations that share no code. The bound knows that the mount is stiff.
TEST(ErrorBoundTest, IsTheCovarianceOfTheJointSolve) {
  CalibrationOptions options;
  options.estimate_mount_compliance = false;
  for (const double noise : {1e-3, 5e-3}) {
    SimulatorOptions truth = Handheld(30.0);
    truth.position_std = truth.rotation_std = noise;
    const SessionData data = Simulate(truth);
    const Calibration result = Calibrate(options, data);
    const ErrorBounds bounds = FindErrorBounds({truth}, {data});
    const Vector6d variance = result.imus[0].model_covariance.diagonal();
    EXPECT_NEAR(std::sqrt(variance.head<3>().sum()) / bounds.as_joint.translation, 1.0, 0.1);
    // Only the solve has to find that the rotations do not err for seconds.
    const double rotation = std::sqrt(variance.tail<3>().sum()) / bounds.as_joint.rotation;
    EXPECT_GT(rotation, 0.95);
    EXPECT_LT(rotation, 1.2);
    EXPECT_LT(bounds.least.translation, 0.95 * bounds.as_joint.translation);
    EXPECT_LT(bounds.least.rotation, 0.95 * bounds.as_joint.rotation);
  }
}

TEST(ErrorBoundTest, HardlyDependsOnTheKnots) {
  const SimulatorOptions truth = Handheld(20.0);
  const SessionData data = Simulate(truth);
  const ErrorNorms coarse = FindErrorBounds({truth}, {data}, 0.08).as_joint;
  const ErrorNorms fine = FindErrorBounds({truth}, {data}, 0.02).as_joint;
  EXPECT_NEAR(coarse.translation / fine.translation, 1.0, 0.03);
  EXPECT_NEAR(coarse.time_shift / fine.time_shift, 1.0, 0.03);
}

TEST(ErrorBoundTest, FourRecordingsOfARigHaveHalfTheBound) {
  std::vector<SimulatorOptions> truths(4, Handheld(20.0));
  std::vector<SessionData> recordings;
  for (SimulatorOptions& truth : truths) {
    recordings.push_back(Simulate(truth));  // the same motion, which tells as much every time
    truth.time_shift_s = 0.02;
  }
  const ErrorNorms one = FindErrorBounds({truths[0]}, {recordings[0]}).least;
  const ErrorNorms four = FindErrorBounds(truths, recordings).least;
  EXPECT_NEAR(four.translation / one.translation, 0.5, 1e-3);
  EXPECT_NEAR(four.rotation / one.rotation, 0.5, 1e-3);
}

/// Poses that are lost tell nothing.
TEST(ErrorBoundTest, GrowsWhenPosesAreLost) {
  const SimulatorOptions truth = Handheld(20.0);
  SessionData data = Simulate(truth);
  const double all = FindErrorBounds({truth}, {data}).least.translation;
  data.poses.erase(data.poses.begin() + 500, data.poses.begin() + 1500);
  EXPECT_GT(FindErrorBounds({truth}, {data}).least.translation, 1.2 * all);
}

}  // namespace
}  // namespace imu_pose_calib
