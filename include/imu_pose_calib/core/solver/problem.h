#pragma once

#include <ceres/cost_function.h>
#include <ceres/version.h>

#include <Eigen/Core>
#include <cstdint>
#include <memory>
#include <optional>
#include <unordered_map>
#include <vector>

/// The only place that knows that Ceres renamed its parameterizations (2.1 against 1.14).
#if CERES_VERSION_MAJOR > 2 || (CERES_VERSION_MAJOR == 2 && CERES_VERSION_MINOR >= 1)
#define IMU_POSE_CALIB_CERES_HAS_MANIFOLDS 1
#include <ceres/manifold.h>
#else
#define IMU_POSE_CALIB_CERES_HAS_MANIFOLDS 0
#include <ceres/local_parameterization.h>
#endif

namespace imu_pose_calib {

/// An Eigen quaternion (x, y, z, w) keeps its unit norm. Ceres moves it on the left and by half the
/// angle: Plus(q, d) turns by 2 d, so a covariance block of q_MI is in M and a quarter of rad^2.
#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
using Manifold = ceres::Manifold;
using QuaternionManifold = ceres::EigenQuaternionManifold;
#else
using Manifold = ceres::LocalParameterization;
using QuaternionManifold = ceres::EigenQuaternionParameterization;
#endif

/// Derivative of a quaternion (x, y, z, w) by a step.
Eigen::MatrixXd PlusJacobian(const double* quaternion);

/// A cost function of samples, three residuals each, of which a residual block can have a part.
class SampledCost : public ceres::CostFunction {
 public:
  /// Residuals of the samples [begin, end); Jacobians have as many rows.
  virtual void EvaluatePart(size_t begin, size_t end, double const* const* parameters,
                            double* residuals, double** jacobians) const = 0;
  bool Evaluate(double const* const* parameters, double* residuals,
                double** jacobians) const override {
    EvaluatePart(0, static_cast<size_t>(num_residuals()) / 3, parameters, residuals, jacobians);
    return true;
  }
};

/// Least squares: residual blocks r, cost functions of Ceres, of parameter blocks that others own;
/// its cost is the sum of rho(|r|^2) / 2. Holds little beside them, so that it can be large and be
/// made often; any number of threads may read it. Both kinds of blocks are numbered as they come.
class Problem {
 public:
  /// Number of a block of parameters; one that is there already stays as it is. Blocks of 4 are
  /// unit quaternions (x, y, z, w), all others vectors.
  int AddParameters(double* data, int size);
  /// -1 when it is not there.
  int Find(const double* data) const;
  void SetHeld(const double* data, bool is_held);
  bool IsEstimated(const double* data) const;

  size_t blocks() const { return parameters_.size(); }
  double* data(int block) const { return At(block).data; }
  /// Degrees of freedom.
  int TangentSize(int block) const { return At(block).size - (At(block).IsQuaternion() ? 1 : 0); }
  /// Moves blocks one after the other by a step of all; returns the values before.
  std::vector<double> Move(const std::vector<int>& blocks, const Eigen::VectorXd& step) const;
  void Restore(const std::vector<int>& blocks, const std::vector<double>& before) const;

  /// Of parameters that are there. `cauchy_scale`: rho is Cauchy's loss, 0: none.
  int AddResiduals(std::shared_ptr<const ceres::CostFunction> cost, const std::vector<int>& blocks,
                   double cauchy_scale = 0.0);
  /// Of the samples [begin, end) of a cost function that was added last or is new.
  int AddResiduals(const std::shared_ptr<const SampledCost>& cost, size_t begin, size_t end,
                   const std::vector<int>& blocks);
  /// The same; parameters that are not there are added.
  int AddResidualsOf(const std::vector<double*>& parameters,
                     std::unique_ptr<const ceres::CostFunction> cost, double cauchy_scale = 0.0);
  struct Residuals {
    const ceres::CostFunction* cost;
    double cauchy_scale;
    size_t first_row, first_block;
    uint32_t begin, end;  ///< samples of a SampledCost; 0: of any other cost function

    int rows() const { return end > 0 ? 3 * static_cast<int>(end - begin) : cost->num_residuals(); }
    size_t blocks() const { return cost->parameter_block_sizes().size(); }
    bool Evaluate(double const* const* parameters, double* residuals, double** jacobians) const;
    /// rho'(|r|^2)
    double Weight(double squared_norm) const;
    double Cost(double squared_norm) const;
  };
  const Residuals& residuals(int number) const { return residuals_[static_cast<size_t>(number)]; }
  /// The parameter blocks of a residual block.
  const int* BlocksOf(const Residuals& residuals) const {
    return &blocks_of_residuals_[residuals.first_block];
  }
  /// Of all residual blocks that were added.
  size_t rows() const { return rows_; }

  /// All rows without their losses, rounded, and the cost. False where they are not defined.
  bool Evaluate(int threads, std::vector<float>* rows, double* cost) const;

  /// Moves the parameters to the minimum by ceres::Solve: the same residuals, losses and manifolds
  /// in a ceres::Problem. Returns its iterations; nothing when it does not converge.
  std::optional<int> SolveWithCeres(double function_tolerance, int max_iterations,
                                    int threads) const;

 private:
  struct ParameterBlock {
    double* data;
    int size;
    bool is_held = false;
    bool IsQuaternion() const { return size == 4; }
  };
  const ParameterBlock& At(int block) const { return parameters_[static_cast<size_t>(block)]; }
  /// Of the parameter blocks of a residual block.
  void FindData(const Residuals& residuals, std::vector<double*>* parameters) const;

  std::vector<ParameterBlock> parameters_;
  std::unordered_map<const double*, int> number_;
  std::vector<std::shared_ptr<const ceres::CostFunction>> costs_;
  std::vector<Residuals> residuals_;
  std::vector<int> blocks_of_residuals_;
  size_t rows_ = 0;
};

}  // namespace imu_pose_calib
