// Recordings whose IMU drops out or shows spikes: calibrated all the same.

#include <gtest/gtest.h>

#include <functional>
#include <ostream>
#include <random>

#include "faults.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/data/conditioned_data.h"
#include "imu_pose_calib/core/start/initializer.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using Eigen::Quaterniond;
using Eigen::Vector3d;
using Vector8d = Eigen::Matrix<double, 8, 1>;

SimulatorOptions Truth(uint32_t seed) {
  SimulatorOptions truth;
  truth.seed = seed;
  truth.T_MI = {Quaterniond(0.3, -0.5, 0.1, 0.8).normalized(), {0.06, -0.08, 0.05}};
  truth.accel_delay_s = 0.003;
  return truth;
}

Calibration Calibrated(const SessionData& data) {
  CalibrationOptions options;
  options.num_threads = 1;
  return Calibrate(options, data);
}

/// (p_MI, rotation, time_shift, accel_delay) of `a` less those of `b`.
Vector8d Difference(const Calibration& a, const Rigid3& b, double time_shift, double accel_delay) {
  const ImuCalibration& imu = a.imus[0];
  Vector8d e;
  e << imu.T_MI.p - b.p, Log(Quaterniond(b.q.conjugate() * imu.T_MI.q)),
      a.sessions[0].imus[0].time_shift - time_shift, imu.accel_delay - accel_delay;
  return e;
}

Vector8d Sigma(const Calibration& a) {
  Vector8d sigma;
  sigma << a.imus[0].Std(), a.sessions[0].imus[0].time_shift_std, a.imus[0].accel_delay_std;
  return sigma;
}

/// Seconds that the IMU lacks.
struct Dropouts {
  const char* name;
  std::vector<std::pair<double, double>> gyro, accel;
};
std::ostream& operator<<(std::ostream& out, const Dropouts& d) { return out << d.name; }

class ImuDropout : public ::testing::TestWithParam<Dropouts> {};

TEST_P(ImuDropout, LeavesTheCalibrationWithinItsSigmas) {
  for (const uint32_t seed : {41u, 42u}) {
    SCOPED_TRACE(seed);
    const SimulatorOptions truth = Truth(seed);
    SessionData data = Simulate(truth);
    for (auto [begin, end] : GetParam().gyro) RemoveBetween(begin, end, &data.imus[0].gyro);
    for (auto [begin, end] : GetParam().accel) RemoveBetween(begin, end, &data.imus[0].accel);
    const Calibration result = Calibrated(data);
    EXPECT_TRUE(result.IsUsable()) << result.message;
    const Vector8d e = Difference(result, truth.T_MI, truth.time_shift_s, truth.accel_delay_s);
    const Vector8d sigma = Sigma(result);
    EXPECT_LT(e.cwiseQuotient(sigma).cwiseAbs().maxCoeff(), 4.0) << e.transpose() << "\n"
                                                                 << sigma.transpose();
    EXPECT_LT(sigma.head<3>().maxCoeff(), 3e-4);
    EXPECT_LT(sigma.tail<2>().maxCoeff(), 6e-5);
  }
}

/// Start of the 8 s of `Truth(seed)` with the largest mean square of alpha.
double Liveliest(uint32_t seed) {
  const TrueTrajectory trajectory(Truth(seed));
  double most = 0.0, best = 0.0;
  for (double t = 0.0; t <= 32.0; t += 0.5) {
    double sum = 0.0;
    for (double s = t; s < t + 8.0; s += 0.02) sum += trajectory.At(s).alpha_M.squaredNorm();
    if (sum > most) most = sum, best = t;
  }
  return best;
}

const double kLively = Liveliest(41);

const Dropouts kDropouts[] = {
    {"InTheMiddle", {{18.5, 21.5}}, {{18.5, 21.5}}},
    {"OfTheLiveliestSeconds", {{kLively, kLively + 8.0}}, {{kLively, kLively + 8.0}}},
    {"OfTheGyroscope", {{10.0, 13.0}, {24.0, 28.0}}, {}},
    {"OfTheAccelerometer", {}, {{10.0, 13.0}, {24.0, 28.0}}},
    {"OfOneAfterTheOther", {{8.0, 16.0}}, {{16.0, 24.0}}},
    {"OfTheGyroscopeOverMost", {{6.0, 34.0}}, {}},
    {"Often",
     {{3, 4}, {7, 9}, {12, 12.5}, {15, 18}, {20, 20.3}, {25, 29}, {33, 34}},
     {{3, 4}, {7, 9}, {12, 12.5}, {15, 18}, {20, 20.3}, {25, 29}, {33, 34}}},
    {"OftenApart",
     {{3, 4}, {7, 9}, {15, 18}, {25, 29}},
     {{5, 6}, {8, 10}, {20, 22}, {28, 31}, {35, 36}}},
    {"AllButSnatches",
     {{2, 5.8}, {6.1, 9.8}, {10.1, 13.8}, {14.1, 17.8}},
     {{2, 5.8}, {6.1, 9.8}, {10.1, 13.8}, {14.1, 17.8}}},
};
INSTANTIATE_TEST_SUITE_P(All, ImuDropout, ::testing::ValuesIn(kDropouts),
                         [](const auto& info) { return info.param.name; });

/// Samples that are off by `size` in any direction.
void AddSpikes(size_t count, double size, uint32_t seed, std::vector<ImuSample>* samples) {
  std::mt19937 random(seed);
  for (size_t k = 0; k < count; ++k)
    (*samples)[random() % samples->size()].value += size * RandomAxis(&random);
}

SessionData WithSpikes(const SimulatorOptions& truth, size_t count) {
  SessionData data = Simulate(truth);
  AddSpikes(count, 30.0, 1, &data.imus[0].gyro);
  AddSpikes(count, 500.0, 2, &data.imus[0].accel);
  return data;
}

TEST(ImuSpikes, MoveTheCalibrationByLessThanHalfASigma) {
  const SimulatorOptions truth = Truth(43);
  const Calibration clean = Calibrated(Simulate(truth));
  ASSERT_TRUE(clean.IsUsable());
  for (const size_t count : {1u, 4u, 20u}) {
    SCOPED_TRACE(count);
    const Calibration result = Calibrated(WithSpikes(truth, count));
    EXPECT_TRUE(result.IsUsable()) << result.message;
    const Vector8d moved =
        Difference(result, clean.imus[0].T_MI, clean.sessions[0].imus[0].time_shift,
                   clean.imus[0].accel_delay);
    EXPECT_LT(moved.cwiseQuotient(Sigma(clean)).cwiseAbs().maxCoeff(), 0.5) << moved.transpose();
    EXPECT_LT(Sigma(result).cwiseQuotient(Sigma(clean)).maxCoeff(), 1.2);
    EXPECT_EQ(result.warnings, clean.warnings);
  }
}

TEST(ImuSpikes, DoNotMoveTheStart) {
  const SimulatorOptions truth = Truth(44);
  const auto start = [&](size_t count) {
    CalibrationOptions options;
    ConditionedData data = ConditionData(options, WithSpikes(truth, count));
    const PoseTrajectory trajectory = FitTrajectory(options, &data);
    return Initialise(options, trajectory, data, 0);
  };
  const Start clean = start(0);
  for (const size_t count : {1u, 4u, 20u, 100u}) {
    SCOPED_TRACE(count);
    const Start spiky = start(count);
    EXPECT_NEAR(spiky.time_shift, clean.time_shift, 1e-3);
    EXPECT_LT(spiky.q_MI.angularDistance(clean.q_MI), 1e-3);
    EXPECT_LT((spiky.p_MI - clean.p_MI).norm(), 1e-3);
    EXPECT_NEAR(spiky.accel_delay, clean.accel_delay, 3e-5);
  }
}

TEST(ImuSpikes, HideNoJump) {
  SimulatorOptions truth = Truth(45);
  truth.duration_s = 20.0;
  SessionData data = WithSpikes(truth, 4);
  ChangeBetween(12.0, 30.0, &data.poses, [](PoseSample* s) { s->p_WM += Vector3d(0.08, 0.05, 0); });
  CalibrationOptions options;
  ConditionedData conditioned = ConditionData(options, data);
  SplitAtJumps(options, &conditioned);
  EXPECT_EQ(conditioned.jumps, 1u);
}

TEST(ImuSpikes, AreNotSeenInACleanRecording) {
  for (const Motion motion : {Motion::kHandheld, Motion::kTumble, Motion::kHinge})
    for (const double noise : {0.0, 0.01, 1.0}) {
      SimulatorOptions truth = Truth(46);
      truth.motion = motion;
      truth.gyro_std *= noise;
      truth.accel_std *= noise;
      const ConditionedData data = ConditionData(CalibrationOptions(), Simulate(truth));
      EXPECT_EQ(data.imus[0].gyro_report.outlier, 0u) << ToString(motion) << " " << noise;
      EXPECT_EQ(data.imus[0].accel_report.outlier, 0u) << ToString(motion) << " " << noise;
    }
}

TEST(ImuSpikes, LeaveAlone) {
  SessionData data = Simulate(Truth(47));
  for (const size_t i : {0u, 500u, 501u, 502u, 3000u, 3005u, 7999u})
    data.imus[0].gyro[i].value += Vector3d(5.0, -8.0, 0.0);
  const ConditionedImu imu = ConditionData(CalibrationOptions(), data).imus[0];
  EXPECT_EQ(imu.gyro_report.outlier, 7u);
  EXPECT_EQ(imu.gyro_report.used, 8000u - 7u);
  EXPECT_EQ(imu.accel_report.outlier, 0u);
  for (const TimedSample& s : imu.gyro) EXPECT_LT(s.value.norm(), 5.0);
}

TEST(ImuSpikes, AreNoKnocks) {
  // A body that rests but for knocks of six samples each.
  SimulatorOptions truth = Truth(48);
  truth.motion = Motion::kStatic;
  SessionData data = Simulate(truth);
  for (size_t i = 500; i < 7500; i += 500)
    for (size_t k = 0; k < 6; ++k)
      data.imus[0].accel[i + k].value.x() +=
          80.0 * std::sin(M_PI * static_cast<double>(k + 1) / 7.0);
  EXPECT_EQ(ConditionData(CalibrationOptions(), data).imus[0].accel_report.outlier, 0u);
}

}  // namespace
}  // namespace imu_pose_calib
