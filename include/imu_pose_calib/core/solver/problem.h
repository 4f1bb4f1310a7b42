#pragma once

#include <ceres/cost_function.h>

#include <Eigen/Core>
#include <cstdint>
#include <memory>
#include <unordered_map>
#include <vector>

#include "imu_pose_calib/core/solver/manifolds.h"

namespace imu_pose_calib {

/// A cost function of samples, three residuals each, of which a residual block can have a part.
class SampledCost : public ceres::CostFunction {
 public:
  /// Residuals of the samples [begin, end); Jacobians have as many rows, `stride` elements apart,
  /// or one after the other when it is 0.
  virtual bool EvaluatePart(size_t begin, size_t end, double const* const* parameters,
                            double* residuals, double** jacobians, int stride) const = 0;
  bool Evaluate(double const* const* parameters, double* residuals,
                double** jacobians) const override {
    return EvaluatePart(0, static_cast<size_t>(num_residuals()) / 3, parameters, residuals,
                        jacobians, 0);
  }
};

/// Least squares: residual blocks r, cost functions of Ceres, of parameter blocks that others own;
/// its cost is the sum of rho(|r|^2) / 2. Holds little beside them, so that it can be large and be
/// made often; any number of threads may read it. Both kinds of blocks are numbered as they come.
class Problem {
 public:
  /// Number of a block of parameters; one that is there already stays as it is.
  int AddParameters(double* data, int size, BlockKind kind = BlockKind::kVector);
  /// -1 when it is not there.
  int Find(const double* data) const;
  void SetHeld(const double* data, bool is_held);
  bool IsEstimated(const double* data) const;

  size_t blocks() const { return parameters_.size(); }
  double* data(int block) const { return At(block).data; }
  int TangentSize(int block) const;
  BlockKind kind(int block) const { return At(block).kind; }
  /// Of a quaternion.
  Eigen::MatrixXd PlusJacobian(int block) const;
  /// Moves blocks one after the other by a step of all; returns the values before.
  std::vector<double> Move(const std::vector<int>& blocks, const Eigen::VectorXd& step) const;
  void Restore(const std::vector<int>& blocks, const std::vector<double>& before) const;

  /// Of parameters that are there. `cauchy_scale`: rho is Cauchy's loss, 0: none.
  int AddResiduals(std::shared_ptr<const ceres::CostFunction> cost, const std::vector<int>& blocks,
                   double cauchy_scale = 0.0);
  /// Of the samples [begin, end) of a cost function that was added last or is new.
  int AddResiduals(const std::shared_ptr<const SampledCost>& cost, size_t begin, size_t end,
                   const std::vector<int>& blocks);
  /// The same; parameters that are not there are added as vectors.
  int AddResidualsOf(const std::vector<double*>& parameters,
                     std::unique_ptr<const ceres::CostFunction> cost, double cauchy_scale = 0.0);
  struct Residuals {
    const ceres::CostFunction* cost;
    double cauchy_scale;
    size_t first_row, first_block;
    uint32_t begin, end;  ///< samples of a SampledCost; 0: of any other cost function

    bool IsSampled() const { return end > 0; }
    int rows() const { return end > 0 ? 3 * static_cast<int>(end - begin) : cost->num_residuals(); }
    /// `stride`: see SampledCost; others have their Jacobians' rows one after the other.
    bool Evaluate(double const* const* parameters, double* residuals, double** jacobians,
                  int stride = 0) const;
    /// rho'(|r|^2)
    double Weight(double squared_norm) const;
    double Cost(double squared_norm) const;
  };
  const Residuals& residuals(int number) const { return residuals_[static_cast<size_t>(number)]; }
  /// The parameter blocks of a residual block, as many as its cost function has.
  const int* BlocksOf(const Residuals& residuals) const {
    return &blocks_of_residuals_[residuals.first_block];
  }

  /// All rows without their losses, rounded, and the cost. False where they are not defined.
  bool Evaluate(int threads, std::vector<float>* rows, double* cost) const;

 private:
  struct ParameterBlock {
    double* data;
    int size;
    BlockKind kind;
    bool is_held;
  };
  const ParameterBlock& At(int block) const { return parameters_[static_cast<size_t>(block)]; }

  std::vector<ParameterBlock> parameters_;
  std::unordered_map<const double*, int> number_;
  std::vector<std::shared_ptr<const ceres::CostFunction>> costs_;
  std::vector<Residuals> residuals_;
  std::vector<int> blocks_of_residuals_;
  size_t rows_ = 0;
};

}  // namespace imu_pose_calib
