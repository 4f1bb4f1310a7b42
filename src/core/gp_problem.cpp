#include "imu_pose_calib/core/gp_problem.h"

#include <ceres/loss_function.h>

#include <cmath>
#include <memory>

#include "imu_pose_calib/core/residuals.h"

namespace imu_pose_calib {
namespace {

/// The trajectory's errors stay about the same for this many length scales.
constexpr double kCorrelation = 0.5;
constexpr double kGpTolerance = 1e-8;

}  // namespace

GpProblem::GpProblem(const CalibrationOptions& options,
                     const PoseTrajectory& trajectory,
                     const ConditionedData& data,
                     Sensors sensors,
                     const NoiseStd& noise,
                     Estimate* estimate)
    : CalibrationProblem(options, trajectory, data, noise, estimate) {
  AddGyroParameters();
  AddGyro();
  AddBiasWalk(options_.gyro_bias_walk, &estimate_->gyro_bias);
  if (sensors == Sensors::kGyro) return;
  AddAccelParameters();
  AddAccel();
  AddBiasWalk(options_.accel_bias_walk, &estimate_->accel_bias);
}

double GpProblem::SharedSamples(double rate_hz) const {
  return 1.0 + kCorrelation * trajectory_.rotation_hyperparameters().lengthscale_s * rate_hz;
}

void GpProblem::AddGyro() {
  BiasKnots& knots = estimate_->gyro_bias;
  for (size_t i = 0; i < data_.gyro.size(); ++i) {
    const TimedSample& s = data_.gyro[i];
    const double t_M = s.t + estimate_->time_shift;
    if (!IsOnTrajectory(t_M)) continue;
    const double variance = trajectory_.Variance(t_M).omega;
    const double sigma =
        std::sqrt(noise_.gyro * noise_.gyro + SharedSamples(data_.gyro_report.rate_hz) * variance);
    const auto [k, u] = knots.Locate(s.t);
    const GyroResidual residual{&trajectory_, s.t, s.value, u, sigma};
    gyro_.Add(problem_.AddResidualBlock(residual.Create(),
                                        new ceres::CauchyLoss(options_.robust_loss_scale),
                                        estimate_->q_MI.coeffs().data(),
                                        knots.values[k].data(),
                                        knots.values[k + 1].data(),
                                        &estimate_->time_shift),
              {{i, s.t, sigma, variance}});
  }
  if (gyro_.blocks.empty()) throw DataError("no gyroscope sample falls on the trajectory");
}

void GpProblem::AddAccel() {
  BiasKnots& knots = estimate_->accel_bias;
  const double arm2 = estimate_->p_MI.squaredNorm();
  for (size_t i = 0; i < data_.accel.size(); ++i) {
    const TimedSample& s = data_.accel[i];
    const double t_M = s.t + estimate_->time_shift - estimate_->accel_delay;
    if (!IsOnTrajectory(t_M)) continue;
    MarkerState<double> state;
    trajectory_.Evaluate(t_M, &state);
    // Errors of alpha and omega reach the accelerometer through the lever arm, errors of rotation
    // turn the specific force; all three axes share them.
    const MarkerVariance v = trajectory_.Variance(t_M);
    const double lever = LeverArmCoefficientVariance(v.alpha, v.omega, state.omega_M.squaredNorm());
    const double variance =
        v.accel + (arm2 * lever + 2.0 * v.rotation * s.value.squaredNorm()) / 3.0;
    const double sigma = std::sqrt(noise_.accel * noise_.accel +
                                   SharedSamples(data_.accel_report.rate_hz) * variance);
    feigned_information_ += lever / (sigma * sigma);
    const auto [k, u] = knots.Locate(s.t);
    const AccelResidual residual{&trajectory_, s.t, s.value, u, sigma};
    accel_.Add(problem_.AddResidualBlock(residual.Create(),
                                         new ceres::CauchyLoss(options_.robust_loss_scale),
                                         estimate_->q_MI.coeffs().data(),
                                         estimate_->p_MI.data(),
                                         estimate_->g_W.data(),
                                         knots.values[k].data(),
                                         knots.values[k + 1].data(),
                                         &estimate_->time_shift,
                                         &estimate_->accel_delay),
               {{i, s.t, sigma, variance}});
  }
  if (accel_.blocks.empty()) throw DataError("no accelerometer sample falls on the trajectory");
}

Solution SolveAgainstTrajectory(const CalibrationOptions& options,
                                const PoseTrajectory& trajectory,
                                const ConditionedData& data,
                                Estimate* estimate) {
  using Sensors = GpProblem::Sensors;
  NoiseStd noise = InitialNoise(options, trajectory, data);
  const auto solve = [&](Sensors sensors, double tolerance) {
    auto problem = std::make_unique<GpProblem>(options, trajectory, data, sensors, noise, estimate);
    problem->Solve(tolerance);
    noise = problem->Statistics().noise;
    return problem;
  };
  solve(Sensors::kGyro, kRoughTolerance);
  solve(Sensors::kGyroAndAccel, kRoughTolerance);
  const auto problem = solve(Sensors::kGyroAndAccel, kGpTolerance);
  return {problem->Statistics(), problem->Covariance()};
}

}  // namespace imu_pose_calib
