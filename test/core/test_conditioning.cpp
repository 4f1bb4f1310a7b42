#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using Eigen::Vector3d;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr double kInfinity = std::numeric_limits<double>::infinity();

/// 10 s: 1000 poses, 2000 gyroscope and 2000 accelerometer samples.
SessionData Recording() {
  static const SessionData data = [] {
    SimulatorOptions options;
    options.duration_s = 10.0;
    return Simulate(options);
  }();
  return data;
}

ConditionedData ConditionData(const SessionData& data) {
  return ConditionData(CalibrationOptions(), data);
}

std::string Refusal(const SessionData& data,
                    const CalibrationOptions& options = CalibrationOptions()) {
  return ErrorText<DataError>([&] { ConditionData(options, data); });
}

size_t Dropped(const StreamReport& r) {
  return r.not_finite + r.zero_quaternion + r.reversed_stamp + r.duplicate_stamp +
         r.repeated_value + r.outlier + r.in_short_segment;
}

/// What ConditionData() promises whatever it was given.
void ExpectPromisesKept(const ConditionedData& out, const SessionData& in) {
  EXPECT_EQ(out.pose_report.received, in.poses.size());
  EXPECT_EQ(out.imus[0].gyro_report.received, in.imus[0].gyro.size());
  EXPECT_EQ(out.imus[0].accel_report.received, in.imus[0].accel.size());
  EXPECT_EQ(out.pose_report.used, out.poses.size());
  EXPECT_EQ(out.imus[0].gyro_report.used, out.imus[0].gyro.size());
  EXPECT_EQ(out.imus[0].accel_report.used, out.imus[0].accel.size());
  for (const StreamReport* r :
       {&out.pose_report, &out.imus[0].gyro_report, &out.imus[0].accel_report})
    EXPECT_EQ(r->received, r->used + Dropped(*r));

  const auto increases = [](const auto& samples) {
    return std::adjacent_find(samples.begin(), samples.end(), [](const auto& a, const auto& b) {
             return !(a.t < b.t);
           }) == samples.end();
  };
  EXPECT_TRUE(increases(out.poses));
  EXPECT_TRUE(increases(out.imus[0].gyro));
  EXPECT_TRUE(increases(out.imus[0].accel));
  for (size_t i = 0; i < out.poses.size(); ++i) {
    EXPECT_NEAR(out.poses[i].q_WM.norm(), 1.0, 1e-14);
    if (i > 0) {
      EXPECT_GE(out.poses[i].q_WM.dot(out.poses[i - 1].q_WM), 0.0);
    }
  }
  size_t next = 0;
  for (const IndexRange& s : out.segments) {
    EXPECT_EQ(s.begin, next);
    next = s.end;
  }
  EXPECT_EQ(next, out.poses.size());
}

TEST(ConditionData, KeepsAGoodRecordingWhole) {
  const SessionData data = Recording();
  const ConditionedData out = ConditionData(data);
  ExpectPromisesKept(out, data);
  EXPECT_EQ(out.pose_report.used, 1000u);
  EXPECT_EQ(out.imus[0].gyro_report.used, 2000u);
  EXPECT_EQ(out.imus[0].accel_report.used, 2000u);
  EXPECT_EQ(out.segments.size(), 1u);
  EXPECT_EQ(out.gaps, 0u);
  EXPECT_EQ(out.pose_epoch_ns, data.poses.front().t_ns);
  EXPECT_EQ(out.imus[0].epoch_ns, data.imus[0].gyro.front().t_ns);
  for (size_t i = 0; i < data.poses.size(); ++i) {
    EXPECT_DOUBLE_EQ(out.poses[i].t,
                     1e-9 * static_cast<double>(data.poses[i].t_ns - out.pose_epoch_ns));
    EXPECT_EQ(out.poses[i].p_WM, data.poses[i].p_WM);
    EXPECT_LT(out.poses[i].q_WM.angularDistance(data.poses[i].q_WM), 1e-7);
  }
  EXPECT_EQ(out.imus[0].gyro[77].value, data.imus[0].gyro[77].value);
  EXPECT_EQ(out.imus[0].accel[77].value, data.imus[0].accel[77].value);
}

TEST(ConditionData, ReportsRateAndDurationOfEachStream) {
  SimulatorOptions options;
  options.duration_s = 8.0;
  options.pose_rate_hz = 300.0;
  options.gyro_rate_hz = 400.0;
  options.accel_rate_hz = 250.0;
  const ConditionedData out = ConditionData(Simulate(options));
  EXPECT_NEAR(out.pose_report.rate_hz, 300.0, 0.1);
  EXPECT_NEAR(out.imus[0].gyro_report.rate_hz, 400.0, 0.1);
  EXPECT_NEAR(out.imus[0].accel_report.rate_hz, 250.0, 0.1);
  EXPECT_NEAR(out.pose_report.duration_s, 8.0 - 1.0 / 300.0, 1e-6);
  EXPECT_NEAR(out.imus[0].gyro_report.duration_s, 8.0 - 1.0 / 400.0, 1e-6);
  EXPECT_NEAR(out.imus[0].accel_report.duration_s, 8.0 - 1.0 / 250.0, 1e-6);
}

TEST(ConditionData, MeasuresTimeFromTheEarlierImuStream) {
  SessionData data = Recording();
  data.imus[0].gyro.erase(data.imus[0].gyro.begin(), data.imus[0].gyro.begin() + 100);
  const ConditionedData out = ConditionData(data);
  EXPECT_EQ(out.imus[0].epoch_ns, data.imus[0].accel.front().t_ns);
  EXPECT_DOUBLE_EQ(out.imus[0].accel.front().t, 0.0);
  EXPECT_DOUBLE_EQ(out.imus[0].gyro.front().t, 0.5);
}

TEST(ConditionData, CountsSamplesThatAreNotFinite) {
  SessionData data = Recording();
  data.poses[10].p_WM.x() = kNaN;
  data.poses[20].q_WM.w() = kNaN;
  data.poses[30].p_WM.y() = kInfinity;
  data.poses[40].q_WM.x() = -kInfinity;
  data.imus[0].gyro[50].value.z() = kNaN;
  data.imus[0].gyro[0].value.x() = kInfinity;
  data.imus[0].accel[60].value.y() = -kInfinity;
  const ConditionedData out = ConditionData(data);
  ExpectPromisesKept(out, data);
  EXPECT_EQ(out.pose_report.not_finite, 4u);
  EXPECT_EQ(out.imus[0].gyro_report.not_finite, 2u);
  EXPECT_EQ(out.imus[0].accel_report.not_finite, 1u);
  EXPECT_EQ(out.pose_report.used, 996u);
}

TEST(ConditionData, CountsZeroQuaternions) {
  SessionData data = Recording();
  for (const size_t i : {0u, 100u, 999u}) data.poses[i].q_WM.coeffs().setZero();
  const ConditionedData out = ConditionData(data);
  ExpectPromisesKept(out, data);
  EXPECT_EQ(out.pose_report.zero_quaternion, 3u);
}

TEST(ConditionData, CountsStampsMoreThanOneSecondBack) {
  SessionData data = Recording();
  data.poses[500].t_ns -= 2'000'000'000;
  data.imus[0].gyro[900].t_ns -= 1'100'000'000;
  data.imus[0].accel[900].t_ns = 0;  // a driver that forgot the stamp
  const ConditionedData out = ConditionData(data);
  ExpectPromisesKept(out, data);
  EXPECT_EQ(out.pose_report.reversed_stamp, 1u);
  EXPECT_EQ(out.imus[0].gyro_report.reversed_stamp, 1u);
  EXPECT_EQ(out.imus[0].accel_report.reversed_stamp, 1u);
}

TEST(ConditionData, AStampAheadCostsNoOtherSample) {
  SessionData data = Recording();
  data.poses[500].t_ns += 5'000'000'000;  // of 10 s
  data.poses[0].t_ns += 2'000'000'000;
  for (const size_t i : {300u, 900u, 901u, 902u, 1500u}) data.imus[0].gyro[i].t_ns += 2'500'000'000;
  data.imus[0].accel[1000].t_ns += 1'100'000'000;
  data.imus[0].accel[1002].t_ns += 3600'000'000'000;
  data.imus[0].accel[1100].t_ns -= 4'000'000'000;
  data.imus[0].accel[1998].t_ns += 3'000'000'000;
  const ConditionedData out = ConditionData(data);
  ExpectPromisesKept(out, data);
  EXPECT_EQ(out.pose_report.reversed_stamp, 2u);
  EXPECT_EQ(out.imus[0].gyro_report.reversed_stamp, 5u);
  EXPECT_EQ(out.imus[0].accel_report.reversed_stamp, 4u);
  EXPECT_EQ(out.pose_report.used, 998u);
  EXPECT_EQ(out.gaps, 0u);
  EXPECT_NEAR(out.imus[0].accel_report.duration_s, 10.0, 0.02);
}

TEST(ConditionData, RefusesTooManyStampsAhead) {
  SessionData data = Recording();
  for (size_t i = 0; i < 150; ++i) data.poses[6 * i].t_ns += 5'000'000'000;
  const std::string text = Refusal(data);
  EXPECT_TRUE(Contains(text, "pose: 150 of 1000 samples are stamped more than 1 s ahead"));
  EXPECT_TRUE(Contains(text, "bound: 10 %"));
}

TEST(ConditionData, KeepsWhatComesAfterAPause) {
  SessionData data = Recording();
  for (size_t i = 0; i < 1000; ++i) data.poses[i].t_ns += i < 500 ? 0 : 4'000'000'000;
  for (const size_t i : {998u, 999u}) data.poses[i].t_ns += 4'000'000'000;
  const ConditionedData out = ConditionData(data);
  ExpectPromisesKept(out, data);
  EXPECT_EQ(out.pose_report.reversed_stamp, 0u);
  EXPECT_EQ(out.gaps, 2u);
}

TEST(ConditionData, SortsInWhatArrivesUpToOneSecondLate) {
  const SessionData ordered = Recording();
  SessionData data = ordered;
  std::rotate(data.imus[0].gyro.begin() + 100, data.imus[0].gyro.begin() + 101,
              data.imus[0].gyro.begin() + 290);  // 0.95 s
  std::swap(data.poses[300], data.poses[301]);
  std::swap(data.imus[0].accel[5], data.imus[0].accel[9]);
  const ConditionedData out = ConditionData(data), expected = ConditionData(ordered);
  ExpectPromisesKept(out, data);
  EXPECT_EQ(out.pose_report.used, 1000u);
  ASSERT_EQ(out.imus[0].gyro.size(), 2000u);
  EXPECT_EQ(out.imus[0].accel_report.used, 2000u);
  for (size_t i = 0; i < 2000; ++i) {
    EXPECT_EQ(out.imus[0].gyro[i].t, expected.imus[0].gyro[i].t);
    EXPECT_EQ(out.imus[0].gyro[i].value, expected.imus[0].gyro[i].value);
    EXPECT_EQ(out.imus[0].accel[i].value, expected.imus[0].accel[i].value);
  }
  EXPECT_EQ(out.poses[300].p_WM, expected.poses[300].p_WM);
}

TEST(ConditionData, CountsDuplicateStampsAndKeepsTheFirst) {
  SessionData data = Recording();
  data.poses[201].t_ns = data.poses[200].t_ns;
  data.imus[0].gyro[11].t_ns = data.imus[0].gyro[10].t_ns;
  data.imus[0].gyro[12].t_ns = data.imus[0].gyro[10].t_ns;
  data.imus[0].accel[1].t_ns = data.imus[0].accel[0].t_ns;
  const ConditionedData out = ConditionData(data);
  ExpectPromisesKept(out, data);
  EXPECT_EQ(out.pose_report.duplicate_stamp, 1u);
  EXPECT_EQ(out.imus[0].gyro_report.duplicate_stamp, 2u);
  EXPECT_EQ(out.imus[0].accel_report.duplicate_stamp, 1u);
  EXPECT_EQ(out.imus[0].gyro[10].value, data.imus[0].gyro[10].value);
}

TEST(ConditionData, CountsRepeatedValuesAsFrozen) {
  SessionData data = Recording();
  for (size_t i = 401; i < 405; ++i) {
    data.poses[i].p_WM = data.poses[400].p_WM;
    data.poses[i].q_WM = data.poses[400].q_WM;
  }
  data.poses[700].p_WM = data.poses[699].p_WM;  // turns on: not frozen
  data.imus[0].gyro[30].value = data.imus[0].gyro[29].value;
  data.imus[0].accel[40].value = data.imus[0].accel[39].value;
  const ConditionedData out = ConditionData(data);
  ExpectPromisesKept(out, data);
  EXPECT_EQ(out.pose_report.repeated_value, 4u);
  EXPECT_EQ(out.imus[0].gyro_report.repeated_value, 1u);
  EXPECT_EQ(out.imus[0].accel_report.repeated_value, 1u);
  EXPECT_EQ(out.gaps, 0u);
}

TEST(ConditionData, KeepsEqualReadingsOfASensorAtRest) {
  SessionData data = Recording();
  const double step = 1e-3;  // [rad/s]
  auto& gyro = data.imus[0].gyro;
  for (ImuSample& s : gyro) s.value = (s.value / step).array().round() * step;
  for (size_t i = 101; i < 110; ++i) gyro[i].value = gyro[100].value;
  gyro[110].value = gyro[100].value + Eigen::Vector3d(-2.0 * step, 0.0, step);  // at rest
  for (size_t i = 301; i < 310; ++i) gyro[i].value = gyro[300].value;
  gyro[310].value = gyro[300].value + Eigen::Vector3d(0.0, 4.0 * step, 0.0);  // not read meanwhile
  const std::vector<bool> repeats = FindRepeats(gyro);
  EXPECT_FALSE(repeats[101] || repeats[109] || repeats[300]);
  EXPECT_TRUE(repeats[301] && repeats[309]);
  const ConditionedData out = ConditionData(data);
  ExpectPromisesKept(out, data);
  EXPECT_EQ(out.imus[0].gyro_report.repeated_value, 9u);
}

TEST(ConditionData, ALongFreezeIsAGap) {
  SessionData data = Recording();
  for (size_t i = 401; i < 450; ++i) {
    data.poses[i].p_WM = data.poses[400].p_WM;
    data.poses[i].q_WM = data.poses[400].q_WM;
  }
  const ConditionedData out = ConditionData(data);
  ExpectPromisesKept(out, data);
  EXPECT_EQ(out.pose_report.repeated_value, 49u);
  EXPECT_EQ(out.gaps, 1u);
  ASSERT_EQ(out.segments.size(), 2u);
  EXPECT_EQ(out.segments[0].size(), 401u);
}

TEST(ConditionData, UndoesSignFlipsAndScaleOfQuaternions) {
  const SessionData plain = Recording();
  SessionData data = plain;
  std::mt19937 random(1);
  for (PoseSample& pose : data.poses) {
    pose.q_WM.coeffs() *= random() % 2 == 0 ? -1.0 : 1.0;
    pose.q_WM.coeffs() *= std::uniform_real_distribution<double>(0.5, 3.0)(random);
  }
  const ConditionedData out = ConditionData(data), expected = ConditionData(plain);
  ExpectPromisesKept(out, data);
  ASSERT_EQ(out.poses.size(), expected.poses.size());
  const double sign = out.poses[0].q_WM.dot(expected.poses[0].q_WM) < 0.0 ? -1.0 : 1.0;
  for (size_t i = 0; i < out.poses.size(); ++i)
    EXPECT_LT((sign * out.poses[i].q_WM.coeffs() - expected.poses[i].q_WM.coeffs()).norm(), 1e-14);
}

TEST(ConditionData, SplitsAtGapsAndDropsShortSegments) {
  SessionData data = Recording();
  // Gaps of 0.2 s after 3 s and after 3.5 s: the run between them is as long as 0.3 s.
  data.poses.erase(data.poses.begin() + 350, data.poses.begin() + 370);
  data.poses.erase(data.poses.begin() + 300, data.poses.begin() + 320);
  const ConditionedData out = ConditionData(data);
  ExpectPromisesKept(out, data);
  EXPECT_EQ(out.gaps, 2u);
  EXPECT_EQ(out.pose_report.in_short_segment, 30u);
  ASSERT_EQ(out.segments.size(), 2u);
  EXPECT_EQ(out.segments[0].size(), 300u);
  EXPECT_EQ(out.segments[1].size(), 630u);
  EXPECT_NEAR(out.poses[300].t, 3.7, 1e-6);

  CalibrationOptions options;
  options.min_segment_s = 0.2;
  EXPECT_EQ(ConditionData(options, data).segments.size(), 3u);
  options.max_gap_s = 0.3;
  EXPECT_EQ(ConditionData(options, data).segments.size(), 1u);
  EXPECT_EQ(ConditionData(options, data).gaps, 0u);
}

TEST(ConditionData, RefusesAnEmptyStreamByName) {
  SessionData no_poses = Recording(), no_gyro = no_poses, no_accel = no_poses;
  no_poses.poses.clear();
  no_gyro.imus[0].gyro.clear();
  no_accel.imus[0].accel.clear();
  EXPECT_TRUE(Contains(Refusal(no_poses), "no pose samples"));
  EXPECT_TRUE(Contains(Refusal(no_gyro), "no gyroscope samples"));
  EXPECT_TRUE(Contains(Refusal(no_accel), "no accelerometer samples"));
}

TEST(ConditionData, RefusesAShortStreamWithItsDurationAndTheBound) {
  SessionData data = Recording();
  data.imus[0].gyro.resize(601);
  const std::string text = Refusal(data);
  EXPECT_TRUE(Contains(text, "gyroscope: 601 of 601 samples"));
  EXPECT_TRUE(Contains(text, "span 3 s"));
  EXPECT_TRUE(Contains(text, "at least 5 s"));

  data = Recording();
  data.poses.resize(1);
  EXPECT_TRUE(Contains(Refusal(data), "pose: 1 of 1 samples"));
  data = Recording();
  data.imus[0].accel.resize(10);
  EXPECT_TRUE(Contains(Refusal(data), "accelerometer: 10 of 10 samples"));
}

TEST(ConditionData, RefusesAnImuOfAFewSamples) {
  SessionData data = Recording();
  std::vector<ImuSample> few;
  for (size_t i = 0; i < data.imus[0].accel.size(); i += 600) few.push_back(data.imus[0].accel[i]);
  data.imus[0].accel = few;
  EXPECT_TRUE(Contains(Refusal(data), "accelerometer: 0.333333 Hz (bound: at least 0.5 Hz)"))
      << Refusal(data);
}

TEST(ConditionData, RefusesATrackerThatIsFrozenThroughout) {
  SessionData data = Recording();
  for (PoseSample& pose : data.poses) {
    pose.p_WM = data.poses[0].p_WM;
    pose.q_WM = data.poses[0].q_WM;
  }
  EXPECT_TRUE(Contains(Refusal(data), "999 repeated); look at the driver"));
}

TEST(ConditionData, RefusesTooManyBadSamplesWithCountAndBound) {
  SessionData data = Recording();
  for (size_t i = 0; i < 101; ++i) data.poses[5 * i].p_WM.x() = kNaN;
  std::string text = Refusal(data);
  EXPECT_TRUE(Contains(text, "pose: 101 of 1000 samples are not finite"));
  EXPECT_TRUE(Contains(text, "bound: 10 %"));

  CalibrationOptions options;
  options.max_bad_fraction = 0.2;
  EXPECT_EQ(ConditionData(options, data).pose_report.not_finite, 101u);

  data = Recording();
  for (size_t i = 0; i < 500; ++i) data.poses[2 * i].q_WM.coeffs().setZero();
  EXPECT_TRUE(Contains(Refusal(data), "pose: 500 of 1000 samples have a zero quaternion"));
}

TEST(ConditionData, RefusesAClockThatJumpsBack) {
  SessionData data = Recording();
  for (size_t i = 1000; i < 2000; ++i) data.imus[0].accel[i].t_ns -= 3600'000'000'000;
  const std::string text = Refusal(data);
  EXPECT_TRUE(Contains(text, "accelerometer: 1000 of 2000 samples"));
  EXPECT_TRUE(Contains(text, "clock jumped back"));

  data = Recording();
  for (size_t i = 700; i < 1000; ++i) data.poses[i].t_ns -= 5'000'000'000;
  EXPECT_TRUE(
      Contains(Refusal(data), "pose: 300 of 1000 samples are stamped more than 1 s before"));
}

TEST(ConditionData, RefusesAnAccelerometerInG) {
  SessionData data = Recording();
  for (ImuSample& s : data.imus[0].accel) s.value /= 9.80665;
  const std::string text = Refusal(data);
  EXPECT_TRUE(Contains(text, "accelerometer: median norm"));
  EXPECT_TRUE(Contains(text, "it looks like g"));
}

TEST(ConditionData, RefusesAnAccelerometerWithoutGravity) {
  SimulatorOptions gentle;  // noise and a little motion remain
  gentle.motion = Motion::kStatic;
  gentle.g_W.setZero();
  gentle.duration_s = 10.0;
  const std::string text = Refusal(Simulate(gentle));
  EXPECT_TRUE(Contains(text, "accelerometer: median norm"));
  EXPECT_TRUE(Contains(text, "gravity seems to be removed"));
}

TEST(ConditionData, RefusesAnAccelerometerInMilliG) {
  SessionData data = Recording();
  for (ImuSample& s : data.imus[0].accel) s.value *= 1e3 / 9.80665;
  EXPECT_TRUE(Contains(Refusal(data), "set accel_unit: 0.00980665"));
}

TEST(ConditionData, RefusesPosesWithoutALongRun) {
  SessionData data = Recording();
  for (size_t i = 0; i < data.poses.size(); ++i)
    data.poses[i].t_ns += 200'000'000 * static_cast<int64_t>(i / 20);
  const std::string text = Refusal(data);
  EXPECT_TRUE(Contains(text, "min_segment_s = 0.5 s"));
  EXPECT_TRUE(Contains(text, "49 gaps in 1000 poses"));
}

TEST(ConditionData, RefusesAStreamWithNothingUsableWhateverTheBound) {
  SessionData data = Recording();
  for (PoseSample& pose : data.poses) pose.p_WM.x() = kNaN;
  CalibrationOptions options;
  options.max_bad_fraction = 1.0;
  EXPECT_TRUE(Contains(Refusal(data, options), "none of the 1000 pose samples is usable"));
}

TEST(ConditionData, RefusesASensorThatIsAlwaysAtItsLimitWhateverTheBound) {
  CalibrationOptions options;
  options.max_bad_fraction = 1.0;
  for (auto sensor : {&ImuData::gyro, &ImuData::accel}) {
    SessionData data = Recording();
    std::vector<ImuSample>& samples = data.imus[0].*sensor;
    for (size_t i = 0; i < samples.size(); ++i) samples[i].value.x() = i % 20 < 10 ? 50.0 : -50.0;
    const std::string text = Refusal(data, options);
    EXPECT_TRUE(Contains(text, sensor == &ImuData::gyro ? "gyroscope: " : "accelerometer: "));
    EXPECT_TRUE(Contains(text, "all 2000 samples are at the end of the sensor's range (50)"));
  }
}

}  // namespace
}  // namespace imu_pose_calib
