// Ground truth: states of an IMU, their covariances, and what is done about gaps.

#include <Eigen/Cholesky>
#include <algorithm>
#include <functional>

#include "dense_inverse.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/ground_truth/imu_track.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

SimulatorOptions Truth(uint32_t seed, double duration_s, double pose_std) {
  SimulatorOptions truth;
  truth.seed = seed;
  truth.duration_s = duration_s;
  truth.position_std = pose_std;
  truth.rotation_std = pose_std == 1e-4 ? 2e-4 : pose_std;
  return truth;
}

/// Instant of the truth [s] at an IMU stamp.
double TrueTime(const SimulatorOptions& truth, int64_t stamp_ns) {
  return 1e-9 * static_cast<double>(stamp_ns - truth.start_ns) + truth.time_shift_s;
}

/// Takes the poses out of which `is_missing` holds at their time [s].
void Withhold(const SimulatorOptions& truth, const std::function<bool(double)>& is_missing,
              SessionData* data) {
  const auto is_out = [&](const PoseSample& pose) {
    return is_missing(1e-9 * static_cast<double>(pose.t_ns - truth.start_ns));
  };
  data->poses.erase(std::remove_if(data->poses.begin(), data->poses.end(), is_out),
                    data->poses.end());
}

/// Errors of rotation, position and velocity of the IMU over the states that `is_wanted`.
struct Errors {
  double count = 0.0, nees = 0.0, lag = 0.0, speed2 = 0.0, largest = 0.0;
  Eigen::Vector3d error2 = Eigen::Vector3d::Zero(), variance = Eigen::Vector3d::Zero();

  Errors(const ImuTrack& track, const SimulatorOptions& truth,
         const std::function<bool(const ImuState&)>& is_wanted) {
    const TrueTrajectory trajectory(truth);
    const Rigid3& T_MI = truth.T_MI;
    for (const ImuTrack::Instant& instant : track.Instants(0.0)) {
      const auto x = track.At(instant.t);
      if (!x || !is_wanted(*x)) continue;
      const TrueState s = trajectory.At(TrueTime(truth, instant.stamp_ns));
      const Eigen::Quaterniond q_WI = Eigen::Quaterniond(s.R_WM) * T_MI.q;
      const Eigen::Vector3d v_WI = s.v_W + s.R_WM * s.omega_M.cross(T_MI.p);
      Eigen::Matrix<double, 9, 1> e;
      e << Log(Eigen::Quaterniond(q_WI.conjugate() * x->q_WB)), x->p_WB - s.p_WM - s.R_WM * T_MI.p,
          x->v_W - v_WI;
      Eigen::Matrix<double, 9, 9> C;
      const int place[] = {0, 3, 9};
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
          C.block<3, 3>(3 * i, 3 * j) = x->covariance.block<3, 3>(place[i], place[j]);
      count += 1.0;
      nees += e.dot(C.llt().solve(e)) / 9.0;
      lag -= e.segment<3>(3).dot(v_WI);
      speed2 += v_WI.squaredNorm();
      largest = std::max(largest, e.cwiseQuotient(C.diagonal().cwiseSqrt()).cwiseAbs().maxCoeff());
      for (int k = 0; k < 3; ++k) {
        error2[k] += e.segment<3>(3 * k).squaredNorm() / 3.0;
        variance[k] += C.diagonal().segment<3>(3 * k).mean();
      }
    }
  }
  double PositionRms() const { return std::sqrt(error2[1] / count); }
};

TEST(ImuTrackTest, IsBetterThanThePosesAndKnowsHowMuch) {
  const struct {
    double pose_std, ratio, duration_s, least_nees;
  } cases[] = {{1e-4, 0.6, 60.0, 0.5},  // what splines leave passes for slow errors of such poses
               {1e-3, 0.25, 30.0, 0.7},
               {5e-3, 0.2, 30.0, 0.7}};
  for (const auto& c : cases) {
    const SimulatorOptions truth = Truth(410, c.duration_s, c.pose_std);
    const Calibration result = Calibrate({}, Simulate(truth));
    const ImuTrack track(result.solution, 0, 0, TrackClock::kImu, 2.0);
    const Errors errors(track, truth, [](const ImuState&) { return true; });
    EXPECT_GT(errors.count, 0.98 * truth.gyro_rate_hz * c.duration_s);
    EXPECT_LT(errors.PositionRms(), c.ratio * c.pose_std);
    EXPECT_LT(std::abs(errors.lag / errors.speed2), 1.5e-4) << c.pose_std;
    for (int k = 0; k < 3; ++k)
      EXPECT_LT(errors.error2[k], 1.3 * 1.3 * errors.variance[k]) << c.pose_std << " " << k;
    EXPECT_GT(errors.nees / errors.count, c.least_nees)
        << c.pose_std;  // the truth meets the priors
    EXPECT_LT(errors.nees / errors.count, 1.25) << c.pose_std;
  }
}

TEST(ImuTrackTest, IsTheMotionAndNotItsMeanByTheGyroscopesFilter) {
  SimulatorOptions truth = Truth(4, 30.0, 1e-4);
  truth.effects.gyro_filter_hz = 12.0;  // the mean is 0.9 mrad off
  const Calibration result = Calibrate({}, Simulate(truth));
  EXPECT_NEAR(result.imus[0].gyro_smoothing, std::pow(2.0 * M_PI * 12.0, -2), 2e-5);
  const ImuTrack track(result.solution, 0, 0, TrackClock::kImu, 2.0);
  const TrueTrajectory trajectory(truth);
  // The filter is late, which is part of the time shift: the clock of the poses is not.
  const int64_t epoch_ns = result.solution->pose_epochs_ns[0] - truth.start_ns;
  double error2 = 0.0, count = 0.0;
  for (const ImuTrack::Instant& instant : track.Instants(0.0)) {
    const auto x = track.At(instant.t);
    if (!x) continue;
    const TrueState s = trajectory.At(1e-9 * static_cast<double>(epoch_ns) + instant.t);
    const Eigen::Quaterniond q_WI = Eigen::Quaterniond(s.R_WM) * truth.T_MI.q;
    error2 += Log(Eigen::Quaterniond(q_WI.conjugate() * x->q_WB)).squaredNorm();
    count += 1.0;
  }
  EXPECT_LT(std::sqrt(error2 / count), 3e-4);
}

TEST(ImuTrackTest, CarriesAcrossGapsWithinItsSigmas) {
  const SimulatorOptions truth = Truth(420, 40.0, 1e-3);
  SessionData data = Simulate(truth);
  Withhold(
      truth, [](double t) { return std::fmod(t, 10.0) > 9.0; }, &data);
  const Calibration result = Calibrate({}, data);
  const ImuTrack track(result.solution, 0, 0, TrackClock::kImu, 2.0);
  ASSERT_EQ(track.gaps().size(), 3u);
  const Errors carried(track, truth, [](const ImuState& x) { return x.is_carried; });
  EXPECT_GT(carried.count, 590.0);
  EXPECT_LT(carried.nees / carried.count, 1.5);
  EXPECT_LT(carried.largest, 4.0);
  EXPECT_LT(carried.PositionRms(), 6e-4);
  const Errors followed(track, truth, [](const ImuState& x) { return !x.is_carried; });
  EXPECT_NEAR(followed.nees / followed.count, 0.95, 0.3);

  // Without a step where one passes into the other.
  for (const TrackGap& gap : track.gaps()) {
    for (const double t : {gap.begin, gap.end}) {
      const ImuState inside = *track.At(t + (t == gap.begin ? 1e-6 : -1e-6));
      const ImuState outside = *track.At(t + (t == gap.begin ? -1e-6 : 1e-6));
      ASSERT_TRUE(inside.is_carried && !outside.is_carried);
      const Eigen::Vector3d step = inside.p_WB - outside.p_WB;
      EXPECT_LT(step.norm(), 3.0 * std::sqrt(outside.covariance.block<3, 3>(3, 3).trace()));
      // What the other end says, too, makes it no less certain.
      EXPECT_LT(inside.covariance(3, 3), 1.01 * outside.covariance(3, 3));
    }
  }

  const ImuTrack short_ones(result.solution, 0, 0, TrackClock::kImu, 0.5);
  EXPECT_FALSE(short_ones.At(9.5));
  EXPECT_TRUE(short_ones.At(8.5));
  EXPECT_TRUE(track.At(9.5));
}

TEST(ImuTrackTest, LeavesOutWhatTheImuCannotTell) {
  const SimulatorOptions truth = Truth(430, 30.0, 1e-3);
  SessionData data = Simulate(truth);
  Withhold(
      truth, [](double t) { return std::fmod(t, 10.0) > 9.0; }, &data);
  // The world of the poses is elsewhere after the first gap; the IMU is off in the second.
  for (PoseSample& pose : data.poses)
    if (pose.t_ns - truth.start_ns > 9'500'000'000) pose.p_WM.x() += 0.1;
  for (auto* samples : {&data.imus[0].gyro, &data.imus[0].accel}) {
    const auto is_off = [&truth](const ImuSample& s) {
      const double t = TrueTime(truth, s.t_ns);
      return t > 19.4 && t < 19.5;
    };
    samples->erase(std::remove_if(samples->begin(), samples->end(), is_off), samples->end());
  }
  const Calibration result = Calibrate({}, data);
  ASSERT_TRUE(result.solution);
  const ImuTrack track(result.solution, 0, 0, TrackClock::kImu, 2.0);
  ASSERT_EQ(track.gaps().size(), 2u);
  for (const TrackGap& gap : track.gaps()) {
    EXPECT_TRUE(gap.carried.empty());
    EXPECT_FALSE(track.At(0.5 * (gap.begin + gap.end)));
  }
}

TEST(ImuTrackTest, ARunWithoutATrajectoryIsPartOfTheGap) {
  const SimulatorOptions truth = Truth(435, 24.0, 1e-3);
  SessionData data = Simulate(truth);
  Withhold(
      truth, [](double t) { return std::fmod(t, 8.0) > 7.5; }, &data);
  auto solution = std::make_shared<Solution>(*Calibrate({}, data).solution);
  ASSERT_EQ(solution->splines[0].Runs().size(), 3u);
  // The splines of the second run stay.
  Withhold(
      truth, [](double t) { return t > 7.5 && t < 16.0; }, &data);
  ConditionedData conditioned = ConditionData(CalibrationOptions(), data);
  solution->trajectories[0] =
      std::make_shared<const PoseTrajectory>(FitTrajectory(CalibrationOptions(), &conditioned));
  const ImuTrack track(solution, 0, 0, TrackClock::kImu, 2.0);
  ASSERT_EQ(track.gaps().size(), 1u);
  EXPECT_NEAR(track.gaps()[0].begin, 7.5, 0.05);
  EXPECT_NEAR(track.gaps()[0].end, 16.0, 0.05);
  EXPECT_TRUE(track.At(4.0));
  EXPECT_FALSE(track.At(12.0));
  EXPECT_TRUE(track.At(20.0));
}

/// One calibration with known biases on clocks that are far apart and drift.
class ImuTrackOfOneTest : public ::testing::Test {
 protected:
  static void SetUpTestSuite() {
    truth_ = new SimulatorOptions(Truth(440, 20.0, 1e-3));
    truth_->gyro_bias_walk = truth_->accel_bias_walk = 0.0;
    truth_->time_shift_s = -1000.25;
    truth_->clock_drift = 5e-5;
    truth_->accel_delay_s = 0.003;
    result_ = new Calibration(Calibrate({}, Simulate(*truth_)));
  }
  static void TearDownTestSuite() {
    delete result_;
    delete truth_;
  }
  static SimulatorOptions* truth_;
  static Calibration* result_;
};
SimulatorOptions* ImuTrackOfOneTest::truth_ = nullptr;
Calibration* ImuTrackOfOneTest::result_ = nullptr;

TEST_F(ImuTrackOfOneTest, BiasesAreWithinTheirSigmas) {
  const ImuTrack track(result_->solution, 0, 0, TrackClock::kPoses, 2.0);
  for (double t = 1.0; t < 19.0; t += 1.0) {
    const ImuState x = *track.At(t);
    Vector6d e;
    e << x.biases.gyro - truth_->gyro_bias, x.biases.accel - truth_->accel_bias;
    EXPECT_LT(e.cwiseQuotient(x.bias_covariance.diagonal().cwiseSqrt()).norm(), 5.0) << t;
    EXPECT_LT(x.bias_covariance(0, 0), 1e-6);
    EXPECT_GT(x.bias_covariance(0, 0), 1e-10);
  }
}

TEST_F(ImuTrackOfOneTest, StampsAreThoseOfEitherClock) {
  const SessionData data = Simulate(*truth_);
  const ImuTrack on_imu(result_->solution, 0, 0, TrackClock::kImu, 2.0);
  const ImuTrack on_poses(result_->solution, 0, 0, TrackClock::kPoses, 2.0);
  const auto imu = on_imu.Instants(0.0), poses = on_poses.Instants(0.0);
  ASSERT_EQ(imu.size(), data.imus[0].gyro.size());
  ASSERT_EQ(poses.size(), imu.size());
  for (size_t k = 0; k < imu.size(); ++k) {
    EXPECT_EQ(imu[k].stamp_ns, data.imus[0].gyro[k].t_ns);
    EXPECT_EQ(imu[k].t, poses[k].t);
    // By the equation of the result.
    const ImuSession& clock = result_->sessions[0].imus[0];
    const double t_imu = 1e-9 * static_cast<double>(imu[k].stamp_ns);
    const double shift = clock.time_shift + clock.clock_drift * (t_imu - clock.clock_reference);
    EXPECT_NEAR(1e-9 * static_cast<double>(poses[k].stamp_ns - imu[k].stamp_ns), shift, 1e-6);
  }
  const auto even = on_imu.Instants(300.0);
  EXPECT_EQ(even[0].stamp_ns, imu[0].stamp_ns);
  EXPECT_EQ(even[1].stamp_ns, imu[0].stamp_ns + 3'333'333);
  EXPECT_EQ(even[3].stamp_ns, imu[0].stamp_ns + 10'000'000);
  EXPECT_LE(even.back().stamp_ns, imu.back().stamp_ns);
  EXPECT_GT(even.back().stamp_ns, imu.back().stamp_ns - 3'333'334);
  EXPECT_NEAR(even[3].t - even[0].t, 0.01, 1e-6);

  // Errors of the clock move what its stamps stand for.
  const double t = 7.0;
  const ImuState a = *on_imu.At(t), b = *on_poses.At(t);
  EXPECT_EQ(a.p_WB, b.p_WB);
  EXPECT_NE(a.covariance(3, 3), b.covariance(3, 3));
}

TEST_F(ImuTrackOfOneTest, SamplesAreOfOneInstant) {
  const ImuTrack track(result_->solution, 0, 0, TrackClock::kImu, 2.0);
  const auto samples = track.Samples();
  ASSERT_GT(samples.size(), 3990u);
  const TrueTrajectory trajectory(*truth_);
  double error2 = 0.0, late2 = 0.0;
  const auto f_at = [&](double t) -> Eigen::Vector3d {
    const TrueState s = trajectory.At(t);
    return truth_->T_MI.q.conjugate() *
           Eigen::Vector3d(s.R_WM.transpose() * (s.a_W - truth_->g_W) +
                           s.alpha_M.cross(truth_->T_MI.p) +
                           s.omega_M.cross(s.omega_M.cross(truth_->T_MI.p)));
  };
  for (const ImuTrack::Sample& s : samples) {
    const double t_imu = 1e-9 * static_cast<double>(s.stamp_ns - truth_->start_ns);
    const double t = t_imu + truth_->time_shift_s;
    const double middle = 0.5 * truth_->duration_s;
    const double t_M = t + truth_->clock_drift * (t - middle);
    error2 += (s.accel - truth_->accel_bias - f_at(t_M)).squaredNorm();
    late2 += (s.accel - truth_->accel_bias - f_at(t_M - truth_->accel_delay_s)).squaredNorm();
  }
  const auto count = 3.0 * static_cast<double>(samples.size());
  EXPECT_LT(std::sqrt(error2 / count), 1.05 * truth_->accel_std);
  EXPECT_GT(late2, 1.05 * error2);
}

TEST(ImuTrackTest, EndsOfRunsHaveTheCovarianceOfAllThatActsThere) {
  const Calibration result = Calibrate({}, Simulate(Truth(460, 7.0, 1e-3)));
  const Eigen::MatrixXd inverse = DenseInverse(result.solution->marginals);
  const TrajectoryCovariance covariance(result.solution);
  const CorrectionSplines::Run run = result.solution->splines[0].Runs().front();
  const ImuSessionEstimate& imu = result.solution->estimate.sessions[0].imus[0];
  for (const bool is_end : {false, true}) {
    const double t = is_end ? run.end : run.begin;
    TrajectoryCovariance::Columns columns =
        covariance.ControlPoints(0, is_end ? run.first + run.spans - 1 : run.first);
    const auto add = [&columns](const TrajectoryCovariance::Columns& more) {
      columns.insert(columns.end(), more.begin(), more.end());
    };
    add(covariance.Calibrated(ParameterKind::kTranslation, 0, 3));
    add(covariance.Calibrated(ParameterKind::kGyroIntrinsics, 0, 6));
    add(covariance.Calibrated(ParameterKind::kPoseScale, 0, 1));
    const auto clock = covariance.Clock(0, 0, t);
    EXPECT_EQ(clock[2], -1);  // of a line
    add({clock[0], clock[1]});
    add(covariance.Gravity(0));
    add(covariance.BiasKnotPair(0, 0, false, imu.gyro_bias.Locate(imu.ImuTime(t)).first));
    add(covariance.BiasKnotPair(0, 0, true, imu.accel_bias.Locate(imu.ImuTime(t)).first));
    const Eigen::MatrixXd C = covariance.At(columns);
    for (Eigen::Index i = 0; i < C.rows(); ++i)
      for (Eigen::Index j = 0; j < C.cols(); ++j) {
        const int row = columns[static_cast<size_t>(i)], column = columns[static_cast<size_t>(j)];
        ASSERT_TRUE(row >= 0 && column >= 0);
        EXPECT_NEAR(C(i, j), inverse(row, column),
                    1e-5 * std::sqrt(inverse(row, row) * inverse(column, column)))
            << i << " " << j;
      }
  }
}

TEST(ImuTrackTest, OfAGivenTrajectoryHasNoCovariance) {
  const SimulatorOptions truth = Truth(450, 15.0, 1e-3);
  CalibrationOptions options;
  options.method = Method::kGp;
  const Calibration result = Calibrate(options, Simulate(truth));
  const ImuTrack track(result.solution, 0, 0, TrackClock::kImu, 2.0);
  EXPECT_FALSE(track.has_covariance());
  const ImuState x = *track.At(7.0);
  EXPECT_TRUE(x.covariance.isZero(0.0));
  EXPECT_LT((x.p_WB - TrueTrajectory(truth).At(7.0).p_WM).norm(), 0.2);
}

}  // namespace
}  // namespace imu_pose_calib
