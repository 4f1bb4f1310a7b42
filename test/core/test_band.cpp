#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <random>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibration/band.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/start/preparation.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

/// A session whose gyroscope, accelerometer and positions swing at `hz` with an amplitude of 1, its
/// rotations by 0.1 rad; its trajectory follows 0.8 Hz at most.
PreparedSession Swinging(double hz) {
  PreparedSession session;
  session.data.imus.resize(1);
  session.starts.resize(1);
  ConditionedImu& imu = session.data.imus[0];
  imu.gyro_report.rate_hz = imu.accel_report.rate_hz = 200.0;
  for (int k = 0; k < 2000; ++k) {
    const double t = k / 200.0;
    const Eigen::Vector3d value(9.8, std::sin(2.0 * M_PI * hz * t), 0.0);
    imu.gyro.push_back({t, value, {0, 0, 0}});
    imu.accel.push_back({t, value, {0, 0, 0}});
  }
  for (int k = 0; k < 1000; ++k) {
    const Eigen::Vector3d swing(0.0, std::sin(2.0 * M_PI * hz * k / 100.0), 0.0);
    session.data.poses.push_back(
        {k / 100.0, Exp<double>(0.1 * swing), swing, 1.0, 1.0, {0, 0, 0}, {0, 0, 0}});
  }
  session.data.pose_report.rate_hz = 100.0;
  session.data.segments = {{0, 1000}};
  session.trajectory = std::make_shared<PoseTrajectory>(session.data.poses, session.data.segments,
                                                        GpHyperparameters{1.0, 1.0, 0.1},
                                                        GpHyperparameters{1.0, 1.0, 0.1});
  return session;
}

TEST(LimitBand, TakesWhatIsFasterAndKeepsWhatIsSlower) {
  const auto remains = [](double hz) {
    const PreparedSession limited = LimitBand(Swinging(hz), 10.0, 1);
    const ConditionedImu& imu = limited.data.imus[0];
    double largest = 0.0;
    for (size_t k = 200; k + 200 < imu.gyro.size(); ++k) {
      EXPECT_NEAR(imu.gyro[k].value.x(), 9.8, 1e-6);
      EXPECT_EQ(imu.gyro[k].value, imu.accel[k].value);
      EXPECT_NEAR(imu.gyro[k].value.y() + imu.gyro[k].rest.y(),
                  std::sin(2.0 * M_PI * hz * imu.gyro[k].t), 1e-12);
      largest = std::max(largest, std::abs(imu.gyro[k].value.y()));
    }
    double of_positions = 0.0, of_rotations = 0.0;
    for (size_t k = 100; k + 100 < limited.data.poses.size(); ++k) {
      const TimedPose& pose = limited.data.poses[k];
      EXPECT_NEAR(pose.p_WM.y() + pose.position_rest.y(), std::sin(2.0 * M_PI * hz * pose.t),
                  1e-12);
      of_positions = std::max(of_positions, std::abs(pose.p_WM.y()));
      of_rotations = std::max(of_rotations, Log(pose.q_WM).norm() / 0.1);
    }
    EXPECT_NEAR(of_positions, largest, 0.03);
    EXPECT_NEAR(of_rotations, largest, 0.03);
    return largest;
  };
  EXPECT_NEAR(remains(1.0), 1.0, 1e-5);
  EXPECT_NEAR(remains(5.0), 1.0, 1e-3);
  EXPECT_NEAR(remains(10.0), 0.5, 0.02);
  EXPECT_LT(remains(14.0), 1e-3);
}

TEST(Thinned, HasOnePoseOfAFewWhichStandsForThem) {
  const auto total = [](const auto& samples) {
    int sum = 0;
    for (const auto& sample : samples) sum += sample.count;
    return sum;
  };
  // One in 33 ms of 100 Hz.
  const PreparedSession thinned = Thinned(LimitBand(Swinging(1.0), 5.0, 1), 0.033);
  std::map<int, int> counts;
  for (const TimedPose& pose : thinned.data.poses)
    if (pose.t >= 1.0 && pose.t < 9.0) ++counts[pose.count];
  EXPECT_EQ(counts, (std::map<int, int>{{3, 170}, {4, 73}}));
  EXPECT_EQ(thinned.data.segments[0].begin, 0u);
  EXPECT_EQ(thinned.data.segments[0].end, thinned.data.poses.size());
  EXPECT_EQ(total(thinned.data.poses), 1000);
  // Poses that state different noise do not stand for each other.
  PreparedSession stated = Swinging(1.0);
  for (size_t k = 0; k < 1000; k += 2) stated.data.poses[k].rotation_scale = 3.0;
  EXPECT_EQ(Thinned(LimitBand(stated, 5.0, 1), 0.033).data.poses.size(), 1000u);
}

TEST(Resample, TakesSamplesAtTheKnotsAndBetweenThemByTheClocks) {
  PreparedSession recorded = Swinging(1.0);
  // Some 100 ms without the gyroscope: beyond two knots.
  std::vector<TimedSample>& gyro = recorded.data.imus[0].gyro;
  gyro.erase(gyro.begin() + 1000, gyro.begin() + 1020);
  const PreparedSession limited = LimitBand(recorded, Band(0.02), 1);
  Estimate estimate(limited, 10.0);
  const CorrectionSplines splines(limited.data, estimate, 0, 0.02);
  const std::vector<ImuInstants> instants = FindInstants(limited, estimate.sessions[0], splines);
  ASSERT_EQ(splines.Runs().size(), 2u);
  size_t spans = 0;
  for (const CorrectionSplines::Run& run : splines.Runs()) {
    EXPECT_LT(run.begin, run.end);
    EXPECT_TRUE(run.end < 5.0 || run.begin > 5.09);
    spans += run.spans;
  }
  ASSERT_EQ(instants[0].gyro.size(), spans);
  ASSERT_EQ(instants[0].accel.size(), spans - 2);  // none at the ends
  EXPECT_NEAR(splines.Locate(instants[0].gyro[7])->u, 0.5, 1e-6);
  EXPECT_NEAR(splines.Locate(instants[0].accel[7] + 1e-9)->u, 0.0, 1e-6);

  // A clock that is found 3 ms and an accelerometer that is 1 ms later.
  estimate.sessions[0].imus[0].time_shift += 3e-3;
  estimate.imus[0].accel_delay += 1e-3;
  PreparedSession thinned = limited;
  Resample(limited, instants, estimate, 0, splines.spacing(), 1, &thinned);
  const auto check = [&](const std::vector<TimedSample>& samples, const std::vector<double>& times,
                         double later) {
    ASSERT_EQ(samples.size(), times.size());
    for (size_t k = 0; k < samples.size(); ++k) {
      EXPECT_NEAR(samples[k].t, times[k] - 3e-3 + later, 1e-9);
      if (k < 20 || k + 20 > samples.size()) continue;
      if (std::abs(samples[k].t - 5.05) < 0.3) continue;
      EXPECT_NEAR(samples[k].value.y(), std::sin(2.0 * M_PI * samples[k].t), 1e-4);
      EXPECT_EQ(samples[k].count, 4);  // of 200 Hz
    }
  };
  check(thinned.data.imus[0].gyro, instants[0].gyro, 0.0);
  check(thinned.data.imus[0].accel, instants[0].accel, 1e-3);
}

TEST(LimitBand, SmoothsTheTrajectoryWhereItIsFaster) {
  SimulatorOptions truth;
  truth.duration_s = 20.0;
  CalibrationOptions options;
  options.rotation_lengthscale_s = 0.03;
  DataCheck check;
  const PreparedSession session = Prepare(options, Simulate(truth), &check);
  const PreparedSession limited = LimitBand(session, 5.0, 1);
  EXPECT_GT(limited.trajectory->rotation_hyperparameters().lengthscale_s, 0.1);
  const TrueTrajectory exact(truth);
  double before = 0.0, after = 0.0;
  for (double t = 2.0; t < 18.0; t += 0.01) {
    MarkerState<double> wide, narrow;
    ASSERT_TRUE(session.trajectory->Evaluate(t, &wide));
    ASSERT_TRUE(limited.trajectory->Evaluate(t, &narrow));
    before += (wide.alpha_M - exact.At(t).alpha_M).squaredNorm();
    after += (narrow.alpha_M - exact.At(t).alpha_M).squaredNorm();
  }
  EXPECT_LT(after, 0.1 * before);
  ASSERT_EQ(limited.data.poses.size(), session.data.poses.size());
  for (size_t i = 0; i < session.data.poses.size(); ++i) {
    const TimedPose& pose = limited.data.poses[i];
    const Eigen::Quaterniond recorded = pose.q_WM * Exp(pose.rotation_rest);
    EXPECT_LT(recorded.angularDistance(session.data.poses[i].q_WM), 1e-9);
  }
}

/// Norm of the difference of two lever arms in sigma of the first.
double Sigmas(const Calibration& a, const Calibration& b) {
  return (a.imus[0].T_MI.p - b.imus[0].T_MI.p)
      .cwiseQuotient(a.imus[0].Std().head<3>())
      .cwiseAbs()
      .maxCoeff();
}

/// Error of the lever arm, in sigma.
double Error(const Calibration& result, const SimulatorOptions& truth) {
  return (result.imus[0].T_MI.p - truth.T_MI.p)
      .cwiseQuotient(result.imus[0].Std().head<3>())
      .cwiseAbs()
      .maxCoeff();
}

TEST(OneBand, TheResultDoesNotDependOnWhereItIsLinearised) {
  // Rotations that follow fast noise of which the positions know nothing.
  SimulatorOptions truth;
  truth.seed = 5;
  truth.duration_s = 30.0;
  truth.effects.rocking = 0.1;
  const SessionData data = Simulate(truth);
  CalibrationOptions options;
  options.num_threads = 1;
  const Calibration usual = Calibrate(options, data);
  for (const double lengthscale : {0.02, 0.05}) {
    options.rotation_lengthscale_s = lengthscale;
    EXPECT_LT(Sigmas(usual, Calibrate(options, data)), 0.3) << lengthscale;
  }
}

TEST(OneBand, NoiseOfThePosesBeyondItFeignsNoSmoothing) {
  // Next to a gyroscope as weak as this, dense knots follow the noise of the rotations.
  SimulatorOptions truth;
  truth.duration_s = 20.0;
  truth.position_std = 1e-4;
  truth.rotation_std = 2e-4;
  truth.gyro_std = 0.011;
  CalibrationOptions options;
  options.knot_spacing_s = 0.02;
  double mean = 0.0;
  for (truth.seed = 20; truth.seed < 24; ++truth.seed) {
    const Calibration result = Calibrate(options, Simulate(truth));
    mean += result.pose_smoothing / result.pose_smoothing_std / 4.0;
  }
  EXPECT_NEAR(mean, 0.0, 1.5);
}

TEST(OneBand, VibrationThatComesBackThroughGapsFeignsNoSmoothing) {
  // Next to an accelerometer of which 3 % is lost while it shakes, positions lead; p was 13 mm off.
  SimulatorOptions truth;
  truth.seed = 2;
  truth.duration_s = 60.0;
  truth.motion = Motion::kDrone;
  truth.pose_rate_hz = 41.0;
  truth.gyro_rate_hz = truth.accel_rate_hz = 144.0;
  truth.position_std = 1.4e-4;
  truth.rotation_std = 2.7e-3;
  truth.gyro_std = 1.7e-3;
  truth.accel_std = 0.018;
  truth.effects.rocking = 0.11;
  SessionData data = Simulate(truth);
  std::mt19937 random(2);
  std::uniform_real_distribution<> share(0.0, 1.0);
  const auto is_lost = [&](const ImuSample&) { return share(random) <= 0.03; };
  std::vector<ImuSample>& accel = data.imus[0].accel;
  accel.erase(std::remove_if(accel.begin(), accel.end(), is_lost), accel.end());
  const Calibration result = Calibrate({}, data);
  EXPECT_LT(std::abs(result.position_smoothing), 1e-3);
  const Eigen::Vector3d error = result.imus[0].T_MI.p - truth.T_MI.p;
  EXPECT_LT(error.cwiseQuotient(result.imus[0].Std().head<3>()).cwiseAbs().maxCoeff(), 3.5);
}

TEST(OneBand, VibrationBeyondItCostsNothing) {
  SimulatorOptions truth;
  truth.seed = 6;
  truth.duration_s = 30.0;
  const Calibration calm = Calibrate(CalibrationOptions(), Simulate(truth));
  for (const bool is_rocking : {false, true}) {
    truth.effects.rocking = is_rocking ? 0.1 : 0.0;
    truth.effects.vibration = is_rocking ? 0.0 : 2.0;
    const Calibration shaken = Calibrate(CalibrationOptions(), Simulate(truth));
    EXPECT_LT(Error(shaken, truth), 4.0);
    EXPECT_LT(shaken.imus[0].Std().head<3>().norm(), 7.0 * calm.imus[0].Std().head<3>().norm());
  }
}

TEST(OrdinaryImus, FlawsThatAreUsualAreNoErrors) {
  SimulatorOptions truth;
  truth.seed = 7;
  truth.duration_s = 40.0;
  const Calibration flawless = Calibrate(CalibrationOptions(), Simulate(truth));
  truth.effects.scale_misalignment = 0.005;
  truth.clock_drift = 40e-6;
  const Calibration result = Calibrate(CalibrationOptions(), Simulate(truth));
  EXPECT_EQ(result.status, Status::kOk);
  EXPECT_LT(Error(result, truth), 4.0);
  EXPECT_LT(result.imus[0].Std().head<3>().norm(), 1.3 * flawless.imus[0].Std().head<3>().norm());
}

TEST(OrdinaryImus, AnAccelerometerThatAveragesLongerIsRecognised) {
  // While a body hovers, its tilts turn gravity as a lever arm would.
  SimulatorOptions truth;
  truth.motion = Motion::kDrone;
  truth.seed = 8;
  truth.duration_s = 40.0;
  truth.effects.accel_filter_hz = 5.0;
  truth.effects.gyro_filter_hz = 20.0;
  const SessionData data = Simulate(truth);
  const Calibration result = Calibrate(CalibrationOptions(), data);
  EXPECT_LT(Error(result, truth), 5.0);
  EXPECT_GT(result.imus[0].accel_smoothing, 5e-4);
  CalibrationOptions options;
  options.estimate_accel_smoothing = false;
  EXPECT_GT(Error(Calibrate(options, data), truth), 5.0);
}

TEST(OrdinaryImus, AGyroscopeThatAveragesLongerIsAccountedFor) {
  // Turn rates that are averaged are not those of a rotation that is: what they integrate to cones.
  SimulatorOptions truth;
  truth.duration_s = 60.0;
  truth.effects.gyro_filter_hz = 10.0;
  truth.seed = 2;  // it was taken for a soft mount
  EXPECT_EQ(Calibrate(CalibrationOptions(), Simulate(truth)).status, Status::kOk);
  truth.effects.gyro_filter_hz = 17.0;
  for (const double accel_filter_hz : {0.0, 17.0}) {
    SCOPED_TRACE(accel_filter_hz);
    truth.effects.accel_filter_hz = accel_filter_hz;
    const double filter = std::pow(2.0 * M_PI * 17.0, -2);  // [s^2]
    double squares = 0.0;
    for (truth.seed = 1; truth.seed <= 3; ++truth.seed) {
      const Calibration result = Calibrate(CalibrationOptions(), Simulate(truth));
      EXPECT_EQ(result.status, Status::kOk);
      const double sigmas = Error(result, truth);
      EXPECT_LT(sigmas, 3.0) << truth.seed;
      squares += sigmas * sigmas;
      EXPECT_NEAR(result.imus[0].gyro_smoothing, filter, 0.4 * filter);
      EXPECT_NEAR(result.imus[0].accel_smoothing, accel_filter_hz > 0.0 ? 0.0 : -filter,
                  0.4 * filter);
    }
    EXPECT_LT(squares, 3.0 * 2.0 * 2.0);  // 5.0, 1.9 and 2.8 sigma without it
  }
}

TEST(OrdinaryImus, ASoftMountIsAccountedForAndNamed) {
  SimulatorOptions truth;
  truth.seed = 2;
  truth.duration_s = 60.0;
  for (const double resonance : {8.0, 9.0, 12.0, 25.0, 40.0}) {  // 9: 10 sigma from rigid on
    SCOPED_TRACE(resonance);
    truth.effects.mount_hz = resonance;
    const SessionData data = Simulate(truth);
    const Calibration result = Calibrate(CalibrationOptions(), data);
    EXPECT_LT(Error(result, truth), 3.0);
    EXPECT_EQ(result.status, resonance < 15.0 ? Status::kWeak : Status::kOk) << result.message;
    if (resonance > 15.0) continue;
    EXPECT_NEAR(result.imus[0].mount_compliance, std::pow(2.0 * M_PI * resonance, -2.0),
                3.0 * result.imus[0].mount_compliance_std + 4e-5);
    EXPECT_NE(result.message.find("mount of the imu is soft"), std::string::npos) << result.message;
    CalibrationOptions options;
    options.estimate_mount_compliance = false;
    EXPECT_GT(Error(Calibrate(options, data), truth), 3.0);
  }
}

}  // namespace
}  // namespace imu_pose_calib
