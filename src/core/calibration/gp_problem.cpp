#include "imu_pose_calib/core/calibration/gp_problem.h"

#include <cmath>
#include <memory>
#include <string>
#include <utility>

#include "imu_pose_calib/core/calibration/residuals.h"

namespace imu_pose_calib {
namespace {

/// The trajectory's errors stay about the same for this many length scales.
constexpr double kCorrelation = 0.5;
constexpr double kGpTolerance = 1e-10;
constexpr double kRoughTolerance = 1e-3;  // while the noise still changes

void AddSensor(Quantity quantity, size_t session, size_t imu, LeastSquares* gp) {
  const bool is_accel = quantity == Quantity::kAccel;
  const ConditionedImu& data = gp->sessions[session].data.imus[imu];
  const std::vector<TimedSample>& samples = is_accel ? data.accel : data.gyro;
  const PoseTrajectory& trajectory = *gp->sessions[session].trajectory;
  ImuEstimate& rig = gp->estimate->imus[imu];
  double* const q_MI = rig.q_MI.coeffs().data();
  double* const g_W = gp->estimate->sessions[session].g_W.data();
  ImuSessionEstimate& clock = gp->estimate->sessions[session].imus[imu];
  BiasKnots& knots = is_accel ? clock.accel_bias : clock.gyro_bias;
  SensorBlocks* const sensor = gp->Find(quantity, session, imu);
  sensor->first_row = gp->problem.rows();
  const double noise = sensor->model->noise;
  // Consecutive samples that share one error of the trajectory tell together no more about it than
  // one, so its variance counts that many times in each sample's weight.
  const double shared = 1.0 + kCorrelation * trajectory.rotation_hyperparameters().lengthscale_s *
                                  sensor->model->rate_hz;
  const double arm2 = rig.p_MI.squaredNorm();
  for (size_t i = 0; i < samples.size(); ++i) {
    const TimedSample& s = samples[i];
    const double t_M = s.t + clock.time_shift - (is_accel ? rig.accel_delay : 0.0);
    if (!IsOnTrajectory(trajectory, t_M)) continue;
    const MarkerVariance v = trajectory.Variance(t_M);
    double variance = v.omega;
    if (is_accel) {
      // Errors of alpha and omega reach the accelerometer through the lever arm, errors of rotation
      // turn the specific force; all three axes share them. doc/math.md, Eq. (8).
      MarkerState<double> state;
      trajectory.Evaluate(t_M, &state);
      const double lever2 = 2.0 * v.alpha + 4.0 * v.omega * state.omega_M.squaredNorm();
      variance = v.accel + (arm2 * lever2 + 2.0 * v.rotation * s.value.squaredNorm()) / 3.0;
    }
    const double sigma = std::sqrt(noise * noise + shared * variance);
    sensor->samples.push_back(
        {t_M, static_cast<uint32_t>(i), static_cast<float>(sigma), static_cast<float>(variance)});
    const auto [k, u] = knots.Locate(s.t);
    double *const knot_0 = knots.values[k].data(), *const knot_1 = knots.values[k + 1].data();
    std::vector<double*> blocks = {q_MI, knot_0, knot_1, &clock.time_shift};
    if (is_accel)
      blocks = {q_MI, rig.p_MI.data(), g_W, knot_0, knot_1, &clock.time_shift, &rig.accel_delay};
    auto residual = is_accel ? AccelResidual{&trajectory, s.t, s.value, u, sigma}.Create()
                             : GyroResidual{&trajectory, s.t, s.value, u, sigma}.Create();
    gp->Add(gp->problem.AddResidualsOf(blocks, std::move(residual), gp->options.robust_loss_scale),
            session, t_M);
  }
  if (sensor->samples.empty())
    throw DataError(std::string("no ") + (is_accel ? "accelerometer" : "gyroscope") +
                    " sample falls on the trajectory");
  gp->AddBiasWalk(is_accel ? gp->options.accel_bias_walk : gp->options.gyro_bias_walk, session, imu,
                  &knots);
}

/// Of the gyroscopes alone, or of all sensors.
std::unique_ptr<LeastSquares> BuildGpProblem(const CalibrationOptions& options,
                                             const std::vector<PreparedSession>& sessions,
                                             const std::vector<SensorModel>& models,
                                             bool with_accel, Estimate* estimate) {
  auto gp = std::make_unique<LeastSquares>(options, sessions, models, estimate);
  gp->AddCalibration(false);
  if (!with_accel)
    for (ImuEstimate& imu : estimate->imus) gp->problem.SetHeld(&imu.accel_delay, true);
  for (size_t s = 0; s < sessions.size(); ++s) {
    for (size_t i = 0; i < estimate->imus.size(); ++i) {
      if (!estimate->sessions[s].imus[i].is_present) continue;
      AddSensor(Quantity::kGyro, s, i, gp.get());
      if (with_accel) AddSensor(Quantity::kAccel, s, i, gp.get());
    }
    if (!with_accel) gp->problem.SetHeld(estimate->sessions[s].g_W.data(), true);
  }
  return gp;
}

}  // namespace

Solution SolveAgainstTrajectory(const CalibrationOptions& options,
                                const std::vector<PreparedSession>& sessions, Estimate* estimate) {
  Solution solution;
  solution.models = InitialModels(options, sessions);
  std::unique_ptr<LeastSquares> gp;
  const auto solve = [&](bool with_accel, double tolerance) {
    for (size_t k = 0; k < solution.statistics.size(); ++k)
      solution.models[k].noise = solution.statistics[k].noise;
    gp = BuildGpProblem(options, sessions, solution.models, with_accel, estimate);
    const std::optional<int> iterations = gp->SolveWithCeres(tolerance);
    if (!iterations) ThrowNotConverged(options);
    solution.iterations += *iterations;
    solution.statistics = gp->FindStatistics();
  };
  solve(false, kRoughTolerance);
  solve(true, kRoughTolerance);
  solve(true, kGpTolerance);
  solution.marginals = FindMarginals(gp.get());
  solution.residuals = gp->FindResiduals(sessions);
  return solution;
}

}  // namespace imu_pose_calib
