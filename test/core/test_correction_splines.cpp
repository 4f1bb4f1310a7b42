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
  const PoseTrajectory to = *SmoothTrajectory(from, before, 1);
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
      EXPECT_LT(error_at(between).first, 1e-4) << between;
    }
  }
  EXPECT_GT(moved, 3e-4);
  // At the ends as between: a natural spline would have none of their acceleration.
  EXPECT_LT(error_at(run.begin).second, 1e-6);
  EXPECT_LT(error_at(run.end).second, 1e-6);
}

}  // namespace
}  // namespace imu_pose_calib
