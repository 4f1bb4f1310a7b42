#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <cmath>
#include <string>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/verdict/verdict.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

SimulatorOptions Truth(uint32_t seed = 61) {
  SimulatorOptions truth;
  truth.seed = seed;
  truth.duration_s = 30.0;
  truth.pose_sensors.resize(1);
  return truth;
}

SessionData WithoutImu(const SimulatorOptions& truth) {
  SessionData data = Simulate(truth);
  data.imus.clear();
  return data;
}

/// Errors of T_MS (p_MS [m], R_MS [rad] in S).
Vector6d Error(const PoseSensorCalibration& found, const SimulatedPoseSensor& truth) {
  Vector6d error;
  error << found.T_MS.p - truth.T_MS.p,
      Log(Eigen::Quaterniond(truth.T_MS.q.conjugate() * found.T_MS.q));
  return error;
}

/// Normalised squared error per degree of freedom of T_MS and time shift.
double Nees(const PoseSensorCalibration& found, const SimulatedPoseSensor& truth) {
  const Vector6d error = Error(found, truth);
  const PoseSensorSession& session = found.sessions[0];
  return (error.dot(found.covariance.ldlt().solve(error)) +
          std::pow((session.time_shift - truth.time_shift_s) / session.time_shift_std, 2)) /
         7.0;
}

/// What there is to find, and that it is found within 4 sigma.
PoseSensorCalibration ExpectFound(const SimulatorOptions& truth, const SessionData& data,
                                  const CalibrationOptions& options = {}) {
  const Calibration result = Calibrate(options, data);
  const PoseSensorCalibration& found = result.pose_sensors.at(0);
  EXPECT_EQ(found.status, Status::kOk) << found.message;
  EXPECT_EQ(result.status, Status::kOk) << result.message;
  const Vector6d error = Error(found, truth.pose_sensors[0]), std = found.Std();
  for (int i = 0; i < 6; ++i) EXPECT_LT(std::abs(error[i]), 4.0 * std[i]) << i;
  const PoseSensorSession& session = found.sessions.at(0);
  EXPECT_LT(std::abs(session.time_shift - truth.pose_sensors[0].time_shift_s),
            4.0 * session.time_shift_std);
  EXPECT_LT(session.time_shift_std, 5e-4);
  return found;
}

TEST(PoseSensor, IsFoundBesideAnImu) {
  const SimulatorOptions truth = Truth();
  const PoseSensorCalibration found = ExpectFound(truth, Simulate(truth));
  const PoseSensorSession& session = found.sessions[0];
  EXPECT_NEAR(session.noise.position, 5e-3, 0.3e-3);
  EXPECT_NEAR(session.noise.rotation, 5e-3, 0.3e-3);
  EXPECT_LT(session.drift.position, 0.5e-3);
  EXPECT_LT(found.Std().head<3>().norm(), 1.2e-3);
  EXPECT_LT(found.Std().tail<3>().norm(), 1.2e-3);
  EXPECT_NEAR(session.scale, 1.0, 4.0 * session.scale_std);
}

TEST(PoseSensor, LeavesTheImuAsItIs) {
  const SimulatorOptions truth = Truth();
  SessionData data = Simulate(truth);
  const Calibration with = Calibrate({}, data);
  data.pose_sensors.clear();
  const Calibration without = Calibrate({}, data);
  EXPECT_EQ(with.imus[0].T_MI.p, without.imus[0].T_MI.p);
  EXPECT_TRUE(without.pose_sensors.empty());
}

TEST(PoseSensor, NeedsNoImu) {
  const SimulatorOptions truth = Truth();
  ExpectFound(truth, WithoutImu(truth));
}

TEST(PoseSensor, SigmasHold) {
  double nees = 0.0;
  constexpr int kSeeds = 12;
  for (uint32_t seed = 0; seed < kSeeds; ++seed) {
    const SimulatorOptions truth = Truth(7100 + seed);
    nees += Nees(Calibrate({}, WithoutImu(truth)).pose_sensors[0], truth.pose_sensors[0]);
  }
  // 3 sigma of a mean over 84 degrees of freedom.
  EXPECT_NEAR(nees / kSeeds, 1.0, 3.0 * std::sqrt(2.0 / (7.0 * kSeeds)));
}

TEST(PoseSensor, BearsOutliers) {
  // With the second one weights do not settle when they are of where poses were before the solve.
  for (const uint32_t seed : {61u, 4020u}) {
    SimulatorOptions truth = Truth(seed);
    truth.pose_sensors[0].outliers = 0.2;
    const PoseSensorSession session = ExpectFound(truth, WithoutImu(truth)).sessions[0];
    EXPECT_NEAR(session.noise.position, 5e-3, 0.5e-3);
  }
}

TEST(PoseSensor, FollowsAWorldThatDrifts) {
  SimulatorOptions truth = Truth();
  SimulatedPoseSensor& own = truth.pose_sensors[0];
  own.drift = 0.01;
  own.position_std = 2e-3;
  own.rotation_std = 1e-3;
  const PoseSensorSession session = ExpectFound(truth, WithoutImu(truth)).sessions[0];
  EXPECT_GT(session.drift.position, 3e-3);
  EXPECT_LT(session.drift.position, 20e-3);
  EXPECT_NEAR(session.noise.position, 2e-3, 0.2e-3);
  EXPECT_NEAR(session.noise.rotation, 1e-3, 0.1e-3);
}

TEST(PoseSensor, ThatIsAllDriftIsWeak) {
  SimulatorOptions truth = Truth();
  SimulatedPoseSensor& own = truth.pose_sensors[0];
  own.drift = 0.02;
  own.position_std = own.rotation_std = 2e-4;
  const PoseSensorCalibration found = Calibrate({}, WithoutImu(truth)).pose_sensors.at(0);
  EXPECT_EQ(found.status, Status::kWeak);
  EXPECT_NE(found.message.find("more than its noise"), std::string::npos) << found.message;
}

TEST(PoseSensor, FindsAScale) {
  SimulatorOptions truth = Truth();
  for (const double scale : {0.02, 0.3, 40.0}) {
    SimulatedPoseSensor& own = truth.pose_sensors[0];
    own.scale = scale;
    own.position_std = scale * 5e-3;
    CalibrationOptions options;
    options.estimate_sensor_scale = true;
    const PoseSensorSession session = ExpectFound(truth, WithoutImu(truth), options).sessions[0];
    EXPECT_NEAR(session.scale, scale, 4.0 * session.scale_std);
    EXPECT_LT(session.scale_std, 0.02 * scale);
  }
}

TEST(PoseSensor, CutsTheWorldWhereItJumps) {
  SimulatorOptions truth = Truth();
  truth.pose_sensors[0].jumps = 3;
  const PoseSensorSession session = ExpectFound(truth, WithoutImu(truth)).sessions[0];
  int pieces = 0;
  for (const PoseSensorSession::WorldKnot& knot : session.world) pieces += knot.begins_piece;
  EXPECT_EQ(pieces, 4);
}

TEST(PoseSensor, HasAClockOfItsOwn) {
  SimulatorOptions truth = Truth();
  truth.pose_sensors[0].time_shift_s = 1034771.5;
  truth.pose_sensors[0].clock_drift = 3e-5;
  const PoseSensorSession session = ExpectFound(truth, WithoutImu(truth)).sessions[0];
  EXPECT_NEAR(session.clock_drift, 3e-5, 4.0 * session.clock_drift_std);
}

/// The message of a sensor that is refused; the IMU keeps its result.
std::string Refusal(const SessionData& data) {
  const Calibration result = Calibrate({}, data);
  EXPECT_EQ(result.pose_sensors.at(0).status, Status::kDegenerate);
  EXPECT_EQ(result.status, Status::kWeak);
  EXPECT_LT(result.imus[0].Std().head<3>().norm(), 5e-3);
  return result.pose_sensors[0].message;
}

TEST(PoseSensor, IsRefusedWithTheReason) {
  SimulatorOptions truth = Truth();
  SessionData data = Simulate(truth);
  SessionData inverted = data;
  for (PoseSample& pose : inverted.pose_sensors[0]) {
    pose.q_WM = pose.q_WM.conjugate();
    pose.p_WM = -(pose.q_WM * pose.p_WM);
  }
  EXPECT_NE(Refusal(inverted).find("invert_sensor_poses: true"), std::string::npos);
  SessionData other = data;
  other.pose_sensors = Simulate(Truth(62)).pose_sensors;
  EXPECT_NE(Refusal(other).find("at no time shift"), std::string::npos);
  truth.pose_sensors[0].scale = 0.3;
  EXPECT_NE(Refusal(Simulate(truth)).find("estimate_sensor_scale: true"), std::string::npos);
}

/// A pose a second, of a body that moves from rest to rest.
SimulatorOptions Sparse(uint32_t seed, double std) {
  SimulatorOptions truth = Truth(seed);
  truth.motion = Motion::kArm;
  truth.duration_s = 40.0;
  SimulatedPoseSensor& own = truth.pose_sensors[0];
  own.rate_hz = 1.0;
  own.position_std = own.rotation_std = std;
  return truth;
}

TEST(PoseSensor, WhoseScaleIsUncertainIsNotToldIt) {
  for (const uint32_t seed : {501u, 505u, 506u}) {  // scales of 1.11, 0.87 and 1.12, sigma 0.2
    const std::string message =
        Calibrate({}, WithoutImu(Sparse(seed, 0.1))).pose_sensors.at(0).message;
    EXPECT_EQ(message.find("times those"), std::string::npos) << message;
  }
  SimulatorOptions other = Sparse(501, 5e-3);
  other.pose_sensors[0].scale = 0.8;
  const std::string message = Calibrate({}, WithoutImu(other)).pose_sensors.at(0).message;
  EXPECT_NE(message.find("estimate_sensor_scale: true"), std::string::npos) << message;
}

TEST(PoseSensor, HasTheTimeShiftOfMostEvidence) {
  // A few poses agree better by chance when the rest have nothing beside them.
  const PoseSensorCalibration found =
      Calibrate({}, WithoutImu(Sparse(503, 0.05))).pose_sensors.at(0);
  ASSERT_NE(found.status, Status::kDegenerate) << found.message;
  EXPECT_NEAR(found.sessions[0].time_shift, 0.03, 0.06);
}

TEST(PoseSensor, OfATurnAboutOneAxisIsRefused) {
  SimulatorOptions truth = Truth();
  truth.motion = Motion::kHinge;
  EXPECT_EQ(Calibrate({}, WithoutImu(truth)).status, Status::kDegenerate);
}

TEST(PoseSensor, MayLackInASession) {
  const SimulatorOptions truth = Truth();
  std::vector<SessionData> sessions = {WithoutImu(truth), WithoutImu(Truth(63)),
                                       WithoutImu(Truth(64))};
  sessions[1].pose_sensors[0].clear();
  const PoseSensorCalibration found = Calibrate({}, sessions).pose_sensors.at(0);
  EXPECT_EQ(found.status, Status::kOk) << found.message;
  EXPECT_FALSE(found.sessions[1].is_present);
  const Vector6d error = Error(found, truth.pose_sensors[0]), std = found.Std();
  for (int i = 0; i < 6; ++i) EXPECT_LT(std::abs(error[i]), 4.0 * std[i]) << i;
  EXPECT_LT(std.norm(), 0.85 * Calibrate({}, sessions[0]).pose_sensors[0].Std().norm());
}

TEST(Between, PropagatesBothCovariances) {
  const Rigid3 T_MF{Exp<double>({0.4, -0.2, 0.9}), {0.1, 0.2, -0.3}},
      T_MS{Exp<double>({-1.1, 0.3, 0.2}), {-0.2, 0.05, 0.4}};
  const Matrix6d C_F = Vector6d(1e-6 * (Vector6d() << 1, 2, 3, 4, 5, 6).finished()).asDiagonal();
  const Matrix6d C_S = Vector6d(1e-6 * (Vector6d() << 6, 5, 4, 3, 2, 1).finished()).asDiagonal();
  const BetweenImus between = Between(T_MF, C_F, T_MS, C_S);
  // By differences.
  const double h = 1e-6;
  Matrix6d expected = Matrix6d::Zero();
  for (int k = 0; k < 12; ++k) {
    Rigid3 moved_F = T_MF, moved_S = T_MS;
    Rigid3& moved = k < 6 ? moved_F : moved_S;
    if (k % 6 < 3)
      moved.p[k % 6] += h;
    else
      moved.q = moved.q * Exp<double>(Eigen::Vector3d(h * Eigen::Vector3d::Unit(k % 6 - 3)));
    const Rigid3 T = moved_F.Inverse() * moved_S;
    Vector6d column;
    column << (T.p - between.T.p) / h, Log(Eigen::Quaterniond(between.T.q.conjugate() * T.q)) / h;
    expected += (k < 6 ? C_F(k, k) : C_S(k - 6, k - 6)) * column * column.transpose();
  }
  EXPECT_LT((between.covariance - expected).norm(), 1e-5 * expected.norm());
}

}  // namespace
}  // namespace imu_pose_calib
