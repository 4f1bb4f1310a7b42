#include <gtest/gtest.h>

#include "faults.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/start/data_check.h"
#include "imu_pose_calib/core/start/preparation.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

SimulatorOptions Truth(Motion motion = Motion::kHandheld, uint32_t seed = 51) {
  SimulatorOptions options;
  options.motion = motion;
  options.duration_s = 20.0;
  options.seed = seed;
  return options;
}

DataCheck Check(const SessionData& data, StampRecovery recover_stamps = StampRecovery::kAuto) {
  CalibrationOptions options;
  options.recover_stamps = recover_stamps;
  return CheckData(options, data);
}

/// Expects a usable recording with one warning that holds every part.
void ExpectWarning(const DataCheck& check, const std::vector<std::string>& parts) {
  EXPECT_EQ(check.verdict, DataVerdict::kUsable) << check.message;
  ASSERT_EQ(check.warnings.size(), 1u) << ::testing::PrintToString(check.warnings);
  for (const std::string& part : parts) EXPECT_TRUE(Contains(check.warnings[0], part));
}

TEST(CheckData, HasNothingToRemarkOnGoodRecordings) {
  for (const Motion motion : {Motion::kHandheld, Motion::kTumble}) {
    for (const double noise : {1e-4, 5e-3}) {
      for (const double rate_hz : {10.0, 100.0, 250.0}) {
        SCOPED_TRACE(std::string(ToString(motion)) + " " + std::to_string(noise) + " " +
                     std::to_string(rate_hz));
        SimulatorOptions truth = Truth(motion);
        truth.position_std = truth.rotation_std = noise;
        truth.pose_rate_hz = rate_hz;
        truth.time_shift_s = 7200.25;
        const DataCheck check = Check(Simulate(truth));
        EXPECT_EQ(check.verdict, DataVerdict::kGood) << ::testing::PrintToString(check.warnings);
        EXPECT_TRUE(check.warnings.empty());
        EXPECT_TRUE(check.imus[0].is_matched);
        EXPECT_NEAR(check.imus[0].time_shift, 7200.25, 1e-3);
        EXPECT_NEAR(check.imus[0].overlap_s, 19.8, 0.21);
        EXPECT_GT(check.imus[0].explained, 0.99);
        EXPECT_LT(std::abs(check.imus[0].drift_ppm), 5.0 * check.imus[0].drift_ppm_std);
        EXPECT_NEAR(check.poses.rate_hz, rate_hz, 1e-3);
        EXPECT_NEAR(check.imus[0].gyro.rate_hz, 200.0, 1e-3);
        EXPECT_LT(check.imus[0].gyro.jitter_s, 1e-6);
        EXPECT_LT(check.poses.missing, 1e-9);
      }
    }
  }
}

TEST(CheckData, MeasuresTheExcitationOfEachAxis) {
  const SimulatorOptions truth = Truth();
  const TrueTrajectory trajectory(truth);
  Eigen::Vector3d turns = Eigen::Vector3d::Zero(), moves = turns, mean_turn = turns, mean = turns;
  const int n = 2000;
  for (int i = 0; i < n; ++i) {
    const TrueState s = trajectory.At(truth.duration_s * i / n);
    turns += s.omega_M.cwiseAbs2() / n;
    moves += s.a_W.cwiseAbs2() / n;
    mean_turn += s.omega_M / n;
    mean += s.a_W / n;
  }
  turns = (turns - mean_turn.cwiseAbs2()).cwiseSqrt();
  moves = (moves - mean.cwiseAbs2()).cwiseSqrt();
  const DataCheck check = Check(Simulate(truth));
  EXPECT_LT((check.turns_M - turns).norm(), 0.02 * turns.norm());
  EXPECT_LT((check.moves_W - moves).norm(), 0.02 * moves.norm());
}

TEST(CheckData, MeasuresTheDriftOfTheClocks) {
  for (const double ppm : {-300.0, 80.0}) {
    SessionData data = Simulate(Truth());
    Drift(ppm, &data.imus[0]);
    CalibrationOptions without;
    without.estimate_clock_drift = false;
    const DataCheck check = CheckData(without, data);
    EXPECT_NEAR(check.imus[0].drift_ppm, ppm, 5.0 * check.imus[0].drift_ppm_std);
    EXPECT_LT(check.imus[0].drift_ppm_std, 10.0);
    ExpectWarning(check, {"drift", "ppm", "set estimate_clock_drift: true"});
  }
  const CalibrationOptions options;
  SessionData data = Simulate(Truth());
  Drift(100.0, &data.imus[0]);
  EXPECT_EQ(CheckData(options, data).verdict, DataVerdict::kGood);
}

TEST(CheckData, WarnsOfStampsByTimeOfArrival) {
  SessionData data = Simulate(Truth());
  for (size_t i = 0; i < data.imus[0].gyro.size(); ++i)  // four at a time, 0.1 ms apart
    data.imus[0].gyro[i].t_ns =
        data.imus[0].gyro[i - i % 4].t_ns + 100'000 * static_cast<int64_t>(i % 4);
  DataCheck check = Check(data, StampRecovery::kNever);
  EXPECT_NEAR(check.imus[0].gyro.bunched, 0.75, 0.01);
  EXPECT_NEAR(check.imus[0].gyro.rate_hz, 200.0, 1.0);
  ExpectWarning(check, {"gyroscope", "bunches", "as recorded", "sensor's own clock"});
  check = Check(data);
  EXPECT_EQ(check.verdict, DataVerdict::kGood) << ::testing::PrintToString(check.warnings);
  EXPECT_TRUE(check.imus[0].gyro.report.stamps_recovered);
  EXPECT_NEAR(check.imus[0].gyro.bunched, 0.75, 0.01);
  EXPECT_NEAR(check.imus[0].gyro.rate_hz, 200.0, 0.1);
}

TEST(CheckData, RefusesBunchesThatNoClockFits) {
  SimulatorOptions truth = Truth();
  truth.effects.imu_stream.burst = 8.0;
  const DataCheck check = Check(Simulate(truth), StampRecovery::kNever);
  EXPECT_EQ(check.verdict, DataVerdict::kRecordAgain);
  EXPECT_NE(check.message.find("stamped in bunches (bound: 80 %)"), std::string::npos)
      << check.message;
  EXPECT_NEAR(check.imus[0].gyro.bunched, 7.0 / 8.0, 0.01);
}

TEST(CheckData, WarnsOfStampsThatJitter) {
  SessionData data = Simulate(Truth());
  std::mt19937 random(1);
  for (ImuSample& s : data.imus[0].accel)
    s.t_ns += std::uniform_int_distribution<int64_t>(-2'400'000, 2'400'000)(random);
  ExpectWarning(Check(data, StampRecovery::kNever),
                {"accelerometer", "jitter", "of the period of", "as recorded"});
  const DataCheck check = Check(data);
  EXPECT_EQ(check.verdict, DataVerdict::kGood) << ::testing::PrintToString(check.warnings);
  EXPECT_NEAR(check.imus[0].accel.report.stamp_jitter_s, 1.39e-3, 5e-5);
}

TEST(CheckData, WarnsOfLostSamples) {
  SessionData data = Simulate(Truth());
  LosePackets(0.15, 1, &data.imus[0].gyro);
  const DataCheck check = Check(data);
  EXPECT_NEAR(check.imus[0].gyro.missing, 0.15, 0.05);
  EXPECT_GE(check.imus[0].gyro.longest_gap_s, 0.05);
  ExpectWarning(check, {"gyroscope", "missing", "longest gap"});
}

TEST(CheckData, WarnsOfAFrozenTracker) {
  SessionData data = Simulate(Truth());
  Freeze(5.0, 8.0, &data);
  const DataCheck check = Check(data);
  EXPECT_NEAR(check.poses.repeated, 0.15, 0.01);
  EXPECT_NEAR(check.poses.longest_freeze_s, 3.0, 0.05);
  EXPECT_EQ(check.gaps, 1u);
  ExpectWarning(check, {"pose", "repeat the value before", "for up to"});
}

TEST(CheckData, WarnsOfSwappedLabelsSaturationAndOutliers) {
  SessionData flipped = Simulate(Truth()), clipped = flipped, spoiled = flipped;
  SwapLabels(5.0, 8.0, Eigen::Quaterniond(0.0, 1.0, 0.0, 0.0), &flipped);
  ExpectWarning(Check(flipped), {"300 poses that turn against the gyroscope", "symmetrically"});
  double peak = 0.0;
  for (const ImuSample& s : clipped.imus[0].gyro)
    peak = std::max(peak, s.value.cwiseAbs().maxCoeff());
  Clip(0.85 * peak, &clipped.imus[0].gyro);
  ExpectWarning(Check(clipped), {"gyroscope", "end of the sensor's range"});
  AddOutliers(0.05, 1, &spoiled);
  ExpectWarning(Check(spoiled), {"pose", "outliers"});
}

TEST(CheckData, WarnsOfAWrongScaleSeenAtRest) {
  SimulatorOptions truth = Truth();
  SessionData data = Simulate(truth);
  truth.motion = Motion::kStatic;
  const SessionData rest = Simulate(truth);  // 20 s before the motion, on the same clocks
  const int64_t shift_ns = 20'000'000'000;
  const auto prepend = [&](const std::vector<ImuSample>& before, std::vector<ImuSample>* samples) {
    std::vector<ImuSample> all = before;
    for (ImuSample& s : all) s.t_ns -= shift_ns;
    all.insert(all.end(), samples->begin(), samples->end());
    *samples = all;
  };
  prepend(rest.imus[0].gyro, &data.imus[0].gyro);
  prepend(rest.imus[0].accel, &data.imus[0].accel);
  DataCheck check = Check(data);
  EXPECT_NEAR(check.imus[0].rest_s, 20.0, 0.5);
  EXPECT_NEAR(check.imus[0].rest_norm, 9.80665, 0.1);
  EXPECT_EQ(check.verdict, DataVerdict::kGood) << ::testing::PrintToString(check.warnings);
  for (ImuSample& s : data.imus[0].accel) s.value *= 1.08;
  ExpectWarning(Check(data), {"norm at rest", "bound: within 5 % of gravity_magnitude"});
}

TEST(CheckMotion, FindsTheSameRestWhereverTimeIsZero) {
  const CalibrationOptions options;
  ConditionedData data = ConditionData(options, Simulate(Truth(Motion::kStatic)));
  const PoseTrajectory trajectory = FitTrajectory(options, &data);
  for (std::vector<TimedSample>* samples : {&data.imus[0].gyro, &data.imus[0].accel})
    for (TimedSample& s : *samples) s.t -= 10.0;
  DataCheck check;
  check.imus.resize(1);
  CheckMotion(options, data, trajectory, false, &check);
  EXPECT_NEAR(check.imus[0].rest_s, 20.0, 0.5);
}

TEST(CheckData, RefusesOneValueForTwoImus) {
  const SessionData data = Simulate(Truth(), 2);
  CalibrationOptions options;
  options.estimate_time_shift = options.estimate_rotation = false;
  options.initial_time_shift = 0.0;
  options.initial_rotation = Eigen::Quaterniond::Identity();
  EXPECT_TRUE(Contains(ErrorText<InputError>([&] { CheckData(options, data); }),
                       "estimate_rotation = false needs a single imu"));
  options.estimate_rotation = true;
  EXPECT_TRUE(Contains(ErrorText<InputError>([&] { CheckData(options, data); }),
                       "estimate_time_shift = false needs a single imu and recording"));
}

TEST(CheckData, AsksToRecordAgainWithTheReasonAndKeepsTheTable) {
  SessionData data = Simulate(Truth());
  for (ImuSample& s : data.imus[0].gyro) s.value *= 180.0 / M_PI;
  DataCheck check = Check(data);
  EXPECT_EQ(check.verdict, DataVerdict::kUsable);
  EXPECT_TRUE(Contains(check.message, "set gyro_unit: 0.0174532925"));
  EXPECT_EQ(check.imus[0].gyro.count, 4000u);
  EXPECT_FALSE(check.imus[0].is_matched);

  check = Check(Simulate(Truth(Motion::kPlanar)));
  EXPECT_EQ(check.verdict, DataVerdict::kRecordAgain);
  EXPECT_TRUE(Contains(check.message, "one axis only"));
  EXPECT_GT(check.turns_M.z(), 0.1);

  check = Check(SessionData());
  EXPECT_EQ(check.verdict, DataVerdict::kRecordAgain);
  EXPECT_TRUE(Contains(check.message, "no pose samples"));
}

TEST(CheckData, HandsItsWarningsToTheCalibration) {
  CalibrationOptions options;
  options.method = Method::kGp;
  options.num_threads = 1;
  SessionData data = Simulate(Truth());
  EXPECT_TRUE(Calibrate(options, data).warnings.empty());
  Freeze(5.0, 8.0, &data);
  const std::vector<std::string> warnings = Calibrate(options, data).warnings;
  ASSERT_EQ(warnings.size(), 1u) << ::testing::PrintToString(warnings);
  EXPECT_EQ(warnings, Check(data).warnings);
}

TEST(CheckData, WarnsOfAHeldDriftInACalibrationToo) {
  CalibrationOptions options;
  options.num_threads = 1;
  options.estimate_clock_drift = false;
  SessionData data = Simulate(Truth());
  Drift(300.0, &data.imus[0]);
  const std::vector<std::string> warnings = Calibrate(options, data).warnings;
  EXPECT_EQ(std::count_if(warnings.begin(), warnings.end(),
                          [](const std::string& w) { return Contains(w, "estimate_clock_drift"); }),
            1)
      << ::testing::PrintToString(warnings);
}

}  // namespace
}  // namespace imu_pose_calib
