#include <cmath>

#include "imu_pose_calib/core/calibration/find_marginals.h"
#include "imu_pose_calib/core/calibration/joint_solver.h"
#include "imu_pose_calib/core/calibration/residuals.h"

namespace imu_pose_calib {
namespace {

/// The trajectory's errors stay about the same for this many length scales.
constexpr double kCorrelation = 0.5;
constexpr double kGpTolerance = 1e-8;

/// Number of consecutive samples that share one error of the trajectory: together they tell no more
/// about it than one, so its variance counts that many times in each sample's weight.
double SharedSamples(const PoseTrajectory& trajectory, double rate_hz) {
  return 1.0 + kCorrelation * trajectory.rotation_hyperparameters().lengthscale_s * rate_hz;
}

void AddGyro(size_t session, size_t imu, LeastSquares* gp) {
  const ConditionedImu& data = gp->sessions[session].data.imus[imu];
  const PoseTrajectory& trajectory = *gp->sessions[session].trajectory;
  ImuSessionEstimate& clock = gp->estimate->sessions[session].imus[imu];
  SensorBlocks* sensor = gp->Find(Quantity::kGyro, session, imu);
  const double noise = sensor->model->noise;
  const double shared = SharedSamples(trajectory, sensor->model->rate_hz);
  for (size_t i = 0; i < data.gyro.size(); ++i) {
    const TimedSample& s = data.gyro[i];
    const double t_M = s.t + clock.time_shift;
    if (!IsOnTrajectory(trajectory, t_M)) continue;
    const double variance = trajectory.Variance(t_M).omega;
    const double sigma = std::sqrt(noise * noise + shared * variance);
    const auto [k, u] = clock.gyro_bias.Locate(s.t);
    const GyroResidual residual{&trajectory, s.t, s.value, u, sigma};
    sensor->samples.push_back(
        {t_M, static_cast<uint32_t>(i), static_cast<float>(sigma), static_cast<float>(variance)});
    sensor->Add(gp->problem.AddResidualsOf(
                    {gp->estimate->imus[imu].q_MI.coeffs().data(), clock.gyro_bias.values[k].data(),
                     clock.gyro_bias.values[k + 1].data(), &clock.time_shift},
                    residual.Create(), gp->options.robust_loss_scale),
                t_M);
  }
  if (sensor->samples.empty()) throw DataError("no gyroscope sample falls on the trajectory");
}

void AddAccel(size_t session, size_t imu, LeastSquares* gp) {
  const ConditionedImu& data = gp->sessions[session].data.imus[imu];
  const PoseTrajectory& trajectory = *gp->sessions[session].trajectory;
  ImuEstimate& rig = gp->estimate->imus[imu];
  ImuSessionEstimate& clock = gp->estimate->sessions[session].imus[imu];
  SensorBlocks* sensor = gp->Find(Quantity::kAccel, session, imu);
  const double noise = sensor->model->noise;
  const double shared = SharedSamples(trajectory, sensor->model->rate_hz);
  const double arm2 = rig.p_MI.squaredNorm();
  for (size_t i = 0; i < data.accel.size(); ++i) {
    const TimedSample& s = data.accel[i];
    const double t_M = s.t + clock.time_shift - rig.accel_delay;
    if (!IsOnTrajectory(trajectory, t_M)) continue;
    MarkerState<double> state;
    trajectory.Evaluate(t_M, &state);
    // Errors of alpha and omega reach the accelerometer through the lever arm, errors of rotation
    // turn the specific force; all three axes share them.
    const MarkerVariance v = trajectory.Variance(t_M);
    const double lever = LeverArmCoefficientVariance(v.alpha, v.omega, state.omega_M.squaredNorm());
    const double variance =
        v.accel + (arm2 * lever + 2.0 * v.rotation * s.value.squaredNorm()) / 3.0;
    const double sigma = std::sqrt(noise * noise + shared * variance);
    gp->spurious_information[imu] += lever / (sigma * sigma);
    const auto [k, u] = clock.accel_bias.Locate(s.t);
    const AccelResidual residual{&trajectory, s.t, s.value, u, sigma};
    sensor->samples.push_back(
        {t_M, static_cast<uint32_t>(i), static_cast<float>(sigma), static_cast<float>(variance)});
    sensor->Add(gp->problem.AddResidualsOf(
                    {rig.q_MI.coeffs().data(), rig.p_MI.data(),
                     gp->estimate->sessions[session].g_W.data(), clock.accel_bias.values[k].data(),
                     clock.accel_bias.values[k + 1].data(), &clock.time_shift, &rig.accel_delay},
                    residual.Create(), gp->options.robust_loss_scale),
                t_M);
  }
  if (sensor->samples.empty()) throw DataError("no accelerometer sample falls on the trajectory");
}

}  // namespace

std::unique_ptr<LeastSquares> BuildGpProblem(const CalibrationOptions& options,
                                             const std::vector<PreparedSession>& sessions,
                                             const std::vector<SensorModel>& models,
                                             GpSensors sensors, Estimate* estimate) {
  auto gp = std::make_unique<LeastSquares>(options, sessions, models, estimate);
  gp->AddGyroParameters();
  if (sensors == GpSensors::kGyroAndAccel) gp->AddAccelParameters();
  for (size_t s = 0; s < sessions.size(); ++s) {
    for (size_t i = 0; i < estimate->imus.size(); ++i) {
      ImuSessionEstimate& clock = estimate->sessions[s].imus[i];
      if (!clock.is_present) continue;
      AddGyro(s, i, gp.get());
      gp->AddBiasWalk(options.gyro_bias_walk, s, i, &clock.gyro_bias);
      if (sensors == GpSensors::kGyro) continue;
      AddAccel(s, i, gp.get());
      gp->AddBiasWalk(options.accel_bias_walk, s, i, &clock.accel_bias);
    }
  }
  return gp;
}

Solution SolveAgainstTrajectory(const CalibrationOptions& options,
                                const std::vector<PreparedSession>& sessions, Estimate* estimate) {
  std::vector<SensorModel> models = InitialModels(options, sessions);
  std::vector<SensorStatistics> statistics;
  std::unique_ptr<LeastSquares> gp;
  int iterations = 0;
  const auto solve = [&](GpSensors sensors, double tolerance) {
    gp = BuildGpProblem(options, sessions, models, sensors, estimate);
    iterations += gp->Solve(tolerance);
    statistics = gp->FindStatistics();
  };
  const auto update_noise = [&] {
    for (size_t k = 0; k < models.size(); ++k) models[k].noise = statistics[k].noise;
  };
  solve(GpSensors::kGyro, kRoughTolerance);
  update_noise();
  solve(GpSensors::kGyroAndAccel, kRoughTolerance);
  update_noise();
  solve(GpSensors::kGyroAndAccel, kGpTolerance);
  Solution solution;
  solution.statistics = std::move(statistics);
  solution.marginals = FindMarginals(gp.get());
  solution.residuals = gp->TakeResiduals();
  gp.reset();
  solution.models = std::move(models);
  solution.iterations = iterations;
  return solution;
}

}  // namespace imu_pose_calib
