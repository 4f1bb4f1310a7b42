// Even clocks behind uneven stamps: estimated where they are there, and of use to a calibration.

#include <gtest/gtest.h>
#include <sys/resource.h>

#include <algorithm>
#include <functional>
#include <ostream>
#include <random>

#include "faults.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/core/data/stamp_recovery.h"
#include "imu_pose_calib/core/start/preparation.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using Eigen::Vector3d;

/// [ns]
using StampList = std::vector<int64_t>;

constexpr int64_t kSecond = 1'000'000'000;

/// Stamps of a source of `rate_hz`, slow by `ppm`.
StampList Even(double rate_hz, double duration_s, double ppm = 0.0) {
  StampList t_ns;
  const double period = (1.0 + 1e-6 * ppm) / rate_hz;
  for (double t = 0.0; t < duration_s; t = period * static_cast<double>(t_ns.size()))
    t_ns.push_back(1'600'000'000 * kSecond + 3'456'789 + std::llround(1e9 * t));
  return t_ns;
}

StampList Cut(StampList t_ns, int64_t unit_ns) {
  for (int64_t& t : t_ns) t -= t % unit_ns;
  return t_ns;
}

/// One after the other, each late by an exponential time.
StampList Arrival(StampList t_ns, double mean_s, std::mt19937* random) {
  std::exponential_distribution<double> late(1.0 / mean_s);
  int64_t last = 0;
  for (int64_t& t : t_ns) t = last = std::max(last, t + static_cast<int64_t>(1e9 * late(*random)));
  return t_ns;
}

/// So many at a time with the last of them, 20 us apart.
StampList InBursts(const StampList& t_ns, size_t count) {
  StampList burst = t_ns;
  for (size_t i = 0; i < t_ns.size(); ++i)
    burst[i] = t_ns[std::min(i - i % count + count - 1, t_ns.size() - 1)] +
               20'000 * static_cast<int64_t>(i % count);
  return burst;
}

StampList WithoutSome(const StampList& t_ns, double share, std::mt19937* random) {
  StampList kept;
  for (const int64_t t : t_ns)
    if (std::uniform_real_distribution<double>()(*random) >= share) kept.push_back(t);
  return kept;
}

/// What recovered stamps are off the true ones [s], but for a constant.
struct Error {
  double rms = 0.0, share_off_1ms = 0.0;
};

Error ErrorOf(const StampList& recovered, const StampList& truth) {
  std::vector<double> off;
  for (size_t i = 0; i < truth.size(); ++i)
    off.push_back(1e-9 * static_cast<double>(recovered[i] - truth[i]));
  const double constant = Median(off);
  Error error;
  for (const double e : off) {
    error.rms += std::pow(e - constant, 2) / static_cast<double>(off.size());
    if (std::abs(e - constant) > 1e-3) error.share_off_1ms += 1.0 / static_cast<double>(off.size());
  }
  error.rms = std::sqrt(error.rms);
  return error;
}

/// Expects a clock that is within `rms_s` of the truth.
void ExpectRecovered(const StampList& recorded, const StampList& truth, double rms_s) {
  const auto recovered = RecoverClock(recorded);
  ASSERT_TRUE(recovered.has_value());
  ASSERT_EQ(recovered->size(), truth.size());
  EXPECT_LT(ErrorOf(*recovered, truth).rms, rms_s);
  EXPECT_TRUE(std::is_sorted(recovered->begin(), recovered->end()));
}

TEST(RecoverClock, SeesThroughLatencyJitterAndBursts) {
  for (const double rate_hz : {100.0, 120.0, 200.0}) {
    for (const double ppm : {0.0, 37.0, -100.0}) {
      SCOPED_TRACE(std::to_string(rate_hz) + " Hz " + std::to_string(ppm) + " ppm");
      std::mt19937 random(1);
      const StampList truth = Even(rate_hz, 40.0, ppm);
      ExpectRecovered(Arrival(truth, 3e-3, &random), truth, 1.5e-4);
      StampList jittered = truth;
      for (int64_t& t : jittered)
        t += std::llround(std::normal_distribution<double>(0.0, 2e6)(random));
      ExpectRecovered(jittered, truth, 1.5e-4);
      ExpectRecovered(InBursts(truth, 5), truth, 5e-5);
      ExpectRecovered(InBursts(truth, 8), truth, 1e-4);
    }
  }
}

TEST(RecoverClock, SeesThroughStampsThatAreCut) {
  for (const double rate_hz : {100.0, 120.0, 200.0}) {
    for (const int64_t cut_ms : {1, 4, 10}) {
      SCOPED_TRACE(std::to_string(rate_hz) + " Hz " + std::to_string(cut_ms) + " ms");
      const StampList truth = Even(rate_hz, 40.0);
      ExpectRecovered(Cut(truth, cut_ms * 1'000'000), truth, 2e-5);
      // Between slips of the two grids the phase is hidden within the step of their beat.
      const StampList slow = Even(rate_hz, 40.0, 37.0);
      ExpectRecovered(Cut(slow, cut_ms * 1'000'000), slow, 0.25e-3 * static_cast<double>(cut_ms));
    }
  }
}

TEST(RecoverClock, CountsMissingFrames) {
  std::mt19937 random(2);
  const StampList truth = WithoutSome(Even(100.0, 40.0, 20.0), 0.05, &random);
  ExpectRecovered(Cut(truth, 1'000'000), truth, 3e-4);
  const auto recovered = RecoverClock(Arrival(truth, 3e-3, &random));
  ASSERT_TRUE(recovered.has_value());
  // A sample that comes a period late beside a missing frame may be taken for the other.
  EXPECT_LT(ErrorOf(*recovered, truth).share_off_1ms, 0.015);

  StampList outage;
  for (const int64_t t : Even(120.0, 40.0, 50.0))
    if (t < truth[0] + 15 * kSecond || t > truth[0] + 17 * kSecond) outage.push_back(t);
  ExpectRecovered(Arrival(outage, 3e-3, &random), outage, 1.5e-4);
}

TEST(RecoverClock, StandsDelaysOfHundredsOfMilliseconds) {
  const StampList truth = Even(200.0, 40.0, 20.0);
  std::mt19937 random(3);
  StampList late = Arrival(truth, 5e-4, &random);
  for (size_t i = 300; i < late.size(); i += 700) {
    const int64_t until = late[i] + 300'000'000;
    for (size_t k = i; k < late.size() && late[k] < until; ++k)
      late[k] = until + static_cast<int64_t>(k - i);
  }
  ExpectRecovered(late, truth, 1e-4);
}

TEST(RecoverClock, FollowsAClockThatIsSlewed) {
  StampList truth = Even(200.0, 120.0);
  for (int64_t& t : truth) {  // by 300 ppm between 40 s and 80 s
    const double s = 1e-9 * static_cast<double>(t - truth[0]);
    t += std::llround(0.3e6 * std::clamp(s - 40.0, 0.0, 40.0));
  }
  std::mt19937 random(4);
  ExpectRecovered(Arrival(truth, 3e-3, &random), truth, 2e-4);
}

TEST(RecoverClock, LeavesAnIrregularSourceAlone) {
  std::mt19937 random(6);
  const auto source = [&](const std::function<double()>& interval_s) {
    StampList t_ns;
    double t = 0.0;
    for (int i = 0; i < 4000; ++i) t_ns.push_back(std::llround(1e9 * (t += interval_s())));
    return t_ns;
  };
  std::exponential_distribution<double> poisson(100.0);
  EXPECT_FALSE(RecoverClock(source([&] { return poisson(random); })).has_value());
  for (const double spread_s : {10e-3, 3e-3, 1e-3}) {
    SCOPED_TRACE(spread_s);
    std::uniform_real_distribution<double> loop(10e-3 - spread_s / 2, 10e-3 + spread_s / 2);
    EXPECT_FALSE(RecoverClock(source([&] { return loop(random); })).has_value());
  }
}

TEST(RecoverClock, NeedsSamplesThatAdvance) {
  EXPECT_FALSE(RecoverClock({}).has_value());
  EXPECT_FALSE(RecoverClock(Even(100.0, 0.5)).has_value());
  EXPECT_FALSE(RecoverClock(StampList(1000, kSecond)).has_value());
  StampList rare = Even(100.0, 40.0);
  for (size_t i = 0; i < rare.size(); ++i) rare[i] += static_cast<int64_t>(i) * 20 * kSecond;
  EXPECT_FALSE(RecoverClock(rare).has_value());
}

TEST(AreEven, IsTrueOfCleanStampsOnly) {
  std::mt19937 random(7);
  const StampList clean = Even(120.0, 20.0, 50.0);
  EXPECT_TRUE(AreEven(clean));
  EXPECT_TRUE(AreEven(WithoutSome(clean, 0.05, &random)));
  StampList swapped = clean;
  std::swap(swapped[100], swapped[105]);
  EXPECT_TRUE(AreEven(swapped));
  EXPECT_FALSE(AreEven(Arrival(clean, 1e-3, &random)));
  EXPECT_FALSE(AreEven(InBursts(clean, 8)));
  EXPECT_FALSE(AreEven(Cut(clean, 10'000'000)));
  EXPECT_FALSE(AreEven(Cut(Even(200.0, 20.0), 4'000'000)));
}

// --- Streams ---

SimulatorOptions Truth(double pose_rate_hz = 100.0) {
  SimulatorOptions options;
  options.duration_s = 40.0;
  options.seed = 71;
  options.pose_rate_hz = pose_rate_hz;
  options.position_std = options.rotation_std = 3e-4;
  options.accel_delay_s = 2e-3;
  options.start_ns += 3'456'789;
  return options;
}

template <typename Sample>
void SetStamps(const StampList& t_ns, std::vector<Sample>* samples) {
  for (size_t i = 0; i < t_ns.size(); ++i) (*samples)[i].t_ns = t_ns[i];
}

StampList StampsOf(const SessionData& data) { return Stamps(data.poses); }

TEST(RecoverStamps, LeavesCleanStampsAsTheyAre) {
  SessionData data = Simulate(Truth()), before = data;
  const SessionStamps stamps = RecoverStamps(StampRecovery::kAuto, &data);
  EXPECT_TRUE(stamps.poses.stamps_even);
  EXPECT_FALSE(stamps.poses.stamps_recovered);
  EXPECT_FALSE(stamps.imus[0].first.stamps_recovered);
  EXPECT_EQ(StampsOf(data), StampsOf(before));
  EXPECT_EQ(Stamps(data.imus[0].gyro), Stamps(before.imus[0].gyro));
  EXPECT_EQ(Stamps(data.imus[0].accel), Stamps(before.imus[0].accel));
}

TEST(RecoverStamps, LeavesTrueIrregularTimesAsTheyAre) {
  // A camera: exposures around even triggers, stamped right. Counting explains its stamps, but not
  // its poses.
  const SimulatorOptions truth = Truth();
  const TrueTrajectory trajectory(truth);
  std::mt19937 random(8);
  SessionData data = Simulate(truth);
  for (PoseSample& pose : data.poses) {
    const double late = std::normal_distribution<double>(0.0, 1.5e-3)(random);
    pose.t_ns += std::llround(1e9 * late);
    const TrueState state = trajectory.At(1e-9 * static_cast<double>(pose.t_ns - truth.start_ns));
    pose.p_WM = state.p_WM + 3e-4 * RandomAxis(&random);
    pose.q_WM = Eigen::Quaterniond(state.R_WM) * Exp<double>(3e-4 * RandomAxis(&random));
  }
  ASSERT_TRUE(RecoverClock(StampsOf(data)).has_value());
  const StampList before = StampsOf(data);
  EXPECT_FALSE(RecoverStamps(StampRecovery::kAuto, &data).poses.stamps_recovered);
  EXPECT_EQ(StampsOf(data), before);
}

TEST(RecoverStamps, TakesTheClockThatExplainsThePoses) {
  SessionData data = Simulate(Truth());
  const StampList clean = StampsOf(data);
  std::mt19937 random(9);
  SetStamps(Arrival(clean, 2e-3, &random), &data.poses);
  SessionData never = data;
  const StampList late = StampsOf(data);
  EXPECT_FALSE(RecoverStamps(StampRecovery::kNever, &never).poses.stamps_recovered);
  EXPECT_EQ(StampsOf(never), late);
  const StreamReport stamps = RecoverStamps(StampRecovery::kAuto, &data).poses;
  EXPECT_TRUE(stamps.stamps_recovered);
  EXPECT_NEAR(stamps.stamp_jitter_s, 2e-3, 2e-4);
  EXPECT_LT(ErrorOf(StampsOf(data), clean).rms, 1.5e-4);
}

TEST(RecoverStamps, AlwaysAndNeverMeanIt) {
  SessionData data = Simulate(Truth()), before = data;
  const SessionStamps stamps = RecoverStamps(StampRecovery::kAlways, &data);
  EXPECT_TRUE(stamps.poses.stamps_recovered);
  EXPECT_LT(stamps.poses.stamp_jitter_s, 1e-6);
  EXPECT_LT(ErrorOf(StampsOf(data), StampsOf(before)).rms, 1e-6);
}

TEST(RecoverStamps, CountsTheFramesOfAFrozenTracker) {
  SessionData data = Simulate(Truth());
  const StampList clean = StampsOf(data);
  Freeze(10.0, 12.0, &data);
  Freeze(20.0, 20.03, &data);
  std::mt19937 random(10);
  SetStamps(Arrival(clean, 2e-3, &random), &data.poses);
  EXPECT_TRUE(RecoverStamps(StampRecovery::kAuto, &data).poses.stamps_recovered);
  EXPECT_LT(ErrorOf(StampsOf(data), clean).rms, 1.5e-4);

  SetStamps(clean, &data.poses);
  for (PoseSample& pose : data.poses) pose.t_ns += pose.t_ns % 7'000'000;
  const ConditionedData out = ConditionData(CalibrationOptions(), data);
  EXPECT_TRUE(out.pose_report.stamps_recovered);
  EXPECT_NEAR(static_cast<double>(out.pose_report.repeated_value), 202.0, 3.0);
}

TEST(RecoverStamps, KeepsSamplesOfEqualStampsAndDropsMessagesThatComeTwice) {
  SessionData data = Simulate(Truth(200.0));
  SetStamps(Cut(StampsOf(data), 10'000'000), &data.poses);
  ConditionedData out = ConditionData(CalibrationOptions(), data);
  EXPECT_EQ(out.pose_report.used, 8000u);
  EXPECT_NEAR(out.pose_report.rate_hz, 200.0, 0.1);
  for (const size_t i : {100u, 2000u, 5001u})
    data.poses.insert(data.poses.begin() + static_cast<std::ptrdiff_t>(i), data.poses[i]);
  out = ConditionData(CalibrationOptions(), data);
  EXPECT_EQ(out.pose_report.used, 8000u);
  EXPECT_EQ(out.pose_report.duplicate_stamp, 3u);
}

TEST(RecoverStamps, LeavesStampsThatAreNotBelieved) {
  SessionData data = Simulate(Truth());
  const StampList clean = StampsOf(data);
  std::mt19937 random(11);
  SetStamps(Arrival(clean, 2e-3, &random), &data.poses);
  data.poses[0].t_ns = 0;
  data.poses[1000].t_ns += 5 * kSecond;
  data.poses[3000].t_ns -= 5 * kSecond;
  const StampList before = StampsOf(data);
  ASSERT_TRUE(RecoverStamps(StampRecovery::kAuto, &data).poses.stamps_recovered);
  for (const size_t i : {0u, 1000u, 3000u}) EXPECT_EQ(data.poses[i].t_ns, before[i]);
  EXPECT_NEAR(static_cast<double>(data.poses[1001].t_ns - data.poses[999].t_ns), 20e6, 1e4);
  EXPECT_EQ(ConditionData(CalibrationOptions(), data).pose_report.reversed_stamp, 3u);
}

TEST(RecoverStamps, GivesTheSensorsOfAMessageOneClock) {
  SessionData data = Simulate(Truth());
  ImuData& imu = data.imus[0];
  const StampList clean = Stamps(imu.gyro);
  SetStamps(InBursts(clean, 8), &imu.gyro);
  SetStamps(InBursts(clean, 8), &imu.accel);
  const SessionStamps stamps = RecoverStamps(StampRecovery::kAuto, &data);
  EXPECT_FALSE(stamps.poses.stamps_recovered);
  EXPECT_TRUE(stamps.imus[0].first.stamps_recovered);
  EXPECT_TRUE(stamps.imus[0].second.stamps_recovered);
  EXPECT_EQ(Stamps(imu.gyro), Stamps(imu.accel));
  EXPECT_LT(ErrorOf(Stamps(imu.gyro), clean).rms, 1e-4);
}

// --- Data check ---

TEST(CheckData, TellsOfCutStampsOnlyWhenTheyAreUsed) {
  SessionData data = Simulate(Truth(120.0));
  SetStamps(Cut(StampsOf(data), 10'000'000), &data.poses);
  CalibrationOptions options;
  DataCheck check = CheckData(options, data);
  EXPECT_EQ(check.verdict, DataVerdict::kGood) << ::testing::PrintToString(check.warnings);
  EXPECT_TRUE(check.poses.report.stamps_recovered);
  EXPECT_DOUBLE_EQ(check.poses.cut_s, 0.01);
  EXPECT_NEAR(check.poses.rate_hz, 120.0, 0.1);
  EXPECT_LT(check.poses.missing, 1e-3);
  options.recover_stamps = StampRecovery::kNever;
  check = CheckData(options, data);
  ASSERT_FALSE(check.warnings.empty());
  EXPECT_TRUE(Contains(check.warnings[0], "pose: the stamps are multiples of 10 ms"));
}

// --- Calibration ---

/// Squared error and sigma of p_MI [m], and how many of the streams were recovered.
struct Outcome {
  double error = 0.0, sigma = 0.0;
  int recovered = 0;
};

Outcome CalibrateOnce(const SimulatorOptions& truth, const SessionData& data) {
  CalibrationOptions options;
  options.num_threads = 1;
  const Calibration result = Calibrate(options, data);
  EXPECT_EQ(result.status, Status::kOk) << result.message;
  const ImuSession& imu = result.sessions[0].imus[0];
  const auto count = [](const StreamReport& report) { return report.stamps_recovered ? 1 : 0; };
  return {(result.imus[0].T_MI.p - truth.T_MI.p).norm(), result.imus[0].Std().head<3>().norm(),
          count(result.sessions[0].poses) + count(imu.gyro) + count(imu.accel)};
}

const Outcome& Clean(double pose_rate_hz) {
  static const Outcome at_100 = CalibrateOnce(Truth(100.0), Simulate(Truth(100.0)));
  static const Outcome at_120 = CalibrateOnce(Truth(120.0), Simulate(Truth(120.0)));
  static const Outcome at_200 = CalibrateOnce(Truth(200.0), Simulate(Truth(200.0)));
  return pose_rate_hz == 100.0 ? at_100 : pose_rate_hz == 120.0 ? at_120 : at_200;
}

struct Recording {
  const char* name;
  double pose_rate_hz;
  int recovered;  ///< streams
  std::function<void(SessionData*)> spoil;
};
std::ostream& operator<<(std::ostream& out, const Recording& r) { return out << r.name; }

class UnevenStamps : public ::testing::TestWithParam<Recording> {};

TEST_P(UnevenStamps, CalibrateLikeCleanOnes) {
  const SimulatorOptions truth = Truth(GetParam().pose_rate_hz);
  SessionData data = Simulate(truth);
  GetParam().spoil(&data);
  const Outcome clean = Clean(truth.pose_rate_hz), outcome = CalibrateOnce(truth, data);
  EXPECT_EQ(outcome.recovered, GetParam().recovered);
  EXPECT_LT(outcome.error, 1.5 * std::max(clean.error, clean.sigma));
  EXPECT_LT(outcome.sigma, 1.5 * clean.sigma);
}

std::function<void(SessionData*)> CutPoses(int64_t unit_ms) {
  return
      [unit_ms](SessionData* d) { SetStamps(Cut(StampsOf(*d), unit_ms * 1'000'000), &d->poses); };
}

void LatePoses(SessionData* d) {
  std::mt19937 random(12);
  SetStamps(Arrival(StampsOf(*d), 3e-3, &random), &d->poses);
}

void ChangeImu(SessionData* d, const std::function<StampList(const StampList&)>& change) {
  const StampList t_ns = change(Stamps(d->imus[0].gyro));
  SetStamps(t_ns, &d->imus[0].gyro);
  SetStamps(t_ns, &d->imus[0].accel);
}

const Recording kRecordings[] = {
    {"Arrival100Hz", 100.0, 1, LatePoses},
    {"Arrival200Hz", 200.0, 1, LatePoses},
    {"Cut1ms120Hz", 120.0, 1, CutPoses(1)},
    {"Cut4ms100Hz", 100.0, 1, CutPoses(4)},
    {"Cut4ms200Hz", 200.0, 1, CutPoses(4)},
    {"Cut10ms120Hz", 120.0, 1, CutPoses(10)},
    {"Cut10ms200Hz", 200.0, 1, CutPoses(10)},
    {"ImuInBursts", 100.0, 2,
     [](SessionData* d) { ChangeImu(d, [](const StampList& t) { return InBursts(t, 8); }); }},
    {"ImuArrival", 100.0, 2,
     [](SessionData* d) {
       std::mt19937 random(13);
       ChangeImu(d, [&](const StampList& t) { return Arrival(t, 2e-3, &random); });
     }},
    {"ImuCut4ms", 100.0, 2,
     [](SessionData* d) { ChangeImu(d, [](const StampList& t) { return Cut(t, 4'000'000); }); }},
    {"AllThatArrives", 100.0, 3,
     [](SessionData* d) {
       LatePoses(d);
       std::mt19937 random(14);
       ImuData& imu = d->imus[0];
       SetStamps(Arrival(Stamps(imu.gyro), 2e-3, &random), &imu.gyro);
       SetStamps(Arrival(Stamps(imu.accel), 2e-3, &random), &imu.accel);
     }},
};

INSTANTIATE_TEST_SUITE_P(Calibrate, UnevenStamps, ::testing::ValuesIn(kRecordings),
                         [](const auto& test) { return std::string(test.param.name); });

TEST(RecoverClock, ASourceThatStoppedForAWhileTakesNoMemory) {
  std::mt19937 random(9);
  StampList t_ns = Arrival(Even(1000.0, 60.0), 1e-4, &random);
  int64_t last = t_ns[10'000] + 9 * kSecond / 10;
  for (size_t i = 10'000; i < t_ns.size(); ++i) t_ns[i] = last = std::max(t_ns[i], last + 20'000);
  const auto peak_mb = [] {
    rusage usage{};
    getrusage(RUSAGE_SELF, &usage);
    return 1e-3 * static_cast<double>(usage.ru_maxrss);
  };
  const double before = peak_mb();
  ASSERT_TRUE(RecoverClock(t_ns));
  EXPECT_LT(peak_mb() - before, 200.0);
}

}  // namespace
}  // namespace imu_pose_calib
