#include "imu_pose_calib/core/solver/problem.h"

#include <ceres/loss_function.h>
#include <ceres/problem.h>
#include <ceres/solver.h>

#include <algorithm>
#include <cmath>
#include <utility>

#include "imu_pose_calib/core/base/parallel.h"

namespace imu_pose_calib {
namespace {

/// Residual blocks that a thread takes at a time.
constexpr size_t kPortion = 512;
/// Beside the tolerance of the cost, those of Ceres that shall not end a solve before it.
constexpr double kNoTolerance = 1e-16;
/// Of the trust region: the first step is that of Gauss and Newton.
constexpr double kWholeStep = 1e14;

/// A residual block for a ceres::Problem.
class CeresResiduals : public ceres::CostFunction {
 public:
  explicit CeresResiduals(const Problem::Residuals& residuals) : residuals_(residuals) {
    set_num_residuals(residuals.rows());
    *mutable_parameter_block_sizes() = residuals.cost->parameter_block_sizes();
  }
  bool Evaluate(double const* const* parameters, double* residuals,
                double** jacobians) const override {
    return residuals_.Evaluate(parameters, residuals, jacobians);
  }

 private:
  const Problem::Residuals& residuals_;
};

}  // namespace

Eigen::MatrixXd PlusJacobian(const double* quaternion) {
  Eigen::Matrix<double, 4, 3, Eigen::RowMajor> J;
#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
  QuaternionManifold().PlusJacobian(quaternion, J.data());
#else
  QuaternionManifold().ComputeJacobian(quaternion, J.data());
#endif
  return J;
}

int Problem::AddParameters(double* data, int size) {
  const auto [place, is_new] = number_.try_emplace(data, static_cast<int>(parameters_.size()));
  if (is_new) parameters_.push_back({data, size});
  return place->second;
}

int Problem::Find(const double* data) const {
  const auto found = number_.find(data);
  return found == number_.end() ? -1 : found->second;
}

void Problem::SetHeld(const double* data, bool is_held) {
  parameters_[static_cast<size_t>(number_.at(data))].is_held = is_held;
}

bool Problem::IsEstimated(const double* data) const {
  const int block = Find(data);
  return block >= 0 && !At(block).is_held;
}

std::vector<double> Problem::Move(const std::vector<int>& blocks,
                                  const Eigen::VectorXd& step) const {
  std::vector<double> before;
  const double* next = step.data();
  for (const int block : blocks) {
    const ParameterBlock& own = At(block);
    before.insert(before.end(), own.data, own.data + own.size);
    const double* const from = &before[before.size() - static_cast<size_t>(own.size)];
    if (own.IsQuaternion())
      QuaternionManifold().Plus(from, next, own.data);
    else
      Eigen::Map<Eigen::VectorXd>(own.data, own.size) +=
          Eigen::Map<const Eigen::VectorXd>(next, own.size);
    next += TangentSize(block);
  }
  return before;
}

void Problem::Restore(const std::vector<int>& blocks, const std::vector<double>& before) const {
  const double* next = before.data();
  for (const int block : blocks) {
    std::copy_n(next, At(block).size, At(block).data);
    next += At(block).size;
  }
}

int Problem::AddResiduals(std::shared_ptr<const ceres::CostFunction> cost,
                          const std::vector<int>& blocks, double cauchy_scale) {
  if (costs_.empty() || costs_.back() != cost) costs_.push_back(std::move(cost));
  residuals_.push_back(
      {costs_.back().get(), cauchy_scale, rows_, blocks_of_residuals_.size(), 0, 0});
  blocks_of_residuals_.insert(blocks_of_residuals_.end(), blocks.begin(), blocks.end());
  rows_ += static_cast<size_t>(residuals_.back().rows());
  return static_cast<int>(residuals_.size()) - 1;
}

int Problem::AddResiduals(const std::shared_ptr<const SampledCost>& cost, size_t begin, size_t end,
                          const std::vector<int>& blocks) {
  const size_t first_row = rows_;
  const int number = AddResiduals(cost, blocks);
  residuals_.back().begin = static_cast<uint32_t>(begin);
  residuals_.back().end = static_cast<uint32_t>(end);
  rows_ = first_row + 3 * (end - begin);
  return number;
}

int Problem::AddResidualsOf(const std::vector<double*>& parameters,
                            std::unique_ptr<const ceres::CostFunction> cost, double cauchy_scale) {
  std::vector<int> blocks;
  for (size_t k = 0; k < parameters.size(); ++k)
    blocks.push_back(AddParameters(parameters[k], cost->parameter_block_sizes()[k]));
  return AddResiduals(std::move(cost), blocks, cauchy_scale);
}

bool Problem::Residuals::Evaluate(double const* const* parameters, double* residuals,
                                  double** jacobians) const {
  if (end == 0) return cost->Evaluate(parameters, residuals, jacobians);
  static_cast<const SampledCost*>(cost)->EvaluatePart(begin, end, parameters, residuals, jacobians);
  return true;
}

double Problem::Residuals::Weight(double squared_norm) const {
  return cauchy_scale == 0.0 ? 1.0 : 1.0 / (1.0 + squared_norm / (cauchy_scale * cauchy_scale));
}

double Problem::Residuals::Cost(double squared_norm) const {
  const double scale2 = cauchy_scale * cauchy_scale;
  return 0.5 * (scale2 == 0.0 ? squared_norm : scale2 * std::log1p(squared_norm / scale2));
}

void Problem::FindData(const Residuals& residuals, std::vector<double*>* parameters) const {
  parameters->clear();
  for (size_t i = 0; i < residuals.blocks(); ++i)
    parameters->push_back(data(BlocksOf(residuals)[i]));
}

bool Problem::Evaluate(int threads, std::vector<float>* rows, double* cost) const {
  rows->resize(rows_);
  const size_t portions = (residuals_.size() + kPortion - 1) / kPortion;
  std::vector<double> costs(portions, 0.0);
  InParallel(threads, portions, [&](size_t p) {
    std::vector<double*> parameters;
    Eigen::VectorXd r;
    for (size_t k = p * kPortion; k < std::min(residuals_.size(), (p + 1) * kPortion); ++k) {
      const Residuals& own = residuals_[k];
      FindData(own, &parameters);
      r.resize(own.rows());
      if (!own.Evaluate(parameters.data(), r.data(), nullptr)) {
        costs[p] = std::nan("");
        return;
      }
      costs[p] += own.Cost(r.squaredNorm());
      std::copy_n(r.data(), r.size(), rows->begin() + static_cast<ptrdiff_t>(own.first_row));
    }
  });
  *cost = 0.0;
  for (const double portion : costs) *cost += portion;
  return std::isfinite(*cost);
}

std::optional<int> Problem::SolveWithCeres(double function_tolerance, int max_iterations,
                                           int threads) const {
  ceres::Problem problem;
  for (const ParameterBlock& block : parameters_) {
    problem.AddParameterBlock(block.data, block.size);
    if (block.is_held) problem.SetParameterBlockConstant(block.data);
    if (!block.IsQuaternion()) continue;
#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
    problem.SetManifold(block.data, new QuaternionManifold);
#else
    problem.SetParameterization(block.data, new QuaternionManifold);
#endif
  }
  std::vector<double*> parameters;
  for (const Residuals& own : residuals_) {
    FindData(own, &parameters);
    problem.AddResidualBlock(
        new CeresResiduals(own),
        own.cauchy_scale > 0.0 ? new ceres::CauchyLoss(own.cauchy_scale) : nullptr, parameters);
  }
  ceres::Solver::Options options;
  options.max_num_iterations = max_iterations;
  options.num_threads = threads;
  options.function_tolerance = function_tolerance;
  options.gradient_tolerance = kNoTolerance;
  options.initial_trust_region_radius = kWholeStep;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  if (summary.termination_type != ceres::CONVERGENCE) return std::nullopt;
  return static_cast<int>(summary.iterations.size()) - 1;
}

}  // namespace imu_pose_calib
