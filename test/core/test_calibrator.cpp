#include <gtest/gtest.h>

#include <cmath>
#include <random>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using Eigen::Quaterniond;
using Eigen::Vector3d;
using Vector8d = Eigen::Matrix<double, 8, 1>;

/// Method under test; one thread, so that results do not depend on the machine.
CalibrationOptions GpOptions() {
  CalibrationOptions options;
  options.method = Method::kGp;
  options.num_threads = 1;
  return options;
}

SimulatorOptions Recording(Motion motion, double duration_s, uint32_t seed) {
  SimulatorOptions options;
  options.motion = motion;
  options.duration_s = duration_s;
  options.seed = seed;
  options.T_MI = {Quaterniond(0.3, -0.5, 0.1, 0.8).normalized(), {0.06, -0.08, 0.05}};
  options.accel_delay_s = 0.003;
  return options;
}

/// (p_MI in M, rotation about the imu axes, time_shift, accel_delay).
Vector8d Error(const Calibration& result, const SimulatorOptions& truth) {
  Vector8d e;
  e << result.imus[0].T_MI.p - truth.T_MI.p,
      Log(Quaterniond(truth.T_MI.q.conjugate() * result.imus[0].T_MI.q)),
      result.sessions[0].imus[0].time_shift - truth.time_shift_s,
      result.imus[0].accel_delay - truth.accel_delay_s;
  return e;
}

Vector8d Sigma(const Calibration& result) {
  Vector8d sigma;
  sigma << result.imus[0].Std(), result.sessions[0].imus[0].time_shift_std,
      result.imus[0].accel_delay_std;
  return sigma;
}

const char* const kParameters[] = {"p_MI x",     "p_MI y",     "p_MI z",     "rotation x",
                                   "rotation y", "rotation z", "time_shift", "accel_delay"};

/// The sigmas reported with the fixed trajectory take its errors as independent from sample to
/// sample. The lever arm, seen through the twice differentiated poses, is therefore held to a share
/// of the pose noise and the other parameters to their sigmas.
void ExpectRecovered(const Calibration& result, const SimulatorOptions& truth,
                     double largest_translation_error_m) {
  EXPECT_EQ(result.status, Status::kOk) << result.message;
  EXPECT_TRUE(result.IsUsable());
  EXPECT_EQ(result.method, Method::kGp);
  EXPECT_TRUE(result.unobservable.empty());
  const Vector8d e = Error(result, truth), sigma = Sigma(result);
  EXPECT_LT(e.head<3>().norm(), largest_translation_error_m);
  for (int i = 3; i < 8; ++i) {
    if (sigma[i] == 0.0) continue;  // fixed
    EXPECT_LT(std::abs(e[i]), 4.0 * sigma[i]) << kParameters[i];
  }
  EXPECT_LT(sigma.segment<3>(3).maxCoeff(), 2e-3);
  EXPECT_LT(sigma[6], 1e-3);
  EXPECT_NEAR(result.imus[0].T_MI.q.norm(), 1.0, 1e-12);
  EXPECT_GE(result.imus[0].T_MI.q.w(), 0.0);
  EXPECT_LT(std::acos(result.sessions[0].g_W.normalized().dot(truth.g_W.normalized())), 0.01);
  EXPECT_LT((result.imus[0].covariance - result.imus[0].covariance.transpose()).norm(),
            1e-9 * result.imus[0].covariance.norm());
}

Calibration ExpectCalibrates(const CalibrationOptions& options, const SessionData& data,
                             const SimulatorOptions& truth,
                             double largest_translation_error_m = 2e-3) {
  const Calibration result = Calibrate(options, data);
  ExpectRecovered(result, truth, largest_translation_error_m);
  return result;
}

TEST(Calibration, IsNotRunAndNotUsableByDefault) {
  const Calibration result;
  EXPECT_EQ(result.status, Status::kNotRun);
  EXPECT_FALSE(result.IsUsable());
  EXPECT_EQ(result.message, "Calibrate() was not called");
}

TEST(Calibration, OnlyOkAndWeakAreUsable) {
  Calibration result;
  for (const Status status : {Status::kNotRun, Status::kOk, Status::kWeak, Status::kDegenerate}) {
    result.status = status;
    EXPECT_EQ(result.IsUsable(), status == Status::kOk || status == Status::kWeak);
  }
  EXPECT_STREQ(ToString(Status::kNotRun), "not run");
  EXPECT_STREQ(ToString(Status::kOk), "ok");
  EXPECT_STREQ(ToString(Status::kWeak), "weak");
  EXPECT_STREQ(ToString(Status::kDegenerate), "degenerate");
  EXPECT_STREQ(ToString(Method::kGp), "gp");
}

TEST(Calibrate, RecoversTheTruthFromSwingsAndFromFullTurns) {
  for (const Motion motion : {Motion::kHandheld, Motion::kTumble}) {
    for (uint32_t seed = 1; seed <= 3; ++seed) {
      SCOPED_TRACE(std::string(ToString(motion)) + ", seed " + std::to_string(seed));
      const SimulatorOptions truth = Recording(motion, 12.0, seed);
      const Calibration result = ExpectCalibrates(GpOptions(), Simulate(truth), truth);
      EXPECT_NEAR(result.sessions[0].noise.position, truth.position_std, 0.1 * truth.position_std);
      EXPECT_NEAR(result.sessions[0].noise.rotation, truth.rotation_std, 0.1 * truth.rotation_std);
      EXPECT_NEAR(result.sessions[0].imus[0].noise.gyro, truth.gyro_std, 0.4 * truth.gyro_std);
      EXPECT_NEAR(result.sessions[0].imus[0].noise.accel, truth.accel_std, 0.4 * truth.accel_std);
      EXPECT_LT((result.sessions[0].imus[0].gyro_bias - truth.gyro_bias).norm(), 2e-3);
      EXPECT_LT((result.sessions[0].imus[0].accel_bias - truth.accel_bias).norm(), 0.05);
    }
  }
}

TEST(Calibrate, RecoversTheTruthAtEveryPoseNoise) {
  const double noises[] = {1e-4, 5e-3, 1e-2}, largest_errors[] = {3e-4, 1e-2, 2.5e-2};
  for (int i = 0; i < 3; ++i) {
    for (uint32_t seed = 4; seed <= 5; ++seed) {
      SCOPED_TRACE(std::to_string(noises[i]) + ", seed " + std::to_string(seed));
      SimulatorOptions truth = Recording(Motion::kHandheld, 12.0, seed);
      truth.position_std = truth.rotation_std = noises[i];
      const Calibration result = Calibrate(GpOptions(), Simulate(truth));
      EXPECT_TRUE(result.IsUsable()) << result.message;
      const Vector8d e = Error(result, truth), sigma = Sigma(result);
      EXPECT_LT(e.head<3>().norm(), largest_errors[i]);
      for (int k = 3; k < 8; ++k) EXPECT_LT(std::abs(e[k]), 4.0 * sigma[k]) << kParameters[k];
    }
  }
}

TEST(Calibrate, ReportsSigmasThatMatchTheErrorsWhenPosesAreGood) {
  // 10 recordings x 8 parameters: the mean square of 80 independent normalised errors would
  // scatter by 0.16 around 1. The parameters of one recording are correlated, and each sigma is
  // the larger of two estimates, one of which rests on six time blocks and scatters by 30 %: hence
  // [0.5, 2]. With sigmas wrong by a factor of 1.5 the mean square would leave it.
  const int recordings = 10;
  double mean_square = 0.0;
  for (uint32_t seed = 1; seed <= recordings; ++seed) {
    SimulatorOptions truth = Recording(Motion::kHandheld, 12.0, seed);
    truth.position_std = truth.rotation_std = 1e-4;
    const Calibration result = Calibrate(GpOptions(), Simulate(truth));
    const Vector8d z = Error(result, truth).cwiseQuotient(Sigma(result));
    EXPECT_LT(z.cwiseAbs().maxCoeff(), 4.5) << "seed " << seed;
    mean_square += z.squaredNorm() / (8.0 * recordings);
  }
  EXPECT_GT(mean_square, 0.5);
  EXPECT_LT(mean_square, 2.0);
}

TEST(Calibration, LeavesOutSamplesInTheGapOfAJump) {
  SimulatorOptions truth = Recording(Motion::kHandheld, 20.0, 61);
  truth.pose_rate_hz = 200.0;
  SessionData data = Simulate(truth);
  for (PoseSample& pose : data.poses)
    if (pose.t_ns > data.poses.front().t_ns + 10'000'000'000) pose.p_WM.x() += 0.5;
  const Calibration result = ExpectCalibrates(GpOptions(), data, truth);
  EXPECT_EQ(result.sessions[0].jumps, 1u);
}

TEST(Calibrate, TakesStreamsOfDifferentRates) {
  SimulatorOptions truth = Recording(Motion::kHandheld, 10.0, 6);
  truth.pose_rate_hz = 300.0;
  truth.gyro_rate_hz = 400.0;
  truth.accel_rate_hz = 250.0;
  const Calibration result = ExpectCalibrates(GpOptions(), Simulate(truth), truth);
  EXPECT_NEAR(result.sessions[0].poses.rate_hz, 300.0, 0.1);
  EXPECT_NEAR(result.sessions[0].imus[0].gyro.rate_hz, 400.0, 0.1);
  EXPECT_NEAR(result.sessions[0].imus[0].accel.rate_hz, 250.0, 0.1);
}

TEST(Calibrate, TakesABiasKnotAtEverySample) {
  const SimulatorOptions truth = Recording(Motion::kTumble, 6.0, 7);
  CalibrationOptions options = GpOptions();
  options.bias_knot_interval_s = 0.0;
  ExpectCalibrates(options, Simulate(truth), truth, 3e-3);
}

TEST(Calibrate, TakesClocksThatAreTwelveDaysApart) {
  for (const double sign : {-1.0, 1.0}) {
    SimulatorOptions truth = Recording(Motion::kHandheld, 10.0, 8);
    truth.time_shift_s = sign * (12.0 * 86400.0 + 0.0123456);
    const Calibration result = ExpectCalibrates(GpOptions(), Simulate(truth), truth);
    EXPECT_LT(result.sessions[0].imus[0].time_shift_std, 1e-3);
  }
}

TEST(Calibrate, KeepsAFixedAccelDelay) {
  SimulatorOptions truth = Recording(Motion::kHandheld, 10.0, 9);
  truth.accel_delay_s = -0.0123;
  CalibrationOptions options = GpOptions();
  options.estimate_accel_delay = false;
  options.accel_delay = -0.0123;
  const Calibration result = ExpectCalibrates(options, Simulate(truth), truth);
  EXPECT_EQ(result.imus[0].accel_delay, -0.0123);
  EXPECT_EQ(result.imus[0].accel_delay_std, 0.0);
}

TEST(Calibrate, EndsAtTheSameResultFromInitialValues) {
  const SimulatorOptions truth = Recording(Motion::kHandheld, 10.0, 10);
  const SessionData data = Simulate(truth);
  const Calibration plain = ExpectCalibrates(GpOptions(), data, truth);
  CalibrationOptions options = GpOptions();
  options.initial_time_shift = truth.time_shift_s + 0.3;
  options.initial_rotation = truth.T_MI.q * Exp(Vector3d(0.1, -0.1, 0.05));
  options.initial_translation = truth.T_MI.p + Vector3d(0.02, 0.01, -0.03);
  const Calibration result = ExpectCalibrates(options, data, truth);
  // The start enters the weights through the lever arm: same result, not same digits.
  const Vector8d difference = Error(result, truth) - Error(plain, truth);
  EXPECT_LT(difference.cwiseQuotient(Sigma(plain)).cwiseAbs().maxCoeff(), 0.2);
}

/// However wrong, and with both methods.
TEST(Calibrate, NoGuessOfTheTransformLeadsAstray) {
  const SimulatorOptions truth = Recording(Motion::kHandheld, 10.0, 10);
  const SessionData data = Simulate(truth);
  for (const Method method : {Method::kGp, Method::kJoint}) {
    CalibrationOptions options = GpOptions();
    options.method = method;
    const Calibration plain = Calibrate(options, data);
    for (const Vector3d& turn : {Vector3d(M_PI, 0.0, 0.0), Vector3d(0.0, 1.0, -2.0)}) {
      options.initial_rotation = truth.T_MI.q * Exp(turn);
      options.initial_translation = truth.T_MI.p + Vector3d(0.6, -0.7, 0.3);
      const Calibration result = Calibrate(options, data);
      EXPECT_EQ(result.imus[0].T_MI.Matrix(), plain.imus[0].T_MI.Matrix());
      EXPECT_EQ(result.sessions[0].imus[0].time_shift, plain.sessions[0].imus[0].time_shift);
    }
  }
}

TEST(Calibrate, IsAFunctionOfItsInput) {
  const SessionData data = Simulate(Recording(Motion::kHandheld, 8.0, 11));
  const Calibration a = Calibrate(GpOptions(), data), b = Calibrate(GpOptions(), data);
  EXPECT_EQ(a.imus[0].T_MI.Matrix(), b.imus[0].T_MI.Matrix());
  EXPECT_EQ(a.sessions[0].imus[0].time_shift, b.sessions[0].imus[0].time_shift);
  EXPECT_EQ(a.imus[0].covariance, b.imus[0].covariance);
}

TEST(Calibrate, DoesNotDependOnTheChoiceOfTheWorldFrame) {
  // A world that is turned and moved turns g_W and changes nothing else.
  const SimulatorOptions truth = Recording(Motion::kHandheld, 8.0, 12);
  SessionData data = Simulate(truth);
  const Calibration plain = Calibrate(GpOptions(), data);
  const Quaterniond q_VW = Exp(Vector3d(0.7, -1.1, 0.4));
  for (PoseSample& pose : data.poses) {
    pose.q_WM = q_VW * pose.q_WM;
    pose.p_WM = q_VW * pose.p_WM + Vector3d(100.0, -50.0, 3.0);
  }
  const Calibration turned = Calibrate(GpOptions(), data);
  const Vector8d difference = Error(turned, truth) - Error(plain, truth);
  EXPECT_LT(difference.cwiseQuotient(Sigma(plain)).cwiseAbs().maxCoeff(), 0.05);
  EXPECT_LT((turned.sessions[0].g_W - q_VW * plain.sessions[0].g_W).norm(), 1e-3);
}

TEST(Calibrate, NamesTheTurnThatAPlanarMotionLacks) {
  const Calibration result = Calibrate(GpOptions(), Simulate(Recording(Motion::kPlanar, 12.0, 13)));
  EXPECT_EQ(result.status, Status::kDegenerate);
  EXPECT_FALSE(result.IsUsable());
  ASSERT_FALSE(result.unobservable.empty());
  EXPECT_TRUE(Contains(result.unobservable[0], "p_MI along marker z"));
  EXPECT_TRUE(Contains(result.unobservable[0], "second axis"));
  EXPECT_TRUE(Contains(result.message, "one axis only, marker z"));
}

TEST(Calibrate, NamesTheTurnThatAHingeLacks) {
  const Calibration result = Calibrate(GpOptions(), Simulate(Recording(Motion::kHinge, 12.0, 14)));
  EXPECT_EQ(result.status, Status::kDegenerate);
  ASSERT_FALSE(result.unobservable.empty());
  EXPECT_TRUE(Contains(result.unobservable[0], "p_MI along marker x"));
  EXPECT_TRUE(Contains(result.message, "turn the marker about at least two axes"));
}

TEST(Calibrate, AsksForTurnsWhenTheMarkerRests) {
  const Calibration result = Calibrate(GpOptions(), Simulate(Recording(Motion::kStatic, 12.0, 15)));
  EXPECT_EQ(result.status, Status::kDegenerate);
  EXPECT_FALSE(result.IsUsable());
  ASSERT_FALSE(result.unobservable.empty());
  EXPECT_TRUE(Contains(result.unobservable[0], "R_MI, p_MI and time_shift"));
  EXPECT_TRUE(Contains(result.message, "does not turn"));
  EXPECT_EQ(result.sessions[0].poses.received,
            1200u);  // what was received is reported all the same
}

TEST(Calibrate, TakesGapsFrozenPosesAndOutliers) {
  const SimulatorOptions truth = Recording(Motion::kHandheld, 10.0, 16);
  SessionData data = Simulate(truth);
  std::mt19937 random(16);
  for (const size_t i : {37u, 104u, 180u, 251u, 377u, 445u, 446u, 583u, 719u, 888u}) {  // 1 %
    data.poses[i].p_WM += 0.1 * RandomAxis(&random);
    data.poses[i].q_WM = data.poses[i].q_WM * Exp(Vector3d(M_PI / 9.0 * RandomAxis(&random)));
  }
  for (size_t i = 301; i < 304; ++i) {
    data.poses[i].p_WM = data.poses[300].p_WM;
    data.poses[i].q_WM = data.poses[300].q_WM;
  }
  data.poses.erase(data.poses.begin() + 600, data.poses.begin() + 650);
  const Calibration result = ExpectCalibrates(GpOptions(), data, truth, 3e-3);
  EXPECT_EQ(result.sessions[0].gaps, 1u);
  EXPECT_EQ(result.sessions[0].segments, 2u);
  EXPECT_EQ(result.sessions[0].poses.repeated_value, 3u);
  EXPECT_GE(result.sessions[0].poses.outlier, 10u);
  EXPECT_LE(result.sessions[0].poses.outlier, 12u);
  EXPECT_EQ(result.sessions[0].poses.received, 950u);
  EXPECT_EQ(result.sessions[0].poses.used + result.sessions[0].poses.repeated_value +
                result.sessions[0].poses.outlier,
            950u);
}

TEST(Calibrate, WithstandsGrossImuOutliers) {
  const SimulatorOptions truth = Recording(Motion::kHandheld, 10.0, 17);
  SessionData data = Simulate(truth);
  std::mt19937 random(17);
  for (size_t i = 0; i < data.imus[0].gyro.size(); i += 100)
    data.imus[0].gyro[i].value += RandomAxis(&random);
  for (size_t i = 50; i < data.imus[0].accel.size(); i += 100)
    data.imus[0].accel[i].value += 10.0 * RandomAxis(&random);
  ExpectCalibrates(GpOptions(), data, truth);
}

TEST(Calibrate, RefusesBadOptionsBeforeItLooksAtTheData) {
  CalibrationOptions options = GpOptions();
  options.gravity_magnitude = -9.8;
  EXPECT_TRUE(Contains(ErrorText<InputError>([&] { Calibrate(options, SessionData()); }),
                       "gravity_magnitude"));
}

TEST(Calibrate, RefusesDataWithoutOverlap) {
  SessionData data = Simulate(Recording(Motion::kHandheld, 12.0, 18));
  const SessionData other = Simulate(Recording(Motion::kHandheld, 12.0, 19));
  data.imus[0].gyro = other.imus[0].gyro;
  data.imus[0].accel = other.imus[0].accel;
  EXPECT_TRUE(Contains(ErrorText<DataError>([&] { Calibrate(GpOptions(), data); }),
                       "agree at no time shift"));
}

TEST(Calibrate, SaysWhenTheSolveDidNotConverge) {
  CalibrationOptions options = GpOptions();
  options.max_iterations = 1;
  const SessionData data = Simulate(Recording(Motion::kHandheld, 8.0, 20));
  EXPECT_TRUE(
      Contains(ErrorText<DataError>([&] { Calibrate(options, data); }), "max_iterations = 1"));
}

}  // namespace
}  // namespace imu_pose_calib
