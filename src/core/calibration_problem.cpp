#include "imu_pose_calib/core/calibration_problem.h"

#include <ceres/normal_prior.h>
#include <ceres/solver.h>

#include <algorithm>
#include <cmath>
#include <future>
#include <string>
#include <thread>

#include "imu_pose_calib/core/covariance.h"
#include "imu_pose_calib/core/manifolds.h"
#include "imu_pose_calib/core/median.h"
#include "imu_pose_calib/core/residuals.h"

namespace imu_pose_calib {
namespace {

/// Samples closer than this to the end of a segment are left out, so that the time shift can move.
constexpr double kEdge = 0.02;  // [s]
/// On each coordinate of the trajectory's corrections [1/m^2, 1/rad^2]: nothing beside any sample.
constexpr double kWeakInformation = 1.0;
/// Residuals of a sensor that the trajectory follows more closely say little about its noise.
constexpr double kLeastRedundancy = 0.1;
/// Blocks of the cluster-robust covariance by default, and their least length [s].
constexpr double kCovarianceBlocks = 24.0;
constexpr double kShortestBlock = 2.0;
/// Rows of the Jacobian that Covariance() holds at a time.
constexpr size_t kPortionRows = 100000;
/// Beyond which Covariance() looks for the change of the gradient [s].
constexpr double kClockStep = 1e-6;
/// From which Covariance() factorises one matrix at a time.
constexpr int kManyColumns = 100000;

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

void CalibrationProblem::Sensor::Add(ceres::ResidualBlockId block,
                                     const std::vector<Sample>& block_samples) {
  blocks.push_back(block);
  block_t.push_back(block_samples.front().t);
  samples.insert(samples.end(), block_samples.begin(), block_samples.end());
}

void CalibrationProblem::SetConstantUnless(bool estimated, double* parameters) {
  if (!estimated) problem_.SetParameterBlockConstant(parameters);
}

void CalibrationProblem::AddGyroParameters() {
  double* q_MI = estimate_->q_MI.coeffs().data();
  problem_.AddParameterBlock(q_MI, 4);
  SetUnitQuaternion(q_MI, &problem_);
  SetConstantUnless(options_.estimate_rotation, q_MI);
  problem_.AddParameterBlock(&estimate_->time_shift, 1);
  SetConstantUnless(options_.estimate_time_shift, &estimate_->time_shift);
}

void CalibrationProblem::AddAccelParameters() {
  problem_.AddParameterBlock(estimate_->p_MI.data(), 3);
  SetConstantUnless(options_.estimate_translation, estimate_->p_MI.data());
  problem_.AddParameterBlock(estimate_->g_W.data(), 3);
  SetSphere(estimate_->g_W.data(), &problem_);
  SetConstantUnless(options_.estimate_gravity, estimate_->g_W.data());
  problem_.AddParameterBlock(&estimate_->accel_delay, 1);
  SetConstantUnless(options_.estimate_accel_delay, &estimate_->accel_delay);
}

void CalibrationProblem::AddBiasWalk(double walk, BiasKnots* knots) {
  for (size_t k = 0; k + 1 < knots->t.size(); ++k) {
    const double sigma = walk * std::sqrt(knots->t[k + 1] - knots->t[k]);
    priors_.blocks.push_back(problem_.AddResidualBlock(BiasWalkResidual{sigma}.Create(),
                                                       nullptr,
                                                       knots->values[k].data(),
                                                       knots->values[k + 1].data()));
    priors_.block_t.push_back(knots->t[k]);
  }
}

void CalibrationProblem::AddOptional(bool estimated, double sigma, int size, double* parameters) {
  problem_.AddParameterBlock(parameters, size);
  SetConstantUnless(estimated, parameters);
  if (!estimated) return;
  auto* prior = new ceres::NormalPrior(Eigen::MatrixXd::Identity(size, size) / sigma,
                                       Eigen::VectorXd::Zero(size));
  priors_.blocks.push_back(problem_.AddResidualBlock(prior, nullptr, parameters));
  priors_.block_t.push_back(estimate_->clock_reference);
}

bool CalibrationProblem::IsOnTrajectory(double t_M) const {
  return trajectory_.Contains(t_M - kEdge) && trajectory_.Contains(t_M + kEdge);
}

void CalibrationProblem::Solve(double function_tolerance) {
  ceres::Solver::Options options;
  options.linear_solver_type = ceres::SPARSE_NORMAL_CHOLESKY;
  options.sparse_linear_algebra_library_type = ceres::EIGEN_SPARSE;  // small blocks: no BLAS
  options.max_num_iterations = options_.max_iterations;
  options.num_threads = Threads(options_.num_threads);
  options.logging_type = ceres::SILENT;
  options.function_tolerance = function_tolerance;
  options.jacobi_scaling = false;  // Cholesky does not need it
  // Nearly linear: full Gauss-Newton steps first.
  options.initial_trust_region_radius = 1e8;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem_, &summary);
  if (summary.termination_type == ceres::CONVERGENCE) return;
  throw DataError("the solve did not converge within max_iterations = " +
                  std::to_string(options_.max_iterations) + ": " + summary.message);
}

ResidualStatistics CalibrationProblem::Statistics() {
  const auto statistics = [&](Sensor* sensor, double fitted, double* noise, double* rms) {
    if (sensor->samples.empty()) return;
    ceres::Problem::EvaluateOptions evaluate;
    evaluate.apply_loss_function = false;
    evaluate.num_threads = Threads(options_.num_threads);
    evaluate.residual_blocks = sensor->blocks;
    std::vector<double> residuals;
    problem_.Evaluate(evaluate, nullptr, &residuals, nullptr, nullptr);
    std::vector<double> magnitudes, variances;
    double sum2 = 0.0;
    sensor->residuals.clear();
    for (size_t i = 0; i < sensor->samples.size(); ++i) {
      const Sample& sample = sensor->samples[i];
      const Eigen::Vector3d r =
          sample.sigma / sample.scale * Eigen::Map<const Eigen::Vector3d>(&residuals[3 * i]);
      for (const double x : r) magnitudes.push_back(std::abs(x));
      variances.push_back(sample.trajectory_variance);
      sensor->residuals.push_back(r);
      sum2 += sample.scale * sample.scale * r.squaredNorm();
    }
    const double redundancy = std::max(kLeastRedundancy, 1.0 - fitted);
    const double spread2 = std::pow(kMadToSigma * Median(magnitudes), 2) / redundancy;
    // The trajectory's share is known only roughly: it never explains the residuals alone.
    *noise = std::sqrt(std::max({spread2 - Median(variances), 0.01 * spread2, 1e-18}));
    *rms = std::sqrt(sum2 / static_cast<double>(residuals.size()));
  };
  ResidualStatistics s{noise_, {}};
  const NoiseStd fitted = FittedShare();
  statistics(&position_, fitted.position, &s.noise.position, &s.rms.position);
  statistics(&rotation_, fitted.rotation, &s.noise.rotation, &s.rms.rotation);
  statistics(&gyro_, fitted.gyro, &s.noise.gyro, &s.rms.gyro);
  statistics(&accel_, fitted.accel, &s.noise.accel, &s.rms.accel);
  return s;
}

CalibrationCovariance CalibrationProblem::Covariance() {
  // Leading parameters first: those estimated, then those that could have been.
  struct Part {
    double* parameters;
    int place, size;
  };
  const Part parts[] = {{estimate_->p_MI.data(), kTranslation, 3},
                        {estimate_->q_MI.coeffs().data(), kRotation, 3},
                        {&estimate_->time_shift, kTimeShift, 1},
                        {&estimate_->accel_delay, kAccelDelay, 1},
                        {&estimate_->clock_drift, kClockDrift, 1},
                        {&estimate_->pose_smoothing, kPoseSmoothing, 1},
                        {estimate_->gyro_intrinsics.data(), kGyroIntrinsics, 6},
                        {estimate_->accel_intrinsics.data(), kAccelIntrinsics, 9}};
  std::vector<int> places, possible_places;
  std::vector<double*> possible;
  std::vector<std::pair<double*, int>> clocks;  // and their columns
  ceres::Problem::EvaluateOptions evaluate;
  evaluate.num_threads = Threads(options_.num_threads);
  for (const Part& part : parts) {
    if (!problem_.HasParameterBlock(part.parameters)) continue;
    const bool is_estimated = !problem_.IsParameterBlockConstant(part.parameters);
    if (!is_estimated && part.place < kClockDrift) continue;  // known to the user
    if (is_estimated && (part.place == kTimeShift || part.place == kAccelDelay))
      clocks.emplace_back(part.parameters, static_cast<int>(places.size()));
    (is_estimated ? evaluate.parameter_blocks : possible).push_back(part.parameters);
    for (int k = 0; k < part.size; ++k)
      (is_estimated ? places : possible_places).push_back(part.place + k);
  }
  const auto estimated = static_cast<int>(places.size());
  for (double* parameters : possible) {
    problem_.SetParameterBlockVariable(parameters);
    evaluate.parameter_blocks.push_back(parameters);
  }
  places.insert(places.end(), possible_places.begin(), possible_places.end());

  // All others.
  const size_t leading_blocks = evaluate.parameter_blocks.size();
  if (options_.estimate_gravity) evaluate.parameter_blocks.push_back(estimate_->g_W.data());
  for (BiasKnots* knots : {&estimate_->gyro_bias, &estimate_->accel_bias})
    for (Eigen::Vector3d& value : knots->values) evaluate.parameter_blocks.push_back(value.data());
  const size_t trajectory_begin = evaluate.parameter_blocks.size();
  evaluate.parameter_blocks.insert(
      evaluate.parameter_blocks.end(), trajectory_blocks_.begin(), trajectory_blocks_.end());
  int columns = 0, shared = 0;  // shared: beside the trajectory
  for (size_t i = 0; i < evaluate.parameter_blocks.size(); ++i) {
    const int size = TangentSize(problem_, evaluate.parameter_blocks[i]);
    columns += size;
    if (i >= leading_blocks && i < trajectory_begin) shared += size;
  }

  // In portions, so that the Jacobian is never there as a whole.
  const double start = std::min(data_.gyro.front().t, data_.accel.front().t);
  const double end = std::max(data_.gyro.back().t, data_.accel.back().t);
  const double block_s = options_.covariance_block_s > 0.0
                             ? options_.covariance_block_s
                             : std::max(kShortestBlock, (end - start) / kCovarianceBlocks);
  const auto cluster_of = [&](double t) {
    return static_cast<int>(std::max(0.0, t - start) / block_s);
  };
  MarginalEstimator estimator(
      columns, static_cast<int>(places.size()), cluster_of(0.5 * (start + end)));
  std::vector<int> cluster;  // of each row
  const auto add_portion = [&] {
    std::vector<double> residuals;
    ceres::CRSMatrix jacobian;
    problem_.Evaluate(evaluate, nullptr, &residuals, nullptr, &jacobian);
    estimator.Add(jacobian, residuals, cluster);
    for (const auto& [clock, column] : clocks)
      estimator.AddCurvature(
          column, Curvature(&problem_, evaluate, jacobian, residuals, clock, column, kClockStep));
    evaluate.residual_blocks.clear();
    cluster.clear();
  };
  for (const Sensor* sensor : {&position_, &rotation_, &gyro_, &accel_, &priors_}) {
    for (size_t i = 0; i < sensor->blocks.size(); ++i) {
      const ceres::ResidualBlockId block = sensor->blocks[i];
      const int rows = problem_.GetCostFunctionForResidualBlock(block)->num_residuals();
      evaluate.residual_blocks.push_back(block);
      cluster.insert(cluster.end(), static_cast<size_t>(rows), cluster_of(sensor->block_t[i]));
      if (cluster.size() > kPortionRows) add_portion();
    }
  }
  add_portion();
  estimator.AddPrior(static_cast<int>(places.size()) + shared, kWeakInformation);
  for (double* parameters : possible) problem_.SetParameterBlockConstant(parameters);

  // Ceres turns q_MI on the left by twice the step: to a rotation about the imu axes.
  CalibrationMatrix T = CalibrationMatrix::Identity();
  T.block<3, 3>(kRotation, kRotation) = 2.0 * estimate_->q_MI.toRotationMatrix().transpose();
  const auto spread = [&](const Eigen::MatrixXd& C) {
    CalibrationMatrix full = CalibrationMatrix::Zero();
    for (Eigen::Index i = 0; i < C.rows(); ++i)
      for (Eigen::Index j = 0; j < C.cols(); ++j)
        full(places[static_cast<size_t>(i)], places[static_cast<size_t>(j)]) = C(i, j);
    return CalibrationMatrix(T * full * T.transpose());
  };
  const auto spread_vector = [&](const Eigen::VectorXd& x) {
    CalibrationVector full = CalibrationVector::Zero();
    for (Eigen::Index i = 0; i < x.size(); ++i) full[places[static_cast<size_t>(i)]] = x[i];
    return CalibrationVector(T * full);
  };

  CalibrationCovariance result;
  // Side by side, unless that takes too much memory.
  const auto launch = columns < kManyColumns ? std::launch::async : std::launch::deferred;
  auto first_half = std::async(launch, [&] { return estimator.EstimateHalf(0); });
  auto second_half = std::async(launch, [&] { return estimator.EstimateHalf(1); });
  const MarginalEstimates estimates = estimator.Estimate();
  const MarginalEstimate& all = estimates.gauss_newton;
  const MarginalEstimate marginal = Condition(all, estimated);
  // Scores have as many dimensions per cluster as there are parameters that act in it; the fit sets
  // as many of them to 0 as it has parameters.
  const double local = estimated + (options_.estimate_gravity ? 2 : 0) + 6;
  const double fitted =
      std::min(kLargestFittedShare,
               (estimated + shared) / (local * static_cast<double>(all.influence.cols())));
  // A step that remains moves all clusters alike: that is no scatter.
  const auto robust = [fitted](MarginalEstimate estimate) {
    estimate.influence.colwise() -= estimate.influence.rowwise().mean().eval();
    return ClusterRobustCovariance(estimate, fitted);
  };
  result.model = spread(marginal.covariance);
  result.robust = spread(robust(Condition(estimates.exact, estimated)));
  if (marginal.covariance.allFinite()) result.step = spread_vector(marginal.Step());
  result.feigned_lever_arm_information = FeignedLeverArmInformation();

  const auto larger_std = [&robust](const MarginalEstimate& estimate) {
    return Eigen::VectorXd(
        estimate.covariance.diagonal().cwiseMax(robust(estimate).diagonal()).cwiseSqrt());
  };
  const MarginalEstimate first = Condition(first_half.get(), estimated);
  const MarginalEstimate second = Condition(second_half.get(), estimated);
  const Eigen::VectorXd difference = second.Step() - first.Step();
  // A parameter that is missing makes blocks differ slowly, as drift does: that is no scatter
  // either.
  MarginalEstimate neighbours = all;
  neighbours.influence = (all.influence.rightCols(all.influence.cols() - 1) -
                          all.influence.leftCols(all.influence.cols() - 1)) /
                         std::sqrt(2.0);
  const Eigen::VectorXd hint_std = larger_std(neighbours);
  result.halves_difference = spread_vector(difference);
  const Eigen::VectorXd difference_std =
      (larger_std(first).cwiseAbs2() + larger_std(second).cwiseAbs2()).cwiseSqrt();
  const double largest = difference.cwiseQuotient(difference_std).cwiseAbs().maxCoeff();
  result.halves_sigmas = std::isfinite(largest) ? largest : 0.0;
  for (Eigen::Index i = estimated; i < all.covariance.rows(); ++i) {
    const int place = places[static_cast<size_t>(i)];
    result.hint[place] = all.Step()[i];
    result.hint_std[place] = hint_std[i];
  }
  return result;
}

}  // namespace imu_pose_calib
