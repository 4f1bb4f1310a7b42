#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/verdict/verdict.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

bool Contains(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

PreparedSession Scattering(double position, double rotation) {
  static const PreparedSession prepared = [] {
    SimulatorOptions truth;
    truth.duration_s = 8.0;
    DataCheck check;
    return Prepare(CalibrationOptions(), Simulate(truth), &check);
  }();
  PreparedSession session = prepared;
  session.pose_noise = {position, rotation};
  return session;
}

/// As graded: everything within its bound, and noise of poses as S1 finds it.
Calibration Certain() {
  Calibration result;
  result.status = Status::kOk;
  result.message = "fine";
  result.sessions[0].noise = {2e-3, 4e-3};
  return result;
}

Calibration Doubted(Calibration result, bool has_settled = true) {
  DoubtResult({Scattering(2e-3, 4e-3)}, has_settled, &result);
  return result;
}

TEST(Doubts, ASolveThatHasNotSettled) {
  const Calibration result = Doubted(Certain(), false);
  EXPECT_EQ(result.status, Status::kWeak);
  EXPECT_NE(result.message.find("has not settled"), std::string::npos) << result.message;
}

TEST(Doubts, MotionInAMomentOnly) {
  PreparedSession session = Scattering(2e-3, 4e-3);
  for (TimedSample& sample : session.data.imus[0].gyro)
    if (std::abs(sample.t - 4.0) > 1.0) sample.value = session.starts[0].gyro_bias;
  Calibration result = Certain();
  DoubtResult({session}, true, &result);
  EXPECT_EQ(result.status, Status::kWeak);
  EXPECT_TRUE(Contains(result.message, "s (bound: 3 s): turn it for longer")) << result.message;
  // Another session of the rig makes up for it.
  result = Certain();
  result.sessions.push_back(result.sessions[0]);
  DoubtResult({session, Scattering(2e-3, 4e-3)}, true, &result);
  EXPECT_EQ(result.status, Status::kOk);
}

TEST(Doubts, NoneWithoutAReason) {
  Calibration result = Certain();
  result.pose_scale = 1.011;
  result.pose_smoothing = -3.9e-3;
  result.imus[0].accel_smoothing = -1.1e-3;
  result.imus[0].gyro_smoothing = 1.1e-3;  // and no mount
  result.imus[0].accel_smoothing_std = 1e-5;
  result.imus[0].mount_compliance = 6e-5;
  result.split_half.sigmas = 4.9;
  result.sessions[0].noise = {0.019, 0.039};
  result = Doubted(result);
  EXPECT_EQ(result.status, Status::kOk);
  EXPECT_EQ(result.message, "fine");
  EXPECT_TRUE(result.warnings.empty());
}

TEST(Doubts, AreTheMessageOfAWeakResult) {
  Calibration halves = Certain();
  halves.split_half.sigmas = 5.1;
  Calibration scale = Certain();
  scale.pose_scale = 0.987;
  Calibration smoothing = Certain();
  smoothing.pose_smoothing = -5e-3;
  Calibration filter = Certain();
  filter.imus[0].accel_smoothing = 2e-3;
  Calibration mount = Certain();
  mount.imus[0].mount_compliance = 1.76e-4;
  mount.imus[0].mount_compliance_std = 3e-5;
  mount.sessions[0].g_W = {0.0, 0.0, -9.8};
  Calibration positions = Certain();
  positions.sessions[0].noise.position = 0.021;
  Calibration rotations = Certain();
  rotations.sessions[0].noise.rotation = 0.041;
  const std::vector<std::pair<Calibration, std::string>> doubted = {
      {halves, "halves of the recording disagree by up to 5.1 sigma"},
      {scale, "off in scale by -1.3 % (bound: 1.2 %)"},
      {smoothing, "the imu's data seem smoothed over 70.7 ms"},
      {filter, "the accelerometer averages over 44.7 ms more than the gyroscope (bound: 34.6 ms)"},
      {mount,
       "the mount of the imu is soft: it resonates at some 12 Hz (bound: 20 Hz) and gives way by "
       "1.72 mm"},
      {positions, "the positions of the poses are off by 21 mm where they scatter by 2 mm"},
      {rotations,
       "the rotations of the poses are off by 2.35 deg where they scatter by 0.229 deg"}};
  for (const auto& [result, text] : doubted) {
    const Calibration weak = Doubted(result);
    EXPECT_EQ(weak.status, Status::kWeak);
    EXPECT_TRUE(Contains(weak.message, text)) << weak.message;
    EXPECT_TRUE(weak.warnings.empty());
  }
}

TEST(Doubts, OfWhatIsWeakAlreadyLoseNothing) {
  Calibration result = Certain();
  result.status = Status::kWeak;
  result.split_half.sigmas = 7.0;
  result.pose_scale = 1.02;
  result = Doubted(result);
  EXPECT_TRUE(Contains(result.message, "halves"));
  ASSERT_EQ(result.warnings.size(), 2u);
  EXPECT_TRUE(Contains(result.warnings[0], "scale"));
  EXPECT_EQ(result.warnings[1], "fine");

  result.status = Status::kDegenerate;
  result.message = "no";
  EXPECT_EQ(Doubted(result).message, "no");
}

TEST(Doubts, TheSigmasCoverHalvesThatDisagree) {
  Marginals marginals;
  marginals.robust = Eigen::Vector2d(1e-6, 1e-6).asDiagonal();
  marginals.halves_difference = Eigen::Vector2d(0.01, -1e-4);
  marginals.halves_sigmas = 4.9;
  EXPECT_EQ(CoverHalves(marginals).robust, marginals.robust);
  marginals.halves_sigmas = 5.1;
  const Eigen::MatrixXd covered = CoverHalves(marginals).robust;
  EXPECT_NEAR(covered(0, 0), 0.005 * 0.005, 1e-12);
  EXPECT_EQ(covered(1, 1), 1e-6);
}

TEST(Doubts, OfAGivenTrajectoryThatHasLostMotion) {
  // Swings of up to 3 Hz, which poses do not show.
  SimulatorOptions truth;
  truth.motion = Motion::kDrone;
  truth.seed = 51;
  truth.position_std = 3e-3;
  truth.rotation_std = 5e-3;
  truth.T_MI.p = {0.3, -0.2, 0.1};
  CalibrationOptions options;
  options.method = Method::kGp;
  const SessionData data = Simulate(truth);
  const Calibration noisy = Calibrate(options, data);
  EXPECT_EQ(noisy.status, Status::kWeak);
  EXPECT_TRUE(
      Contains(noisy.message, "method gp does not follow the motion: it leaves the accelerometer"))
      << noisy.message;
  EXPECT_EQ(Calibrate(CalibrationOptions(), data).status, Status::kOk);

  truth.motion = Motion::kHandheld;
  truth.position_std = 1e-4;
  truth.rotation_std = 2e-4;
  EXPECT_EQ(Calibrate(options, Simulate(truth)).status, Status::kOk);
}

}  // namespace
}  // namespace imu_pose_calib
