#include "imu_pose_calib/core/gp_problem.h"

#include <ceres/loss_function.h>
#include <ceres/solver.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <thread>

#include "imu_pose_calib/core/covariance.h"
#include "imu_pose_calib/core/manifolds.h"
#include "imu_pose_calib/core/residuals.h"

namespace imu_pose_calib {
namespace {

constexpr double kMadToSigma = 1.4826;
/// Samples closer than this to the end of a segment are left out, so that the time shift can move.
constexpr double kEdge = 0.02;  // [s]

double Median(std::vector<double> values) {
  const auto middle = values.begin() + static_cast<ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

int Threads(int wanted) {
  return wanted > 0 ? wanted : std::max(1, static_cast<int>(std::thread::hardware_concurrency()));
}

}  // namespace

BiasKnots::BiasKnots(const std::vector<TimedSample>& samples,
                     double interval_s,
                     const Eigen::Vector3d& initial) {
  if (interval_s == 0.0) {
    for (const TimedSample& s : samples) t.push_back(s.t);
  } else {
    const double duration = samples.back().t - samples.front().t;
    const int intervals = std::max(1, static_cast<int>(std::ceil(duration / interval_s)));
    for (int k = 0; k <= intervals; ++k) t.push_back(samples.front().t + duration * k / intervals);
  }
  values.assign(t.size(), initial);
}

std::pair<size_t, double> BiasKnots::Locate(double time) const {
  const auto after = std::upper_bound(t.begin() + 1, t.end() - 1, time);
  const auto k = static_cast<size_t>(after - t.begin()) - 1;
  return {k, std::clamp((time - t[k]) / (t[k + 1] - t[k]), 0.0, 1.0)};
}

Eigen::Vector3d BiasKnots::Mean() const {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  for (const Eigen::Vector3d& v : values) sum += v;
  return sum / static_cast<double>(values.size());
}

Estimate::Estimate(const Start& start, const ConditionedData& data, double bias_knot_interval_s)
    : time_shift(start.time_shift),
      accel_delay(start.accel_delay),
      q_MI(start.q_MI),
      p_MI(start.p_MI),
      g_W(start.g_W),
      gyro_bias(data.gyro, bias_knot_interval_s, start.gyro_bias),
      accel_bias(data.accel, bias_knot_interval_s, start.accel_bias) {}

GpProblem::GpProblem(const CalibrationOptions& options,
                     const PoseTrajectory& trajectory,
                     const ConditionedData& data,
                     Sensors sensors,
                     const ImuNoise& noise,
                     Estimate* estimate)
    : options_(options),
      trajectory_(trajectory),
      data_(data),
      noise_(noise),
      estimate_(estimate) {
  problem_.AddParameterBlock(estimate_->q_MI.coeffs().data(), 4);
  SetUnitQuaternion(estimate_->q_MI.coeffs().data(), &problem_);
  AddGyro();
  AddBiasWalk(options_.gyro_bias_walk, &estimate_->gyro_bias);
  if (sensors == Sensors::kGyro) return;
  problem_.AddParameterBlock(estimate_->g_W.data(), 3);
  SetSphere(estimate_->g_W.data(), &problem_);
  problem_.AddParameterBlock(&estimate_->accel_delay, 1);
  if (!options_.estimate_accel_delay) problem_.SetParameterBlockConstant(&estimate_->accel_delay);
  AddAccel();
  AddBiasWalk(options_.accel_bias_walk, &estimate_->accel_bias);
}

ceres::LossFunction* GpProblem::Loss() const {
  return new ceres::CauchyLoss(options_.robust_loss_scale);
}

void GpProblem::AddGyro() {
  BiasKnots& knots = estimate_->gyro_bias;
  for (const TimedSample& s : data_.gyro) {
    const double t_M = s.t + estimate_->time_shift;
    if (!trajectory_.Contains(t_M - kEdge) || !trajectory_.Contains(t_M + kEdge)) continue;
    const double variance = trajectory_.Variance(t_M).omega;
    const double sigma = std::sqrt(noise_.gyro * noise_.gyro + variance);
    const auto [k, u] = knots.Locate(s.t);
    const GyroResidual residual{&trajectory_, s.t, s.value, u, sigma};
    gyro_terms_.push_back({problem_.AddResidualBlock(residual.Create(),
                                                     Loss(),
                                                     estimate_->q_MI.coeffs().data(),
                                                     knots.values[k].data(),
                                                     knots.values[k + 1].data(),
                                                     &estimate_->time_shift),
                           s.t,
                           sigma,
                           variance});
  }
  if (gyro_terms_.empty()) throw DataError("no gyroscope sample falls on the trajectory");
}

void GpProblem::AddAccel() {
  BiasKnots& knots = estimate_->accel_bias;
  const double arm2 = estimate_->p_MI.squaredNorm();
  for (const TimedSample& s : data_.accel) {
    const double t_M = s.t + estimate_->time_shift - estimate_->accel_delay;
    if (!trajectory_.Contains(t_M - kEdge) || !trajectory_.Contains(t_M + kEdge)) continue;
    MarkerState<double> state;
    trajectory_.Evaluate(t_M, &state);
    // A lever arm p turns errors of alpha into |p|^2 (I - p p^T / |p|^2), of omega into about
    // (2 |omega| |p|)^2; errors of rotation turn the specific force. Per axis:
    const MarkerVariance v = trajectory_.Variance(t_M);
    const double lever_coefficient = 2.0 / 3.0 * v.alpha + 4.0 / 3.0 * v.omega * state.omega_M.squaredNorm();
    const double variance =
        v.accel + arm2 * lever_coefficient + 2.0 / 3.0 * v.rotation * s.value.squaredNorm();
    const double sigma = std::sqrt(noise_.accel * noise_.accel + variance);
    feigned_information_ += 3.0 * lever_coefficient / (sigma * sigma);
    const auto [k, u] = knots.Locate(s.t);
    const AccelResidual residual{&trajectory_, s.t, s.value, u, sigma};
    accel_terms_.push_back({problem_.AddResidualBlock(residual.Create(),
                                                      Loss(),
                                                      estimate_->q_MI.coeffs().data(),
                                                      estimate_->p_MI.data(),
                                                      estimate_->g_W.data(),
                                                      knots.values[k].data(),
                                                      knots.values[k + 1].data(),
                                                      &estimate_->time_shift,
                                                      &estimate_->accel_delay),
                            s.t,
                            sigma,
                            variance});
  }
  if (accel_terms_.empty()) throw DataError("no accelerometer sample falls on the trajectory");
}

void GpProblem::AddBiasWalk(double walk, BiasKnots* knots) {
  for (size_t k = 0; k + 1 < knots->t.size(); ++k) {
    const double sigma = walk * std::sqrt(knots->t[k + 1] - knots->t[k]);
    walk_terms_.push_back({problem_.AddResidualBlock(BiasWalkResidual{sigma}.Create(),
                                                     nullptr,
                                                     knots->values[k].data(),
                                                     knots->values[k + 1].data()),
                           knots->t[k],
                           sigma,
                           0.0});
  }
}

void GpProblem::Solve() {
  ceres::Solver::Options options;
  options.linear_solver_type = ceres::SPARSE_NORMAL_CHOLESKY;
  options.max_num_iterations = options_.max_iterations;
  options.num_threads = Threads(options_.num_threads);
  options.logging_type = ceres::SILENT;
  options.function_tolerance = 1e-9;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem_, &summary);
  if (summary.termination_type == ceres::CONVERGENCE) return;
  throw DataError("the solve did not converge within max_iterations = " +
                  std::to_string(options_.max_iterations) + ": " + summary.message);
}

ResidualStatistics GpProblem::Statistics() {
  const auto statistics = [this](const std::vector<Term>& terms, double* noise, double* rms) {
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
    const double spread = kMadToSigma * Median(magnitudes);
    // The trajectory's share is known only roughly: it never explains the residuals alone.
    *noise = std::sqrt(std::max(spread * spread - Median(variances), 0.01 * spread * spread));
    *noise = std::max(*noise, 1e-9);
    *rms = std::sqrt(sum2 / static_cast<double>(residuals.size()));
  };
  ResidualStatistics s{noise_, {0.0, 0.0}};
  statistics(gyro_terms_, &s.noise.gyro, &s.rms.gyro);
  if (!accel_terms_.empty()) statistics(accel_terms_, &s.noise.accel, &s.rms.accel);
  return s;
}

CalibrationCovariance GpProblem::Covariance() {
  ceres::Problem::EvaluateOptions evaluate;
  const bool has_delay = options_.estimate_accel_delay;
  evaluate.parameter_blocks = {
      estimate_->p_MI.data(), estimate_->q_MI.coeffs().data(), &estimate_->time_shift};
  if (has_delay) evaluate.parameter_blocks.push_back(&estimate_->accel_delay);
  evaluate.parameter_blocks.push_back(estimate_->g_W.data());
  for (BiasKnots* knots : {&estimate_->gyro_bias, &estimate_->accel_bias})
    for (Eigen::Vector3d& value : knots->values) evaluate.parameter_blocks.push_back(value.data());

  std::vector<int> cluster;
  const double start = std::min(data_.gyro.front().t, data_.accel.front().t);
  for (const std::vector<Term>* terms : {&gyro_terms_, &accel_terms_, &walk_terms_}) {
    for (const Term& term : *terms) {
      evaluate.residual_blocks.push_back(term.id);
      cluster.insert(
          cluster.end(), 3, static_cast<int>((term.t - start) / options_.covariance_block_s));
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
