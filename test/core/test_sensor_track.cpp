// Ground truth of a pose sensor, and the errors of its own trajectory.

#include <gtest/gtest.h>

#include <cmath>
#include <random>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/pose_sensor/sensor_track.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

using Eigen::Matrix4d;
using Eigen::Quaterniond;
using Eigen::Vector3d;

Rigid3 RandomPose(std::mt19937* random, double turn, double shift) {
  std::normal_distribution<double> normal;
  const auto draw = [&] { return Vector3d(normal(*random), normal(*random), normal(*random)); };
  const Vector3d r = turn * draw();
  return {Exp<double>(r), shift * draw()};
}

/// As evo computes them (metrics.py, APE.process_data and RPE.process_data), on 4x4 matrices:
/// E_i = Q_i^-1 P_i, E_i = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j); length of the translation, angle by the
/// trace; rms.
PoseStd Rms(const std::vector<Matrix4d>& errors) {
  double squares = 0.0, angles = 0.0;
  for (const Matrix4d& E : errors) {
    squares += E.topRightCorner<3, 1>().squaredNorm();
    angles += std::pow(std::acos(0.5 * (E.topLeftCorner<3, 3>().trace() - 1.0)), 2);
  }
  const auto n = static_cast<double>(errors.size());
  return {std::sqrt(squares / n), std::sqrt(angles / n)};
}

TEST(SensorErrors, AreThoseOfEvo) {
  constexpr size_t kPoses = 51, kSecond = 10;
  constexpr double kBegin = 1.6e9;
  std::mt19937 random(3);
  PoseSensorSession session;
  session.scale = 0.5;
  session.poses.rate_hz = 10.0;
  const Rigid3 start = RandomPose(&random, 1.0, 2.0);
  std::vector<Rigid3> truth;
  std::vector<Matrix4d> P, Q;
  for (size_t i = 0; i < kPoses; ++i) {
    const double t = kBegin + 0.1 * static_cast<double>(i);
    // Two pieces.
    const Rigid3 T_VW = start * RandomPose(&random, i == 0 ? 0.0 : 0.05, i == 0 ? 0.0 : 0.1);
    session.world.push_back({t, T_VW, i == 0 || i == 26});
    truth.push_back(RandomPose(&random, 0.5, 1.0));
    Q.push_back(truth.back().Matrix());
  }
  for (size_t i = 0; i < kPoses; ++i) {
    const double t = kBegin + 0.1 * static_cast<double>(i);
    const Rigid3 measured = start * truth[i] * RandomPose(&random, 0.1, 0.1);
    const Rigid3& T_VW = session.world[i].T_VW;
    const Vector3d p_VS = T_VW.p + session.scale * (T_VW.q * truth[i].p);
    const Quaterniond q_VS = T_VW.q * truth[i].q;
    session.residuals.push_back({t, session.scale * measured.p - p_VS,
                                 Log(Quaterniond(q_VS.conjugate() * measured.q)), 1.0, 1.0});
    const Rigid3 in_W{start.q.conjugate() * measured.q,
                      start.q.conjugate() * (measured.p - start.p / session.scale)};
    P.push_back(in_W.Matrix());
  }
  const auto T_WS = [&](double t) -> std::optional<Rigid3> {
    return truth[static_cast<size_t>(std::lround(10.0 * (t - kBegin)))];
  };
  std::vector<Matrix4d> absolute, relative;
  for (size_t i = 0; i < kPoses; ++i) absolute.push_back(Q[i].inverse() * P[i]);
  for (size_t i = 0, j = kSecond; j < kPoses; ++i, ++j)
    relative.push_back((Q[i].inverse() * Q[j]).inverse() * (P[i].inverse() * P[j]));
  const SensorErrors errors = FindErrors(session, T_WS);
  EXPECT_EQ(errors.poses, kPoses);
  EXPECT_EQ(errors.pairs, kPoses - kSecond);
  EXPECT_NEAR(errors.absolute.position, Rms(absolute).position, 1e-6);
  EXPECT_NEAR(errors.absolute.rotation, Rms(absolute).rotation, 1e-6);
  EXPECT_NEAR(errors.relative.position, Rms(relative).position, 1e-6);
  EXPECT_NEAR(errors.relative.rotation, Rms(relative).rotation, 1e-6);

  // Without truth for the first half, nor pairs with it.
  const SensorErrors half =
      FindErrors(session, [&](double t) { return t < kBegin + 2.55 ? std::nullopt : T_WS(t); });
  EXPECT_EQ(half.poses, 25u);
  EXPECT_EQ(half.pairs, 15u);
}

class SensorTrackTest : public testing::Test {
 protected:
  static SimulatorOptions Truth() {
    SimulatorOptions truth;
    truth.duration_s = 20.0;
    truth.time_shift_s = 2.5;
    truth.pose_sensors.resize(1);
    truth.pose_sensors[0].time_shift_s = -70.25;
    return truth;
  }
  static Calibration Solve(const SimulatorOptions& truth, bool has_imu) {
    SessionData data = Simulate(truth);
    if (!has_imu) data.imus.clear();
    Calibration result = Calibrate({}, data);
    EXPECT_EQ(result.status, Status::kOk) << result.message;
    return result;
  }
  /// T_WS as it was at t [s] after the first pose.
  static Rigid3 True(const SimulatorOptions& truth, const TrueTrajectory& trajectory, double t) {
    const TrueState s = trajectory.At(t);
    return Rigid3{Quaterniond(s.R_WM), s.p_WM} * truth.pose_sensors[0].T_MS;
  }
  /// Every state is that of the sensor at a stamp of its clock.
  static void ExpectTrue(const SimulatorOptions& truth, const SensorTrack& track,
                         const std::vector<ImuTrack::Instant>& instants, double clock_ahead) {
    const TrueTrajectory trajectory(truth);
    size_t states = 0;
    for (const ImuTrack::Instant& instant : instants) {
      const auto state = track.At(instant.t);
      if (!state) continue;
      ++states;
      const Rigid3 T_WS =
          True(truth, trajectory,
               1e-9 * static_cast<double>(instant.stamp_ns - truth.start_ns) + clock_ahead);
      ASSERT_LT((state->p_WB - T_WS.p).norm(), 3e-3) << instant.stamp_ns;
      ASSERT_LT(T_WS.q.angularDistance(state->q_WB), 3e-3) << instant.stamp_ns;
    }
    EXPECT_GT(states + 5, instants.size());
  }
};

TEST_F(SensorTrackTest, IsWhereTheSensorWasOnEitherClock) {
  const SimulatorOptions truth = Truth();
  const std::vector<PoseSample> poses = Simulate(truth).pose_sensors[0];
  for (const bool has_imu : {false, true}) {
    const Calibration result = Solve(truth, has_imu);
    const SensorTrack track(result.solution, 0, result.pose_sensors[0]);
    const auto instants = track.Instants(0.0);
    ASSERT_GT(instants.size(), poses.size() - 10);
    auto pose = poses.begin();
    for (const ImuTrack::Instant& instant : instants) {
      while (pose != poses.end() && pose->t_ns < instant.stamp_ns) ++pose;
      ASSERT_EQ(pose->t_ns, instant.stamp_ns);
    }
    ExpectTrue(truth, track, instants, truth.pose_sensors[0].time_shift_s);
    const auto even = track.Instants(100.0);
    EXPECT_EQ(even[7].stamp_ns, even[0].stamp_ns + 70'000'000);
    EXPECT_NEAR(static_cast<double>(even.size()), 2000.0, 20.0);
    ExpectTrue(truth, track, even, truth.pose_sensors[0].time_shift_s);
    const SensorTrack on_poses(result.solution, 0, result.pose_sensors[0], TrackClock::kPoses);
    ExpectTrue(truth, on_poses, on_poses.Instants(0.0), 0.0);
    ExpectTrue(truth, on_poses, on_poses.Instants(100.0), 0.0);
    EXPECT_EQ(track.has_covariance(), has_imu);
    EXPECT_EQ(track.At(7.0)->covariance.isZero(), !has_imu);
  }
}

/// Each part of the covariance alone.
TEST_F(SensorTrackTest, CovarianceIsOfMarkerMountAndClock) {
  const Calibration result = Solve(Truth(), true);
  const TrajectoryCovariance covariance(result.solution);
  PoseSensorCalibration sensor = result.pose_sensors[0];
  const double t = 6.3, h = 1e-5;
  const auto at = [&](const PoseSensorCalibration& s, TrackClock clock, double time) {
    return SensorTrack(result.solution, 0, s, clock).At(time).value();
  };
  const auto difference = [](const ImuState& a, const ImuState& b) {
    Eigen::Matrix<double, 12, 1> d;
    d << Log(Quaterniond(a.q_WB.conjugate() * b.q_WB)), b.p_WB - a.p_WB, b.omega_B - a.omega_B,
        b.v_W - a.v_W;
    return d;
  };
  // The marker's: that of an IMU whose mount is known.
  sensor.covariance.setZero();
  sensor.T_MS = result.imus[0].T_MI;
  const SessionTrajectory trajectory(result.solution, 0);
  SessionTrajectory::StateJacobian J;
  ASSERT_TRUE(trajectory.Imu(0, t, &J));
  constexpr int kPoints = 6 * kSplineOrder;
  const Eigen::MatrixXd C =
      covariance.At(covariance.ControlPoints(0, result.solution->splines[0].Locate(t)->first));
  const Eigen::MatrixXd by_points = J.topLeftCorner<12, kPoints>();
  const auto of_marker = at(sensor, TrackClock::kPoses, t).covariance;
  EXPECT_TRUE(of_marker.isApprox(by_points * C * by_points.transpose(), 1e-6));

  sensor.T_MS = result.pose_sensors[0].T_MS;
  const ImuState state = at(sensor, TrackClock::kPoses, t);
  for (int i = 0; i < 6; ++i) {
    PoseSensorCalibration moved = sensor, known = sensor;
    known.covariance(i, i) = 1.0;
    const Vector3d step = h * Vector3d::Unit(i % 3);
    if (i < 3) moved.T_MS.p += step;
    if (i >= 3) moved.T_MS.q = moved.T_MS.q * Exp<double>(step);
    const Eigen::VectorXd d = difference(state, at(moved, TrackClock::kPoses, t)) / h;
    const Eigen::MatrixXd part = at(known, TrackClock::kPoses, t).covariance - state.covariance;
    EXPECT_LT((part - d * d.transpose()).norm(), 1e-3 * part.norm()) << i;
  }

  sensor.sessions[0].time_shift_std = 0.3;
  sensor.sessions[0].clock_drift_std = 0.1;
  const double since = t - 0.5 * Truth().duration_s;  // the clock's reference is in the middle
  const Eigen::VectorXd rate =
      difference(at(sensor, TrackClock::kPoses, t - h), at(sensor, TrackClock::kPoses, t + h)) /
      (2.0 * h);
  const Eigen::MatrixXd part = at(sensor, TrackClock::kImu, t).covariance - state.covariance;
  const double variance = 0.3 * 0.3 + std::pow(0.1 * since, 2);
  EXPECT_LT((part - variance * rate * rate.transpose()).norm(), 0.02 * part.norm());
}

TEST_F(SensorTrackTest, ErrorsAreThoseAgainstTheTruth) {
  SimulatorOptions truth = Truth();
  SimulatedPoseSensor& own = truth.pose_sensors[0];
  own.drift = 0.02;
  own.position_std = own.rotation_std = 4e-3;
  const Calibration result = Solve(truth, false);
  const PoseSensorCalibration& sensor = result.pose_sensors[0];
  const TrueTrajectory trajectory(truth);
  const SensorErrors found = FindErrors(result.solution, 0, sensor);
  const SensorErrors expected =
      FindErrors(sensor.sessions[0], [&](double t) -> std::optional<Rigid3> {
        return True(truth, trajectory, t - 1e-9 * static_cast<double>(truth.start_ns));
      });
  EXPECT_GT(found.absolute.position, 0.02);  // it drifts
  EXPECT_LT(found.relative.position, 0.5 * found.absolute.position);
  EXPECT_NEAR(found.absolute.position, expected.absolute.position, 1e-3);
  EXPECT_NEAR(found.absolute.rotation, expected.absolute.rotation, 1e-3);
  EXPECT_NEAR(found.relative.position, expected.relative.position, 3e-4);
  EXPECT_NEAR(found.relative.rotation, expected.relative.rotation, 3e-4);
}

}  // namespace
}  // namespace imu_pose_calib
