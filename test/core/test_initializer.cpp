#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>

#include "faults.h"
#include "imu_pose_calib/core/start/initializer.h"
#include "imu_pose_calib/core/start/rate_alignment.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using Eigen::Vector3d;

constexpr double kDegree = M_PI / 180.0;

SimulatorOptions Recording(double duration_s, uint32_t seed) {
  SimulatorOptions options;
  options.duration_s = duration_s;
  options.seed = seed;
  options.T_MI = {Eigen::Quaterniond(0.3, -0.5, 0.1, 0.8).normalized(), {0.06, -0.11, 0.09}};
  return options;
}

/// Conditioned data with its trajectory.
struct Fitted {
  ConditionedData data;
  PoseTrajectory trajectory;

  Fitted(const SessionData& recording, const CalibrationOptions& options)
      : data(ConditionData(options, recording)), trajectory(FitTrajectory(options, &data)) {}
};

/// The time shift between the conditioned stamps that the simulator put in.
double TrueShift(const ConditionedData& data, const SimulatorOptions& options) {
  const int64_t shift_ns = std::llround(1e9 * options.time_shift_s);
  return 1e-9 * static_cast<double>(shift_ns - (data.pose_epoch_ns - data.imus[0].epoch_ns));
}

void ExpectCloseToTruth(const Start& start, const ConditionedData& data,
                        const SimulatorOptions& options) {
  EXPECT_NEAR(start.time_shift, TrueShift(data, options), 5e-4);
  EXPECT_LT(start.q_MI.angularDistance(options.T_MI.q), 2.0 * kDegree);
  EXPECT_LT((start.p_MI - options.T_MI.p).norm(), 0.01) << start.p_MI.transpose();
  EXPECT_NEAR(start.accel_delay, options.accel_delay_s, 5e-4);
  EXPECT_LT((start.g_W - options.g_W).norm(), 0.2);
  EXPECT_NEAR(start.g_W.norm(), options.g_W.norm(), 1e-9);
  EXPECT_LT((start.gyro_bias - options.gyro_bias).norm(), 0.02);
  EXPECT_LT((start.accel_bias - options.accel_bias).norm(), 0.2);
}

Start InitialiseOn(const SessionData& recording, const SimulatorOptions& truth,
                   const CalibrationOptions& options = CalibrationOptions()) {
  const Fitted fitted(recording, options);
  const Start start = Initialise(options, fitted.trajectory, fitted.data, 0);
  ExpectCloseToTruth(start, fitted.data, truth);
  return start;
}

std::string Refusal(const SessionData& recording,
                    const CalibrationOptions& options = CalibrationOptions()) {
  const Fitted fitted(recording, options);
  return ErrorText<DataError>([&] { Initialise(options, fitted.trajectory, fitted.data, 0); });
}

TEST(Initialise, FindsClocksThatAreDaysApart) {
  constexpr double kDay = 86400.0;
  for (const double shift : {-12.0 * kDay, -3600.0, -1.0, 0.0, 0.5, 3600.0, 12.0 * kDay + 0.1234}) {
    SCOPED_TRACE(shift);
    SimulatorOptions options = Recording(12.0, 1);
    options.time_shift_s = shift;
    InitialiseOn(Simulate(options), options);
  }
}

TEST(Initialise, FindsTheCalibrationOfManyMotions) {
  for (uint32_t seed = 2; seed <= 5; ++seed) {
    SCOPED_TRACE(seed);
    SimulatorOptions options = Recording(15.0, seed);
    options.motion = seed % 2 == 0 ? Motion::kHandheld : Motion::kTumble;
    InitialiseOn(Simulate(options), options);
  }
}

TEST(Initialise, FindsALateOrEarlyAccelerometer) {
  for (const double delay : {-0.045, 0.045}) {
    SCOPED_TRACE(delay);
    SimulatorOptions options = Recording(15.0, 6);
    options.accel_delay_s = delay;
    InitialiseOn(Simulate(options), options);
  }
}

TEST(Initialise, KeepsAFixedAccelDelay) {
  SimulatorOptions options = Recording(12.0, 6);
  options.accel_delay_s = 0.033;
  CalibrationOptions calibration;
  calibration.estimate_accel_delay = false;
  calibration.accel_delay = 0.033;
  EXPECT_EQ(InitialiseOn(Simulate(options), options, calibration).accel_delay, 0.033);
}

TEST(Initialise, FindsTheImuLogInsideOfALongerPoseLog) {
  const SimulatorOptions options = Recording(40.0, 7);
  SessionData data = Simulate(options);
  const auto cut = [](std::vector<ImuSample>* s) {
    *s = std::vector<ImuSample>(s->begin() + 200 * 23, s->begin() + 200 * 33);
  };
  cut(&data.imus[0].gyro);
  cut(&data.imus[0].accel);
  InitialiseOn(data, options);
}

TEST(Initialise, FindsThePoseLogInsideOfALongerImuLog) {
  const SimulatorOptions options = Recording(40.0, 8);
  SessionData data = Simulate(options);
  data.poses = std::vector<PoseSample>(data.poses.begin() + 700, data.poses.begin() + 1700);
  InitialiseOn(data, options);
}

TEST(Initialise, FindsLogsThatOverlapAtTheirEndsOnly) {
  const SimulatorOptions options = Recording(40.0, 9);
  SessionData data = Simulate(options);
  data.poses.resize(2400);  // first 24 s
  data.imus[0].gyro.erase(data.imus[0].gyro.begin(), data.imus[0].gyro.begin() + 200 * 14);
  data.imus[0].accel.erase(data.imus[0].accel.begin(), data.imus[0].accel.begin() + 200 * 14);
  InitialiseOn(data, options);
}

TEST(Initialise, TakesTheTransformThatIsGivenWhereItIsNotEstimated) {
  SimulatorOptions options = Recording(12.0, 10);
  options.time_shift_s = -777.77;
  CalibrationOptions calibration;
  calibration.initial_time_shift = -777.5;
  calibration.initial_rotation =
      options.T_MI.q * Eigen::Quaterniond(Eigen::AngleAxisd(kDegree, Vector3d::UnitX()));
  calibration.initial_translation = options.T_MI.p + Vector3d(0.001, 0.002, 0.003);
  const SessionData data = Simulate(options);
  const Start guessed = InitialiseOn(data, options, calibration);
  EXPECT_GT(guessed.q_MI.angularDistance(*calibration.initial_rotation), 1e-6);
  EXPECT_NE(guessed.p_MI, *calibration.initial_translation);
  calibration.estimate_rotation = calibration.estimate_translation = false;
  const Start given = InitialiseOn(data, options, calibration);
  EXPECT_LT(given.q_MI.angularDistance(*calibration.initial_rotation), 1e-9);
  EXPECT_EQ(given.p_MI, *calibration.initial_translation);
}

TEST(Initialise, SearchesOneSecondAroundAGuess) {
  const SimulatorOptions options = Recording(20.0, 11);
  const Fitted fitted(Simulate(options), CalibrationOptions());
  const double truth = TrueShift(fitted.data, options);
  for (const double guess : {truth - 0.7, truth + 0.7, truth + 4.0, truth - 4.0}) {
    const auto shifts = FindTimeShifts(fitted.trajectory, fitted.data.imus[0].gyro, 5.0, guess, 6);
    for (const double shift : shifts) EXPECT_NEAR(shift, guess, 1.0 + 0.01);
    const bool found = std::any_of(shifts.begin(), shifts.end(),
                                   [&](double s) { return std::abs(s - truth) < 5e-3; });
    EXPECT_EQ(found, std::abs(guess - truth) < 1.0) << "guess " << guess;
  }
  CalibrationOptions calibration;
  calibration.initial_time_shift = options.time_shift_s + 4.0;
  EXPECT_TRUE(Contains(Refusal(Simulate(options), calibration), "agree at no time shift"));
}

TEST(Initialise, RefusesRecordingsOfDifferentMotions) {
  for (uint32_t seed = 12; seed <= 14; ++seed) {
    SCOPED_TRACE(seed);
    SessionData data = Simulate(Recording(15.0, seed));
    const SessionData other = Simulate(Recording(15.0, seed + 100));
    data.imus[0].gyro = other.imus[0].gyro;
    data.imus[0].accel = other.imus[0].accel;
    const std::string text = Refusal(data);
    EXPECT_TRUE(Contains(text, "agree at no time shift"));
    EXPECT_TRUE(Contains(text, "bound: 50 %"));
    EXPECT_TRUE(Contains(text, "do both recordings overlap"));
  }
}

TEST(Initialise, RefusesAGyroscopeInDegrees) {
  SessionData data = Simulate(Recording(12.0, 15));
  for (ImuSample& s : data.imus[0].gyro) s.value /= kDegree;
  const std::string text = Refusal(data);
  EXPECT_TRUE(Contains(text, "gyroscope: its rates are 57."));
  EXPECT_TRUE(Contains(text, "bound: 0.5 to 2"));
  EXPECT_TRUE(Contains(text, "deg/s"));
}

TEST(RemoveFlippedSegments, TakesNoGuessOfAnotherImu) {
  const SimulatorOptions options = Recording(20.0, 20);
  SessionData data = Simulate(options, 2);
  SwapLabels(5.0, 8.0, Eigen::Quaterniond(0.0, 1.0, 0.0, 0.0), &data);
  data.imus[0] = ImuData();  // the session lacks the first IMU, which the guess is of
  Fitted fitted(data, CalibrationOptions());
  CalibrationOptions calibration;
  calibration.initial_time_shift = options.time_shift_s;
  RemoveFlippedSegments(calibration, &fitted.trajectory, &fitted.data);
  EXPECT_EQ(fitted.data.pose_report.flipped, 300u);
}

TEST(FindTimeShifts, ReturnsTheBestFirstAndNoTwoNeighbours) {
  const SimulatorOptions options = Recording(15.0, 16);
  const Fitted fitted(Simulate(options), CalibrationOptions());
  const auto shifts =
      FindTimeShifts(fitted.trajectory, fitted.data.imus[0].gyro, 5.0, std::nullopt, 4);
  ASSERT_EQ(shifts.size(), 4u);
  EXPECT_NEAR(shifts[0], TrueShift(fitted.data, options), 2e-4);  // bins of 10 ms
  for (size_t i = 0; i < shifts.size(); ++i)
    for (size_t k = 0; k < i; ++k) EXPECT_GT(std::abs(shifts[i] - shifts[k]), 0.1);
}

TEST(FindTimeShifts, OffersNoOverlapBelowTheMinimum) {
  const Fitted fitted(Simulate(Recording(15.0, 17)), CalibrationOptions());
  const auto find = [&](double overlap) {
    return FindTimeShifts(fitted.trajectory, fitted.data.imus[0].gyro, overlap, std::nullopt, 50);
  };
  for (const double shift : find(12.0)) EXPECT_LT(std::abs(shift), 3.1);
  double largest = 0.0;
  for (const double shift : find(5.0)) largest = std::max(largest, std::abs(shift));
  EXPECT_GT(largest, 3.1);
  EXPECT_TRUE(find(16.0).empty());
  // A pause is not in common.
  std::vector<TimedSample> paused = fitted.data.imus[0].gyro;
  paused.push_back(paused.back());
  paused.back().t += 500.0;
  EXPECT_TRUE(FindTimeShifts(fitted.trajectory, paused, 16.0, std::nullopt, 50).empty());
}

TEST(FindTimeShifts, ASlowGyroscopeOverlapsAsLongAsAFastOne) {
  SimulatorOptions options = Recording(8.0, 19);
  options.gyro_rate_hz = 40.0;
  const Fitted fitted(Simulate(options), {});
  const auto shifts =
      FindTimeShifts(fitted.trajectory, fitted.data.imus[0].gyro, 5.0, std::nullopt, 4);
  ASSERT_FALSE(shifts.empty());
  EXPECT_NEAR(shifts[0], TrueShift(fitted.data, options), 2e-3);
}

TEST(AlignRates, RecoversRotationAndBiasAtTheTrueShift) {
  SimulatorOptions options = Recording(15.0, 18);
  options.gyro_bias << 0.1, -0.05, 0.2;
  const Fitted fitted(Simulate(options), CalibrationOptions());
  const double truth = TrueShift(fitted.data, options);
  const RateAlignment at_truth =
      AlignRates(fitted.trajectory, fitted.data.imus[0].gyro, {truth}, false, 1);
  EXPECT_LT(at_truth.q_MI.angularDistance(options.T_MI.q), 0.1 * kDegree);
  EXPECT_LT((at_truth.gyro_bias - options.gyro_bias).norm(), 2e-3);
  EXPECT_NEAR(at_truth.scale, 1.0, 1e-2);
  EXPECT_GT(at_truth.explained, 0.99);
  EXPECT_NEAR(static_cast<double>(at_truth.count), 3000.0, 20.0);

  const RateAlignment off =
      AlignRates(fitted.trajectory, fitted.data.imus[0].gyro, {truth + 3.0}, false, 1);
  EXPECT_LT(off.explained, 0.5);
  EXPECT_NEAR(static_cast<double>(off.count), 2400.0, 20.0);
  EXPECT_EQ(AlignRates(fitted.trajectory, fitted.data.imus[0].gyro, {truth + 20.0}, false, 1).count,
            0u);
}

TEST(FitLeverArm, RecoversLeverArmGravityAndBiasAtTheTrueRotationAndShift) {
  SimulatorOptions options = Recording(15.0, 19);
  options.position_std = options.rotation_std = 1e-4;
  options.g_W = 9.79 * Vector3d(0.3, -0.4, -2.0).normalized();
  const Fitted fitted(Simulate(options), CalibrationOptions());
  Start start;
  start.q_MI = options.T_MI.q;
  start.time_shift = TrueShift(fitted.data, options);
  FitLeverArm(fitted.trajectory, fitted.data.imus[0].accel, 9.79, false, 2, &start);
  EXPECT_LT((start.p_MI - options.T_MI.p).norm(), 2e-3);
  EXPECT_LT((start.g_W - options.g_W).norm(), 0.03);
  EXPECT_LT((start.accel_bias - options.accel_bias).norm(), 0.03);
  EXPECT_EQ(start.accel_delay, 0.0);
}

}  // namespace
}  // namespace imu_pose_calib
