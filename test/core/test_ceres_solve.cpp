#include <gtest/gtest.h>

#include <Eigen/Geometry>
#include <cmath>
#include <memory>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibration/band.h"
#include "imu_pose_calib/core/calibration/joint_problem.h"
#include "imu_pose_calib/core/calibration/knot_spacing.h"
#include "imu_pose_calib/core/calibration/marginals.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/start/preparation.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

/// A joint problem of a simulated recording, at its start.
struct Joint {
  std::vector<PreparedSession> sessions;
  Estimate estimate;
  std::vector<SensorModel> models;
  std::vector<CorrectionSplines> splines;
  std::unique_ptr<LeastSquares> problem;

  Joint(const CalibrationOptions& options, const SessionData& data) {
    DataCheck check;
    const PreparedSession prepared = Prepare(options, data, &check);
    estimate = Estimate(prepared, options.bias_knot_interval_s);
    const double spacing = ChooseKnotSpacing(options, prepared.data);
    sessions = {LimitBand(prepared, Band(spacing), options.Threads())};
    models = InitialModels(options, sessions);
    splines.emplace_back(sessions[0].data, estimate, 0, spacing);
    problem = BuildJointProblem(options, sessions, models, &estimate, &splines);
  }
};

TEST(CeresSolve, ReachesTheMinimumOfTheOwnSolver) {
  SimulatorOptions truth;
  truth.duration_s = 12.0;
  truth.seed = 3;
  truth.effects.scale_misalignment = 0.005;
  truth.effects.imu_stream.wander_s = 2e-3;
  const SessionData data = Simulate(truth, 2);
  const CalibrationOptions options;
  Joint own(options, data), by_ceres(options, data);
  StepSummary step;
  for (int k = 0; k < 20 && (!step.is_whole || step.moved > 1e-5); ++k) step = own.problem->Step();
  ASSERT_LT(step.moved, 1e-5);
  ASSERT_TRUE(by_ceres.problem->SolveWithCeres(1e-13));

  const Marginals marginals = FindMarginals(own.problem.get());
  const std::vector<Parameter> same = CalibrationParameters(&by_ceres.estimate);
  const std::vector<Parameter> all = CalibrationParameters(&own.estimate);
  int compared = 0;
  for (const PlacedParameter& placed : marginals.parameters) {
    if (placed.parameter.data == nullptr) continue;
    size_t k = 0;
    while (all[k].data != placed.parameter.data) ++k;
    const Eigen::Index size = placed.parameter.size;
    Eigen::VectorXd difference = Eigen::Map<const Eigen::VectorXd>(all[k].data, size) -
                                 Eigen::Map<const Eigen::VectorXd>(same[k].data, size);
    if (placed.parameter.kind == ParameterKind::kRotation)
      difference =
          Log(Eigen::Quaterniond(Eigen::Map<const Eigen::Quaterniond>(all[k].data).conjugate() *
                                 Eigen::Map<const Eigen::Quaterniond>(same[k].data)));
    const Eigen::VectorXd sigma =
        marginals.model.diagonal().segment(placed.place, size).cwiseSqrt();
    EXPECT_LT(difference.cwiseQuotient(sigma).cwiseAbs().maxCoeff(), 1e-3)
        << "parameter " << k << ": " << difference.transpose();
    compared += placed.parameter.size;
  }
  EXPECT_GT(compared, 40);
}

TEST(CeresSolve, CanTakeTheStepsOfTheJointSolve) {
  SimulatorOptions truth;
  truth.duration_s = 12.0;
  const SessionData data = Simulate(truth);
  CalibrationOptions options;
  options.knot_spacing_s = 0.06;
  const Calibration own = Calibrate(options, data);
  options.solver = SolverKind::kCeres;
  const Calibration by_ceres = Calibrate(options, data);
  const Eigen::Vector3d move = by_ceres.imus[0].T_MI.p - own.imus[0].T_MI.p;
  EXPECT_GT(move.norm(), 0.0);
  EXPECT_LT(move.cwiseQuotient(own.imus[0].Std().head<3>()).cwiseAbs().maxCoeff(), 0.1);
  EXPECT_NEAR(by_ceres.imus[0].Std().norm(), own.imus[0].Std().norm(),
              0.02 * own.imus[0].Std().norm());
}

}  // namespace
}  // namespace imu_pose_calib
