#include <Eigen/Cholesky>

#include "dense_inverse.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/ground_truth/trajectory.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

SimulatorOptions Truth(uint32_t seed, double duration_s) {
  SimulatorOptions truth;
  truth.seed = seed;
  truth.duration_s = duration_s;
  truth.accel_delay_s = 2e-3;
  return truth;
}

/// A recording of its own: another motion, world and clock of the same rig.
SimulatorOptions Session(uint32_t k, double duration_s) {
  SimulatorOptions truth = Truth(300 + k, duration_s);
  truth.time_shift_s = 0.02 - 50.0 * k;
  truth.start_ns += k * 1'000'000'000'000;
  truth.g_W = Exp(Eigen::Vector3d(0.4 * k, 0.2, 0.0)) * truth.g_W;
  return truth;
}

/// Errors over sigma of a transform: translation, rotation.
Vector6d Normalised(const Rigid3& T, const Vector6d& std_dev, const Rigid3& truth) {
  Vector6d e;
  e << T.p - truth.p, Log(Eigen::Quaterniond(truth.q.conjugate() * T.q));
  return e.cwiseQuotient(std_dev);
}

TEST(Rig, SessionsWithoutACommonClockOrWorldAgree) {
  std::vector<SessionData> data;
  for (uint32_t k = 0; k < 3; ++k) data.push_back(Simulate(Session(k, 12.0 + 3.0 * k)));
  const Calibration result = Calibrate({}, data);
  ASSERT_EQ(result.status, Status::kOk) << result.message;
  const Rigid3& truth = Session(0, 12.0).T_MI;
  const auto largest = [&](const Rigid3& T, const Vector6d& std_dev) {
    return Normalised(T, std_dev, truth).cwiseAbs().maxCoeff();
  };
  EXPECT_LT(largest(result.imus[0].T_MI, result.imus[0].Std()), 4.0);
  ASSERT_EQ(result.sessions.size(), 3u);
  Vector6d information = Vector6d::Zero();
  for (uint32_t k = 0; k < 3; ++k) {
    const SessionCalibration& session = result.sessions[k];
    const SimulatorOptions own = Session(k, 12.0);
    const ImuSession& imu = session.imus[0];
    EXPECT_LT(std::abs(imu.time_shift - own.time_shift_s), 4 * imu.time_shift_std);
    EXPECT_GT(imu.time_shift_std, 0.0);
    // Known in norm, so two of its directions have a sigma.
    EXPECT_LT((session.g_W - own.g_W).norm(), 4 * session.g_W_std.norm());
    EXPECT_LT(session.g_W_std.norm(), 0.05);
    EXPECT_GT(imu.gyro_bias_std.minCoeff(), 0.0);
    EXPECT_LT((imu.gyro_bias - own.gyro_bias).norm(), 4 * imu.gyro_bias_std.norm() + 1e-4);
    EXPECT_LT((imu.accel_bias - own.accel_bias).norm(), 4 * imu.accel_bias_std.norm() + 1e-3);
    EXPECT_LT(session.agreement.sigmas, 5.0);
    EXPECT_EQ(session.agreement.dof, 7);
    EXPECT_LT(largest(session.own.T_MI, session.own.std), 4.0);
    information += session.own.std.cwiseAbs2().cwiseInverse();
  }
  // Together they know about as much as the sum of what they know alone.
  const Vector6d ratio =
      result.imus[0].model_covariance.diagonal().cwiseProduct(information).cwiseSqrt();
  EXPECT_LT(ratio.maxCoeff(), 1.1);
}

TEST(Rig, NamesTheSessionWhoseMarkerWasMoved) {
  std::vector<SessionData> data;
  for (uint32_t k = 0; k < 3; ++k) {
    SimulatorOptions truth = Session(k, 15.0);
    if (k == 1) truth.T_MI.p.z() += 2e-3;
    data.push_back(Simulate(truth));
  }
  const Calibration result = Calibrate({}, data);
  EXPECT_EQ(result.status, Status::kWeak);
  EXPECT_TRUE(Contains(result.message, "session 2 stands out: translation z by "));
  EXPECT_NEAR(result.sessions[1].agreement.difference, 2e-3, 5e-4);
  // The sigma covers what nobody knows: which of them is right.
  EXPECT_GT(result.imus[0].Std().z(), 3e-4);
  EXPECT_GT(result.imus[0].Std().z(), 3.0 * std::sqrt(result.imus[0].model_covariance(2, 2)));

  data.pop_back();
  EXPECT_TRUE(Contains(Calibrate({}, data).message, "sessions 1 and 2 disagree: translation z by"));
}

/// The sigmas that make the result degenerate are what the sessions scatter by, not the motion's.
TEST(Rig, NamesSessionsBetweenWhichTheMarkerWasTurned) {
  std::vector<SessionData> data;
  for (uint32_t k = 0; k < 2; ++k) {
    SimulatorOptions truth = Session(k, 15.0);
    if (k == 1) truth.T_MI.q *= Exp<double>(Eigen::Vector3d(0.0, 0.6, 0.0));
    data.push_back(Simulate(truth));
  }
  const Calibration result = Calibrate({}, data);
  EXPECT_EQ(result.status, Status::kDegenerate);
  EXPECT_TRUE(Contains(result.message, "sessions 1 and 2 disagree: rotation ")) << result.message;
}

TEST(Rig, TwoImusWithClocksOfTheirOwn) {
  const SimulatorOptions first = Truth(310, 30.0), second = FurtherImu(first, 1);
  const SessionData both = Simulate(first, 2);
  const Calibration rig = Calibrate({}, both);
  ASSERT_EQ(rig.status, Status::kOk) << rig.message;
  ASSERT_EQ(rig.imus.size(), 2u);
  const SimulatorOptions* truths[] = {&first, &second};
  for (size_t i = 0; i < 2; ++i) {
    const SimulatorOptions& truth = *truths[i];
    const ImuCalibration& imu = rig.imus[i];
    EXPECT_LT(Normalised(imu.T_MI, imu.Std(), truth.T_MI).cwiseAbs().maxCoeff(), 4);
    EXPECT_LT(std::abs(imu.accel_delay - truth.accel_delay_s), 4 * imu.accel_delay_std);
    const ImuSession& clock = rig.sessions[0].imus[i];
    EXPECT_LT(std::abs(clock.time_shift - truth.time_shift_s), 4 * clock.time_shift_std);
  }
  ASSERT_EQ(rig.between_imus.size(), 1u);
  const BetweenImus& between = rig.between_imus[0];
  const Rigid3 true_between = first.T_MI.Inverse() * second.T_MI;
  EXPECT_LT(Normalised(between.T, between.Std(), true_between).cwiseAbs().maxCoeff(), 4);
  // The errors of the trajectory are common to both: tighter than from separate runs.
  SessionData alone = both;
  alone.imus.pop_back();
  const Matrix6d of_first = Calibrate({}, alone).imus[0].covariance;
  alone.imus = {both.imus[1]};
  const Matrix6d of_second = Calibrate({}, alone).imus[0].covariance;
  const auto translation = [](const Matrix6d& C) { return C.diagonal().head<3>().sum(); };
  EXPECT_LT(translation(between.covariance),
            0.8 * (translation(of_first) + translation(of_second)));
}

TEST(Rig, ASessionMayLackAnImu) {
  const SimulatorOptions truths[] = {Session(0, 15.0), Session(1, 15.0)};
  const SessionData with_both = Simulate(truths[0], 2);
  SessionData without_first = Simulate(truths[1], 2);
  without_first.imus[0] = ImuData();
  const Calibration result = Calibrate({}, {with_both, without_first});
  ASSERT_TRUE(result.IsUsable()) << result.message;
  EXPECT_FALSE(result.sessions[1].imus[0].is_present);
  EXPECT_TRUE(result.sessions[1].imus[1].is_present);
  EXPECT_EQ(result.sessions[1].own.imu, 1u);
  const Rigid3 truth[] = {truths[0].T_MI, FurtherImu(truths[0], 1).T_MI};
  for (size_t i = 0; i < 2; ++i)
    EXPECT_LT(Normalised(result.imus[i].T_MI, result.imus[i].Std(), truth[i]).cwiseAbs().maxCoeff(),
              4);
}

TEST(Rig, RefusesWhatIsNoRig) {
  const SessionData one = Simulate(Truth(320, 8.0));
  SessionData two = one;
  two.imus.push_back(one.imus[0]);
  const auto text = [](const CalibrationOptions& options, const std::vector<SessionData>& data) {
    return ErrorText<InputError>([&] { Calibrate(options, data); });
  };
  EXPECT_TRUE(Contains(text({}, {}), "no session"));
  EXPECT_TRUE(Contains(text({}, {one, two}), "numbers of imus differ"));
  CalibrationOptions fixed;
  fixed.estimate_translation = false;
  fixed.initial_translation = Eigen::Vector3d::Zero();
  EXPECT_TRUE(Contains(text(fixed, {two}), "estimate_translation = false needs a single imu"));
  EXPECT_TRUE(Contains(text({}, {two}), "imu1 has the samples of imu0"));
  SessionData later = one;  // shares its first second with the last of the other
  for (PoseSample& pose : later.poses) pose.p_WM.x() += pose.t_ns > one.poses[200].t_ns ? 1.0 : 0.0;
  EXPECT_TRUE(Contains(text({}, {one, later}), "session 2: poses of session 1 once more"));
  two.imus[1] = ImuData();
  EXPECT_TRUE(Contains(ErrorText<DataError>([&] { Calibrate({}, two); }), "no samples of imu1"));
  SimulatorOptions motionless = Truth(320, 8.0);
  motionless.motion = Motion::kHinge;
  const Calibration hinge = Calibrate({}, {one, Simulate(motionless)});
  EXPECT_EQ(hinge.status, Status::kDegenerate);
  EXPECT_TRUE(Contains(hinge.message, "session 2: the marker turns about one axis only"));
}

TEST(Rig, RefusesWhatASolveCannotDo) {
  const auto text = [](const CalibrationOptions& options, const SessionData& data) {
    return ErrorText<std::runtime_error>([&] { Calibrate(options, data); });
  };
  SessionData slow = Simulate(Truth(321, 8.0), 2);
  for (std::vector<ImuSample>* samples : {&slow.imus[1].gyro, &slow.imus[1].accel}) {
    std::vector<ImuSample> kept;
    for (size_t i = 0; i < samples->size(); i += 5) kept.push_back((*samples)[i]);
    *samples = kept;
  }
  CalibrationOptions dense;
  dense.knot_spacing_s = 0.01;  // 40 Hz beside 200
  EXPECT_TRUE(Contains(text(dense, slow), "within two knots")) << text(dense, slow);
  EXPECT_TRUE(Contains(text(dense, slow), "of imu1")) << text(dense, slow);
  CalibrationOptions blocks;
  blocks.covariance_block_s = 0.1;
  EXPECT_TRUE(Contains(text(blocks, Simulate(Truth(322, 103.0))), "more than 1000 blocks"));
}

/// What a solve keeps.
class SolutionTest : public ::testing::Test {
 protected:
  static void SetUpTestSuite() {
    truth_ = new SimulatorOptions(Truth(330, 20.0));
    result_ = new Calibration(Calibrate({}, Simulate(*truth_)));
  }
  static void TearDownTestSuite() {
    delete result_;
    delete truth_;
  }
  static SimulatorOptions* truth_;
  static Calibration* result_;
};
SimulatorOptions* SolutionTest::truth_ = nullptr;
Calibration* SolutionTest::result_ = nullptr;

TEST_F(SolutionTest, TrajectoriesAreWithinTheirSigmas) {
  const SessionTrajectory trajectory(result_->solution, 0);
  const TrueTrajectory truth(*truth_);
  EXPECT_EQ(trajectory.epoch_ns(), truth_->start_ns);
  EXPECT_FALSE(trajectory.Marker(-1.0));
  EXPECT_FALSE(trajectory.MarkerCovariance(25.0));
  double nees_marker = 0.0, nees_imu = 0.0, count = 0.0;
  for (double t = 1.0; t < 19.0; t += 0.1) {
    const TrueState s = truth.At(t);
    const auto add = [&](const BodyState& x, const BodyCovariance& C, const Rigid3& T_MB,
                         double* nees) {
      const Eigen::Matrix3d R_WB = s.R_WM * T_MB.q.toRotationMatrix();
      Eigen::Matrix<double, 12, 1> e;
      e << Log(Eigen::Quaterniond(Eigen::Quaterniond(R_WB).conjugate() * x.q_WB)),
          x.p_WB - s.p_WM - s.R_WM * T_MB.p, x.omega_B - T_MB.q.conjugate() * s.omega_M,
          x.v_W - s.v_W - s.R_WM * s.omega_M.cross(T_MB.p);
      *nees += e.dot(C.topLeftCorner<12, 12>().llt().solve(e)) / 12.0;
    };
    add(*trajectory.Marker(t), *trajectory.MarkerCovariance(t), {}, &nees_marker);
    add(*trajectory.Imu(0, t), *trajectory.ImuCovariance(0, t), truth_->T_MI, &nees_imu);
    count += 1.0;
  }
  for (const double nees : {nees_marker, nees_imu}) {
    EXPECT_GT(nees / count, 0.65);  // the truth meets the priors
    EXPECT_LT(nees / count, 1.25);
  }
}

TEST_F(SolutionTest, StatesAreDerivativesOfEachOther) {
  const SessionTrajectory trajectory(result_->solution, 0);
  const double t = 7.3, step = 1e-4;
  for (const bool is_imu : {false, true}) {
    const auto at = [&](double s) {
      return is_imu ? *trajectory.Imu(0, s) : *trajectory.Marker(s);
    };
    const BodyState x = at(t);
    const auto p = [&](double s) { return at(s).p_WB; };
    const auto v = [&](double s) { return at(s).v_W; };
    const auto w = [&](double s) { return at(s).omega_B; };
    const auto turn = [&](double s) {
      return Log(Eigen::Quaterniond(x.q_WB.conjugate() * at(s).q_WB));
    };
    EXPECT_LT((NumericRate(p, t, step) - x.v_W).norm(), 1e-6);
    EXPECT_LT((NumericRate(v, t, step) - x.a_W).norm(), 1e-5);
    EXPECT_LT((NumericRate(turn, t, step) - x.omega_B).norm(), 1e-6);
    EXPECT_LT((NumericRate(w, t, step) - x.alpha_B).norm(), 1e-4);
  }
}

TEST_F(SolutionTest, CovarianceIsABlockOfTheInverse) {
  SimulatorOptions brief = Truth(331, 6.0);
  const Calibration result = Calibrate({}, Simulate(brief));
  const Solution& solution = *result.solution;
  const Marginals& m = solution.marginals;
  const Eigen::MatrixXd C = DenseInverse(m);

  const double t = 2.345;
  const SplinePlace place = *solution.splines[0].Locate(t);
  const SplineWeights weights = CubicWeights(place.u, place.spacing);
  const auto first = m.trajectory_begin + 3 * static_cast<int>(place.first);
  const Eigen::MatrixXd points = C.block(first, first, 3 * kSplineOrder, 3 * kSplineOrder);
  Eigen::MatrixXd B(9, points.rows());  // position, velocity, acceleration
  for (int j = 0; j < kSplineOrder; ++j)
    for (int k = 0; k < 3; ++k)
      B.block<3, 3>(3 * k, 3 * j) = weights(k, j) * Eigen::Matrix3d::Identity();
  const Eigen::MatrixXd expected = B * points * B.transpose();
  const BodyCovariance found = *SessionTrajectory(result.solution, 0).MarkerCovariance(t);
  const int place_of[] = {3, 9, 15};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      EXPECT_LT(
          (found.block<3, 3>(place_of[i], place_of[j]) - expected.block<3, 3>(3 * i, 3 * j)).norm(),
          1e-6 * std::sqrt(expected.block<3, 3>(3 * i, 3 * i).norm() *
                           expected.block<3, 3>(3 * j, 3 * j).norm()));
}

TEST_F(SolutionTest, KeepsTheResidualsOfEverySensor) {
  const Solution& solution = *result_->solution;
  ASSERT_EQ(solution.residuals.size(), 4u);
  const double noise[] = {truth_->position_std, truth_->rotation_std, truth_->gyro_std,
                          truth_->accel_std};
  for (size_t k = 0; k < 4; ++k) {
    const SensorResiduals& sensor = solution.residuals[k];
    ASSERT_EQ(sensor.t.size(), sensor.residual.size());
    ASSERT_EQ(sensor.t.size(), sensor.weight.size());
    EXPECT_GT(sensor.t.size(), 1900u);
    double sum2 = 0.0;
    for (size_t i = 0; i < sensor.t.size(); ++i) {
      sum2 += sensor.residual[i].squaredNorm() / 3.0;
      EXPECT_GT(sensor.weight[i], 0.0);
      EXPECT_LE(sensor.weight[i], 4.0);  // one degree of freedom
      if (i > 0) {
        EXPECT_GT(sensor.t[i], sensor.t[i - 1]);
      }
    }
    const double rms = std::sqrt(sum2 / static_cast<double>(sensor.t.size()));
    EXPECT_NEAR(rms / noise[k], 1.0, 0.3);
    EXPECT_NEAR(sensor.noise / noise[k], 1.0, 0.2);
  }
}

}  // namespace
}  // namespace imu_pose_calib
