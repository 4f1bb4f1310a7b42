#include "imu_pose_calib/core/calibration_problem.h"

#include <ceres/solver.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <thread>

#include "imu_pose_calib/core/covariance.h"
#include "imu_pose_calib/core/manifolds.h"
#include "imu_pose_calib/core/median.h"
#include "imu_pose_calib/core/residuals.h"

namespace imu_pose_calib {
namespace {

constexpr double kMadToSigma = 1.4826;
/// Samples closer than this to the end of a segment are left out, so that the time shift can move.
constexpr double kEdge = 0.02;  // [s]

int Threads(int wanted) {
  return wanted > 0 ? wanted : std::max(1, static_cast<int>(std::thread::hardware_concurrency()));
}

}  // namespace

NoiseStd InitialNoise(const CalibrationOptions& options,
                      const PoseTrajectory& trajectory,
                      const ConditionedData& data) {
  NoiseStd noise;
  noise.position = trajectory.position_hyperparameters().noise_std;
  noise.rotation = trajectory.rotation_hyperparameters().noise_std;
  noise.gyro = options.gyro_noise_density * std::sqrt(data.gyro_report.rate_hz);
  noise.accel = options.accel_noise_density * std::sqrt(data.accel_report.rate_hz);
  return noise;
}

CalibrationProblem::CalibrationProblem(const CalibrationOptions& options,
                                       const PoseTrajectory& trajectory,
                                       const ConditionedData& data,
                                       const NoiseStd& noise,
                                       Estimate* estimate)
    : options_(options), trajectory_(trajectory), data_(data), noise_(noise), estimate_(estimate) {}

void CalibrationProblem::AddRotation() {
  problem_.AddParameterBlock(estimate_->q_MI.coeffs().data(), 4);
  SetUnitQuaternion(estimate_->q_MI.coeffs().data(), &problem_);
}

void CalibrationProblem::AddGravityAndDelay() {
  problem_.AddParameterBlock(estimate_->g_W.data(), 3);
  SetSphere(estimate_->g_W.data(), &problem_);
  problem_.AddParameterBlock(&estimate_->accel_delay, 1);
  if (!options_.estimate_accel_delay) problem_.SetParameterBlockConstant(&estimate_->accel_delay);
}

void CalibrationProblem::AddBiasWalk(double walk, BiasKnots* knots) {
  for (size_t k = 0; k + 1 < knots->t.size(); ++k) {
    const double sigma = walk * std::sqrt(knots->t[k + 1] - knots->t[k]);
    walk_terms_.push_back({problem_.AddResidualBlock(BiasWalkResidual{sigma}.Create(),
                                                     nullptr,
                                                     knots->values[k].data(),
                                                     knots->values[k + 1].data()),
                           k,
                           knots->t[k],
                           sigma});
  }
}

bool CalibrationProblem::IsOnTrajectory(double t_M) const {
  return trajectory_.Contains(t_M - kEdge) && trajectory_.Contains(t_M + kEdge);
}

void CalibrationProblem::Solve(double function_tolerance) {
  ceres::Solver::Options options;
  options.linear_solver_type = ceres::SPARSE_NORMAL_CHOLESKY;
  options.max_num_iterations = options_.max_iterations;
  options.num_threads = Threads(options_.num_threads);
  options.logging_type = ceres::SILENT;
  options.function_tolerance = function_tolerance;
  // Nearly linear: full Gauss-Newton steps first.
  options.initial_trust_region_radius = 1e8;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem_, &summary);
  if (summary.termination_type == ceres::CONVERGENCE) return;
  throw DataError("the solve did not converge within max_iterations = " +
                  std::to_string(options_.max_iterations) + ": " + summary.message);
}

ResidualStatistics CalibrationProblem::Statistics() {
  // An estimated trajectory follows its data: residuals have fewer degrees of freedom than samples.
  double samples = 0.0;
  for (const auto* terms : {&position_terms_, &rotation_terms_, &gyro_terms_, &accel_terms_})
    samples += 3.0 * static_cast<double>(terms->size());
  const double fitted = 3.0 * static_cast<double>(trajectory_blocks_.size());
  const double inflation = 1.0 / std::sqrt(std::max(0.1, 1.0 - fitted / samples));

  const auto statistics = [&](const std::vector<Term>& terms, double* noise, double* rms) {
    if (terms.empty()) return;
    ceres::Problem::EvaluateOptions evaluate;
    evaluate.apply_loss_function = false;
    for (const Term& term : terms) evaluate.residual_blocks.push_back(term.id);
    std::vector<double> residuals;
    problem_.Evaluate(evaluate, nullptr, &residuals, nullptr, nullptr);
    std::vector<double> magnitudes, variances;
    double sum2 = 0.0;
    for (size_t i = 0; i < residuals.size(); ++i) {
      const Term& term = terms[i / 3];
      magnitudes.push_back(std::abs(residuals[i] * term.sigma));
      variances.push_back(term.trajectory_variance);
      sum2 += magnitudes.back() * magnitudes.back();
    }
    const double spread2 = std::pow(inflation * kMadToSigma * Median(magnitudes), 2);
    // The trajectory's share is known only roughly: it never explains the residuals alone.
    *noise = std::sqrt(std::max({spread2 - Median(variances), 0.01 * spread2, 1e-18}));
    *rms = std::sqrt(sum2 / static_cast<double>(residuals.size()));
  };
  ResidualStatistics s{noise_, {}};
  statistics(position_terms_, &s.noise.position, &s.rms.position);
  statistics(rotation_terms_, &s.noise.rotation, &s.rms.rotation);
  statistics(gyro_terms_, &s.noise.gyro, &s.rms.gyro);
  statistics(accel_terms_, &s.noise.accel, &s.rms.accel);
  return s;
}

CalibrationCovariance CalibrationProblem::Covariance() {
  ceres::Problem::EvaluateOptions evaluate;
  const bool has_delay = options_.estimate_accel_delay;
  evaluate.parameter_blocks = {
      estimate_->p_MI.data(), estimate_->q_MI.coeffs().data(), &estimate_->time_shift};
  if (has_delay) evaluate.parameter_blocks.push_back(&estimate_->accel_delay);
  evaluate.parameter_blocks.push_back(estimate_->g_W.data());
  for (BiasKnots* knots : {&estimate_->gyro_bias, &estimate_->accel_bias})
    for (Eigen::Vector3d& value : knots->values) evaluate.parameter_blocks.push_back(value.data());
  evaluate.parameter_blocks.insert(
      evaluate.parameter_blocks.end(), trajectory_blocks_.begin(), trajectory_blocks_.end());

  std::vector<int> cluster;
  const double start = std::min(data_.gyro.front().t, data_.accel.front().t);
  for (const auto* terms :
       {&position_terms_, &rotation_terms_, &gyro_terms_, &accel_terms_, &walk_terms_}) {
    for (const Term& term : *terms) {
      evaluate.residual_blocks.push_back(term.id);
      const double block = std::max(0.0, (term.t - start) / options_.covariance_block_s);
      cluster.insert(cluster.end(), 3, static_cast<int>(block));
    }
  }
  std::vector<double> residuals;
  ceres::CRSMatrix jacobian;
  problem_.Evaluate(evaluate, nullptr, &residuals, nullptr, &jacobian);
  const int leading = has_delay ? 8 : 7;
  const MarginalCovariance marginal =
      ComputeMarginalCovariance(jacobian, residuals, cluster, leading);

  // Ceres turns q_MI on the left by twice the step: to a rotation about the imu axes.
  Matrix8d T = Matrix8d::Identity();
  T.block<3, 3>(3, 3) = 2.0 * estimate_->q_MI.toRotationMatrix().transpose();
  const auto convert = [&](const Eigen::MatrixXd& C) {
    Matrix8d full = Matrix8d::Zero();
    full.topLeftCorner(leading, leading) = C;
    return Matrix8d(T * full * T.transpose());
  };
  return {convert(marginal.model), convert(marginal.robust), feigned_information_};
}

}  // namespace imu_pose_calib
