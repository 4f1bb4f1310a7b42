#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <memory>
#include <random>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibration/band.h"
#include "imu_pose_calib/core/calibration/correction_splines.h"
#include "imu_pose_calib/core/start/preparation.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

TEST(CorrectionSplines, KeepTheMotionWhenTheTrajectoryThatTheyCorrectMoves) {
  SimulatorOptions truth;
  truth.motion = Motion::kTumble;
  truth.duration_s = 12.0;
  const CalibrationOptions options;
  DataCheck check;
  const PreparedSession session = Prepare(options, Simulate(truth), &check);
  const Estimate estimate(session, options.bias_knot_interval_s);
  const double spacing = 0.05;
  CorrectionSplines splines(session.data, estimate, 0, spacing);
  std::mt19937 random(3);
  std::normal_distribution<double> normal(0.0, 1e-3);
  for (auto* const points : {&splines.d, &splines.phi})
    for (Eigen::Vector3d& point : *points)
      point = Eigen::Vector3d(normal(random), normal(random), normal(random));
  const CorrectionSplines before = splines;
  const PoseTrajectory& from = *session.trajectory;
  std::vector<TimedPose> poses = session.data.poses;
  for (TimedPose& pose : poses) {
    const Eigen::Vector3d off(std::sin(3.0 * pose.t), std::cos(4.0 * pose.t), 1.0);
    pose.p_WM += 1e-3 * off;
    pose.q_WM = pose.q_WM * Exp<double>(Eigen::Vector3d(1e-3 * off));
  }
  const PoseTrajectory to(poses, session.data.segments, from.position_hyperparameters(),
                          from.rotation_hyperparameters());
  splines.Rebase(from, to, 2);

  const CorrectionSplines::Run run = splines.Runs().front();
  const auto error_at = [&](double t) {
    const MarkerState<double> was = *before.Correct(from, t), is = *splines.Correct(to, t);
    return std::make_pair((was.p_WM - is.p_WM).norm() + was.q_WM.angularDistance(is.q_WM),
                          (was.a_W - is.a_W).norm());
  };
  double moved = 0.0;
  for (size_t k = 0; k <= run.spans; ++k) {
    const double t = std::min(run.end, run.begin + static_cast<double>(k) * run.spacing);
    moved = std::max(moved, (from.PoseAt(t).p - to.PoseAt(t).p).norm());
    EXPECT_LT(error_at(t).first, 1e-10) << t;
    const double between = t + 0.5 * run.spacing;
    if (k < run.spans) {
      EXPECT_LT(error_at(between).first, 3e-5) << between;
    }
  }
  EXPECT_GT(moved, 1e-3);
  // At the ends as between: a natural spline would have none of their acceleration.
  EXPECT_LT(error_at(run.begin).second, 1e-6);
  EXPECT_LT(error_at(run.end).second, 1e-6);
}

TEST(SmoothTrajectory, GoesOnBeyondTheEndsAsTheMotionDoesThere) {
  SimulatorOptions truth;
  truth.duration_s = 12.0;
  const CalibrationOptions options;
  DataCheck check;
  const PreparedSession session = Prepare(options, Simulate(truth), &check);
  const CorrectionSplines none(session.data, Estimate(session, options.bias_knot_interval_s), 0,
                               0.05);
  const auto smooth = SmoothTrajectory(*session.trajectory, none, 1);
  const CorrectionSplines::Run run = none.Runs().front();
  const double beyond = 0.28;  // [s]
  EXPECT_FALSE(session.trajectory->Covers(run.begin, run.end + beyond));
  ASSERT_TRUE(smooth->Covers(run.begin - beyond, run.end + beyond));
  const MarkerState<double> end = *none.Correct(*session.trajectory, run.end);
  const double half2 = 0.5 * beyond * beyond;
  const Eigen::Vector3d moved = end.p_WM + beyond * end.v_W + half2 * end.a_W;
  EXPECT_LT((smooth->PositionAt(run.end + beyond) - moved).norm(), 2e-3);
  const Eigen::Quaterniond turned =
      end.q_WM * Exp(Eigen::Vector3d(beyond * end.omega_M + half2 * end.alpha_M));
  EXPECT_LT(smooth->RotationAt(run.end + beyond).angularDistance(turned), 2e-2);
}

}  // namespace
}  // namespace imu_pose_calib
