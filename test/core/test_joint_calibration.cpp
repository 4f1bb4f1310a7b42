#include <gtest/gtest.h>

#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/simulator.h"
#include "imu_pose_calib/core/so3.h"

namespace imu_pose_calib {
namespace {

using Vector8d = Eigen::Matrix<double, 8, 1>;

SimulatorOptions Recording(double pose_noise, uint32_t seed) {
  SimulatorOptions options;
  options.duration_s = 12.0;
  options.seed = seed;
  options.position_std = options.rotation_std = pose_noise;
  options.accel_delay_s = 0.003;
  return options;
}

/// Errors of (p_MI, rotation about the imu axes, time_shift, accel_delay) in reported sigmas.
Vector8d Normalised(const Calibration& result, const SimulatorOptions& truth) {
  Vector8d error, sigma;
  error << result.T_MI.p - truth.T_MI.p,
      Log(Eigen::Quaterniond(truth.T_MI.q.conjugate() * result.T_MI.q)),
      result.time_shift - truth.time_shift_s, result.accel_delay - truth.accel_delay_s;
  sigma << result.Std(), result.time_shift_std, result.accel_delay_std;
  return error.cwiseQuotient(sigma);
}

TEST(JointCalibration, IsTheDefaultAndReportsSigmasThatMatchTheErrors) {
  // 6 recordings x 8 correlated parameters; each sigma is the larger of two estimates, so the mean
  // square tends to be below 1. Twice too small sigmas would make it 4.
  double mean_square = 0.0;
  for (uint32_t seed = 1; seed <= 6; ++seed) {
    const SimulatorOptions truth = Recording(seed % 2 == 0 ? 5e-3 : 1e-3, seed);
    const Calibration result = Calibrate(CalibrationOptions(), Simulate(truth));
    EXPECT_EQ(result.method, Method::kJoint);
    EXPECT_TRUE(result.IsUsable()) << result.message;
    EXPECT_GT(result.knot_spacing_s, 0.0);
    const Vector8d z = Normalised(result, truth);
    EXPECT_LT(z.cwiseAbs().maxCoeff(), 4.5) << "seed " << seed << ": " << z.transpose();
    mean_square += z.squaredNorm() / (8.0 * 6.0);
  }
  EXPECT_GT(mean_square, 0.25);
  EXPECT_LT(mean_square, 2.0);
}

TEST(JointCalibration, FindsTheNoiseOfEverySensor) {
  const SimulatorOptions truth = Recording(1e-3, 7);
  const Calibration result = Calibrate(CalibrationOptions(), Simulate(truth));
  EXPECT_NEAR(result.noise.position, truth.position_std, 0.15 * truth.position_std);
  EXPECT_NEAR(result.noise.rotation, truth.rotation_std, 0.15 * truth.rotation_std);
  EXPECT_NEAR(result.noise.gyro, truth.gyro_std, 0.15 * truth.gyro_std);
  EXPECT_NEAR(result.noise.accel, truth.accel_std, 0.15 * truth.accel_std);
}

TEST(JointCalibration, DoesNotDependOnTheNoiseThatIsSet) {
  const CalibrationData data = Simulate(Recording(1e-3, 8));
  CalibrationOptions options;
  options.knot_spacing_s = 0.06;
  const Calibration right = Calibrate(options, data);
  for (const double factor : {0.1, 10.0}) {
    for (const bool gyro : {false, true}) {
      CalibrationOptions wrong = options;
      (gyro ? wrong.gyro_noise_density : wrong.accel_noise_density) *= factor;
      const Calibration result = Calibrate(wrong, data);
      const Eigen::Vector3d move =
          (result.T_MI.p - right.T_MI.p).cwiseQuotient(right.Std().head<3>());
      EXPECT_LT(move.cwiseAbs().maxCoeff(), 1.0) << factor << " gyro " << gyro;
      EXPECT_LT(result.T_MI.q.angularDistance(right.T_MI.q), right.Std().tail<3>().minCoeff());
    }
  }
}

TEST(JointCalibration, IsCloserThanTheFixedTrajectoryWhenPosesAreNoisy) {
  double joint = 0.0, gp = 0.0;
  for (uint32_t seed = 11; seed <= 13; ++seed) {
    const SimulatorOptions truth = Recording(5e-3, seed);
    const CalibrationData data = Simulate(truth);
    CalibrationOptions options;
    options.knot_spacing_s = 0.06;
    joint += (Calibrate(options, data).T_MI.p - truth.T_MI.p).squaredNorm();
    options.method = Method::kGp;
    gp += (Calibrate(options, data).T_MI.p - truth.T_MI.p).squaredNorm();
  }
  EXPECT_LT(joint, gp);
}

TEST(JointCalibration, RefusesATurnAboutOneAxis) {
  for (const Motion motion : {Motion::kPlanar, Motion::kHinge}) {
    SimulatorOptions truth = Recording(1e-3, 9);
    truth.motion = motion;
    const Calibration result = Calibrate(CalibrationOptions(), Simulate(truth));
    EXPECT_EQ(result.status, Status::kDegenerate);
    EXPECT_NE(result.message.find("about one axis only"), std::string::npos) << result.message;
  }
}

}  // namespace
}  // namespace imu_pose_calib
