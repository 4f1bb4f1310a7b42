// Faulty recordings: calibrated all the same, with what was dropped counted, or refused in words.

#include <gtest/gtest.h>

#include <functional>
#include <ostream>

#include "faults.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using Eigen::AngleAxisd;
using Eigen::Quaterniond;
using Eigen::Vector3d;

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

SimulatorOptions Truth(uint32_t seed) {
  SimulatorOptions options;
  options.duration_s = 20.0;
  options.seed = seed;
  options.T_MI = {Quaterniond(0.3, -0.5, 0.1, 0.8).normalized(), {0.06, -0.08, 0.05}};
  options.accel_delay_s = 0.003;
  return options;
}

Quaterniond Turn(double degrees, const Vector3d& axis) {
  return Quaterniond(AngleAxisd(degrees * M_PI / 180.0, axis.normalized()));
}

/// A fault that is repaired: `simulate` it into the truth, or `spoil` the recording; `check` what
/// the result says about it.
struct Fault {
  const char* name;
  std::function<void(SimulatorOptions*)> simulate;
  std::function<void(SessionData*)> spoil;
  std::function<void(const Calibration&)> check;
  double most_std = 1e-3;  ///< [m] of p along an axis
};
std::ostream& operator<<(std::ostream& out, const Fault& fault) { return out << fault.name; }

class RepairedFault : public ::testing::TestWithParam<Fault> {};

TEST_P(RepairedFault, LeavesTheCalibrationWithinItsSigmas) {
  const Fault& fault = GetParam();
  SimulatorOptions truth = Truth(31);
  if (fault.simulate) fault.simulate(&truth);
  SessionData data = Simulate(truth);
  if (fault.spoil) fault.spoil(&data);
  CalibrationOptions options;
  options.num_threads = 1;
  const Calibration result = Calibrate(options, data);
  EXPECT_TRUE(result.IsUsable()) << result.message;
  Eigen::Matrix<double, 8, 1> e, sigma;
  e << result.imus[0].T_MI.p - truth.T_MI.p,
      Log(Quaterniond(truth.T_MI.q.conjugate() * result.imus[0].T_MI.q)),
      result.sessions[0].imus[0].time_shift - truth.time_shift_s,
      result.imus[0].accel_delay - truth.accel_delay_s;
  sigma << result.imus[0].Std(), result.sessions[0].imus[0].time_shift_std,
      result.imus[0].accel_delay_std;
  EXPECT_LT(e.cwiseQuotient(sigma).cwiseAbs().maxCoeff(), 3.5) << e.transpose() << "\n"
                                                               << sigma.transpose();
  EXPECT_LT(sigma.head<3>().maxCoeff(), fault.most_std);
  const StreamReport& poses = result.sessions[0].poses;
  EXPECT_EQ(poses.received, poses.used + poses.not_finite + poses.zero_quaternion +
                                poses.reversed_stamp + poses.duplicate_stamp +
                                poses.repeated_value + poses.outlier + poses.flipped +
                                poses.in_short_segment + poses.between_updates);
  if (fault.check) fault.check(result);
}

const Fault kFaults[] = {
    {"None",
     {},
     {},
     [](const Calibration& r) {
       EXPECT_EQ(r.sessions[0].poses.used, r.sessions[0].poses.received);
       EXPECT_EQ(r.sessions[0].imus[0].gyro.used, r.sessions[0].imus[0].gyro.received);
       EXPECT_EQ(r.sessions[0].imus[0].accel.used, r.sessions[0].imus[0].accel.received);
       EXPECT_EQ(r.sessions[0].segments, 1u);
     }},
    {"Gaps",
     {},
     [](SessionData* d) {
       for (const double t : {3.0, 8.0, 14.0}) RemoveBetween(t, t + 1.0, &d->poses);
     },
     [](const Calibration& r) {
       EXPECT_EQ(r.sessions[0].gaps, 3u);
       EXPECT_EQ(r.sessions[0].jumps, 0u);
     }},
    {"FrozenPoses",
     {},
     [](SessionData* d) {
       for (const double t : {3.0, 8.0, 14.0}) Freeze(t, t + 1.0, d);
     },
     [](const Calibration& r) {
       EXPECT_NEAR(static_cast<double>(r.sessions[0].poses.repeated_value), 300.0, 3.0);
       EXPECT_EQ(r.sessions[0].gaps, 3u);
     }},
    {"Outliers",
     {},
     [](SessionData* d) { AddOutliers(0.02, 1, d); },
     [](const Calibration& r) {
       EXPECT_GE(r.sessions[0].poses.outlier, 25u);
       EXPECT_LE(r.sessions[0].poses.outlier, 60u);
     }},
    {"HalfATurnForASecond",
     {},
     [](SessionData* d) {
       SwapLabels(9.0, 10.0, Turn(180.0, {0, 0, 1}), d);
     },
     [](const Calibration& r) {
       EXPECT_EQ(r.sessions[0].poses.flipped, 100u);
       EXPECT_EQ(r.sessions[0].jumps, 2u);
     }},
    {"AQuarterTurnAtTheEnd",
     {},
     [](SessionData* d) {
       SwapLabels(14.0, 30.0, Turn(90.0, {1, 0, 0}), d);
     },
     [](const Calibration& r) {
       EXPECT_EQ(r.sessions[0].poses.flipped, 600u);
       EXPECT_EQ(r.sessions[0].jumps, 1u);
     }},
    {"LabelsSwappedTwoWaysAfterGaps",
     {},
     [](SessionData* d) {
       SwapLabels(2.0, 5.0, Turn(90.0, {0, 1, 0}), d);
       SwapLabels(12.0, 14.5, Turn(120.0, {1, 1, 1}), d);
       for (const double t : {2.0, 5.0, 12.0, 14.5}) RemoveBetween(t - 0.2, t + 0.2, &d->poses);
     },
     [](const Calibration& r) { EXPECT_EQ(r.sessions[0].poses.flipped, 260u + 210u); }},
    {"AShortFlip",
     {},
     [](SessionData* d) {
       SwapLabels(9.0, 9.05, Turn(90.0, {0, 0, 1}), d);
     },
     [](const Calibration& r) {
       EXPECT_EQ(r.sessions[0].poses.outlier, 5u);
       EXPECT_EQ(r.sessions[0].segments, 1u);  // joined again
     }},
    {"ATrackerThatFindsItselfElsewhere",
     {},
     [](SessionData* d) {
       ChangeBetween(12.0, 30.0, &d->poses,
                     [](PoseSample* s) { s->p_WM += Vector3d(0.3, 0.2, 0); });
     },
     [](const Calibration& r) {
       EXPECT_EQ(r.sessions[0].jumps, 1u);
       EXPECT_EQ(r.sessions[0].poses.used, r.sessions[0].poses.received);
     }},
    {"NanAndZeroPoses",
     {},
     [](SessionData* d) {
       for (size_t i = 0; i < d->poses.size(); i += 50) d->poses[i].p_WM.y() = kNaN;
       for (size_t i = 25; i < d->poses.size(); i += 50) d->poses[i].q_WM.coeffs().setZero();
     },
     [](const Calibration& r) {
       EXPECT_EQ(r.sessions[0].poses.not_finite, 40u);
       EXPECT_EQ(r.sessions[0].poses.zero_quaternion, 40u);
     }},
    {"StampsAstray",
     {},
     [](SessionData* d) {
       d->poses.front().t_ns = 0;
       d->poses[1000].t_ns += 86400 * int64_t{1'000'000'000};
       d->imus[0].gyro.back().t_ns *= 2;
     },
     [](const Calibration& r) {
       EXPECT_EQ(r.sessions[0].poses.reversed_stamp, 2u);
       EXPECT_EQ(r.sessions[0].imus[0].gyro.reversed_stamp, 1u);
     }},
    {"QuaternionSignsAndNorms",
     {},
     [](SessionData* d) {
       for (size_t i = 0; i < d->poses.size(); ++i)
         d->poses[i].q_WM.coeffs() *=
             (i % 3 == 0 ? -1.0 : 1.0) * (1.0 + 0.02 * static_cast<double>(i % 7));
     },
     [](const Calibration& r) {
       EXPECT_EQ(r.sessions[0].poses.used, r.sessions[0].poses.received);
     }},
    {"PosesAt10Hz",
     [](SimulatorOptions* t) {
       t->pose_rate_hz = 10.0;
       t->duration_s = 40.0;
       t->position_std = 2e-3;
       t->rotation_std = 1e-3;
     },
     {},
     {},
     5e-3},
    {"ClockOffByATimeZone", [](SimulatorOptions* t) { t->time_shift_s = -7200.4; }, {}, {}},
    {"ClockOffByDays", [](SimulatorOptions* t) { t->time_shift_s = 12 * 86400.0 + 7.7; }, {}, {}},
    {"LostImuPackets",
     {},
     [](SessionData* d) {
       LosePackets(0.15, 1, &d->imus[0].gyro);
       LosePackets(0.15, 2, &d->imus[0].accel);
       RemoveBetween(6.0, 6.8, &d->imus[0].gyro);
     },
     {},
     1.1e-3},
    {"SaturatedGyroscope",
     {},
     [](SessionData* d) { Clip(3.0, &d->imus[0].gyro); },
     [](const Calibration& r) { EXPECT_GT(r.sessions[0].imus[0].gyro.saturated, 20u); }},
    {"SaturatedAccelerometer",
     {},
     [](SessionData* d) { Clip(13.0, &d->imus[0].accel); },
     [](const Calibration& r) { EXPECT_GT(r.sessions[0].imus[0].accel.saturated, 20u); }},
};

INSTANTIATE_TEST_SUITE_P(Calibrate, RepairedFault, ::testing::ValuesIn(kFaults),
                         [](const auto& test) { return std::string(test.param.name); });

/// A recording that cannot be used as it is, and parts of the one line that says so.
struct Refused {
  const char* name;
  std::function<void(SessionData*)> spoil;
  std::vector<std::string> parts;
};
std::ostream& operator<<(std::ostream& out, const Refused& refused) { return out << refused.name; }

class RefusedRecording : public ::testing::TestWithParam<Refused> {};

TEST_P(RefusedRecording, SaysWhatAndWhatToDo) {
  SessionData data = Simulate(Truth(41));
  GetParam().spoil(&data);
  const std::string text = ErrorText<DataError>([&] { Calibrate(CalibrationOptions(), data); });
  for (const std::string& part : GetParam().parts) EXPECT_TRUE(Contains(text, part));
  EXPECT_EQ(std::count(text.begin(), text.end(), '\n'), 0) << text;
}

template <typename Sample>
void Scale(double factor, std::vector<Sample>* samples) {
  for (Sample& s : *samples) s.value *= factor;
}

const Refused kRefused[] = {
    {"TooShort",
     [](SessionData* d) { d->poses.resize(300); },
     {"pose: 300 of 300 samples are usable and span 2.99 s", "at least 5 s"}},
    {"NoOverlap",
     [](SessionData* d) {
       RemoveBetween(0.0, 10.0, &d->poses);
       RemoveBetween(8.0, 30.0, &d->imus[0].gyro);
       RemoveBetween(8.0, 30.0, &d->imus[0].accel);
     },
     {"agree at no time shift", "overlap"}},
    {"OneSample", [](SessionData* d) { d->imus[0].accel.resize(1); }, {"accelerometer: 1 of 1"}},
    {"GyroscopeInDegrees",
     [](SessionData* d) { Scale(180.0 / M_PI, &d->imus[0].gyro); },
     {"gyroscope", "deg/s", "set gyro_unit: 0.0174532925"}},
    {"GyroscopeInRevolutions",
     [](SessionData* d) { Scale(0.5 / M_PI, &d->imus[0].gyro); },
     {"gyroscope", "times the marker's (bound: 0.5 to 2)", "set gyro_unit"}},
    {"AccelerometerInG",
     [](SessionData* d) { Scale(1.0 / 9.80665, &d->imus[0].accel); },
     {"accelerometer: median norm", "bound: 3.92", "set accel_unit: 9.80665"}},
    {"AccelerometerInMilliG",
     [](SessionData* d) { Scale(1e3 / 9.80665, &d->imus[0].accel); },
     {"accelerometer: median norm", "set accel_unit: 0.00980665"}},
    {"GyroscopeAllZero",
     [](SessionData* d) { Scale(0.0, &d->imus[0].gyro); },
     {"gyroscope: all 4000 samples are zero", "driver"}},
    {"AccelerometerAllZero",
     [](SessionData* d) { Scale(0.0, &d->imus[0].accel); },
     {"accelerometer: all 4000 samples are zero", "driver"}},
    {"ImuAllZero",
     [](SessionData* d) {
       Scale(0.0, &d->imus[0].gyro);
       Scale(0.0, &d->imus[0].accel);
     },
     {"gyroscope: all 4000 samples are zero"}},
    {"ADeadGyroscopeAxis",
     [](SessionData* d) {
       for (ImuSample& s : d->imus[0].gyro) s.value.z() = 0.0;
     },
     {"gyroscope: its z axis is always 0"}},
    {"PositionsInMillimetres",
     [](SessionData* d) {
       for (PoseSample& s : d->poses) s.p_WM *= 1e3;
     },
     {"pose", "look like millimetres", "set position_unit: 1.0e-3"}},
    {"PositionsInCentimetres",
     [](SessionData* d) {
       for (PoseSample& s : d->poses) s.p_WM *= 1e2;
     },
     {"look like centimetres", "set position_unit: 1.0e-2"}},
    {"NoPositions",
     [](SessionData* d) {
       for (PoseSample& s : d->poses) s.p_WM.setZero();
     },
     {"pose: the position never changes"}},
    {"NoOrientations",
     [](SessionData* d) {
       for (PoseSample& s : d->poses) s.q_WM.setIdentity();
     },
     {"pose: the orientation never changes"}},
    {"InvertedPoses",
     [](SessionData* d) {
       for (PoseSample& s : d->poses) {
         s.q_WM = s.q_WM.conjugate();
         s.p_WM = -(s.q_WM * s.p_WM);
       }
     },
     {"agree only when the poses are inverted", "set invert_poses: true"}},
    {"QuaternionsWithWFirst",
     [](SessionData* d) {
       for (PoseSample& s : d->poses) {
         const Quaterniond q = s.q_WM;
         s.q_WM.coeffs() << q.w(), q.x(), q.y(), q.z();
       }
     },
     {"agree only when the poses are inverted", "w, x, y, z, let it write x, y, z, w"}},
    {"AFlippingMarker",
     [](SessionData* d) {
       for (const double t : {3.0, 8.0, 14.0}) SwapLabels(t, t + 3.5, Turn(90.0, {0, 0, 1}), d);
     },
     {"the marker's frame flips", "bound: 60 %", "less symmetrically"}},
    {"ASaturatedGyroscope",
     [](SessionData* d) { Clip(1.0, &d->imus[0].gyro); },
     {"samples are at the end of the sensor's range (1)", "bound: 10 %"}},
};

INSTANTIATE_TEST_SUITE_P(Calibrate, RefusedRecording, ::testing::ValuesIn(kRefused),
                         [](const auto& test) { return std::string(test.param.name); });

TEST(Calibrate, SaysThatGravityIsMissing) {
  SimulatorOptions truth = Truth(42);
  truth.g_W.setZero();
  const std::string text =
      ErrorText<DataError>([&] { Calibrate(CalibrationOptions(), Simulate(truth)); });
  EXPECT_TRUE(Contains(text, "accelerometer"));
  EXPECT_TRUE(Contains(text, "removed"));
  EXPECT_TRUE(Contains(text, "raw accelerometer"));
}

TEST(Calibrate, ReadsTheUnitsAndThePosesAsTheOptionsSay) {
  const SessionData plain = Simulate(Truth(43));
  SessionData data = plain;
  Scale(180.0 / M_PI, &data.imus[0].gyro);
  Scale(1.0 / 9.80665, &data.imus[0].accel);
  for (PoseSample& s : data.poses) {
    s.q_WM = s.q_WM.conjugate();
    s.p_WM = -1e3 * (s.q_WM * s.p_WM);
  }
  CalibrationOptions options;
  options.num_threads = 1;
  const Calibration expected = Calibrate(options, plain);
  options.gyro_unit = M_PI / 180.0;
  options.accel_unit = 9.80665;
  options.position_unit = 1e-3;
  options.invert_poses = true;
  const Calibration result = Calibrate(options, data);
  EXPECT_LT((result.imus[0].T_MI.p - expected.imus[0].T_MI.p).norm(), 1e-6);
  EXPECT_LT(result.imus[0].T_MI.q.angularDistance(expected.imus[0].T_MI.q), 1e-6);
  EXPECT_NEAR(result.sessions[0].imus[0].time_shift, expected.sessions[0].imus[0].time_shift, 1e-7);
}

}  // namespace
}  // namespace imu_pose_calib
