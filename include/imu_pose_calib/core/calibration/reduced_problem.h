#pragma once

#include <Eigen/Core>
#include <memory>
#include <optional>
#include <vector>

#include "imu_pose_calib/core/calibration/marginals.h"
#include "imu_pose_calib/core/solver/covariance.h"
#include "imu_pose_calib/core/solver/normal_equations.h"

namespace imu_pose_calib {

/// Parameter blocks of a solve in the order of H, see Marginals.
struct Ordering {
  std::vector<int> border, inner;
  int columns = 0;
  int estimated = 0, leading = 0;  ///< columns of what is calibrated, with what could have been
  int biases = 0, walks = 0, trajectory = 0;  ///< first columns
  std::vector<Parameter> calibrated, possible;
  std::vector<int> clocks, clock_blocks;  ///< columns of those that are estimated, and their blocks

  explicit Ordering(LeastSquares* solved);
};

/// What is reported, as functionals L of the parameters and back: the leading parameters with
/// gravity and mean biases between those that are estimated and those that could have been.
class Functionals {
 public:
  /// Also lists the parameters in the result.
  Functionals(const Ordering& ordering, LeastSquares* solved, Marginals* result);

  /// The column of each functional that is a parameter of the border, else -1.
  const std::vector<int>& columns() const { return columns_; }
  /// Functionals that are the mean of a session's bias knots, in the order of the columns.
  struct Mean {
    size_t session;
    int functional;
    size_t knots;
  };
  const std::vector<Mean>& means() const { return means_; }
  int count() const { return count_; }
  int estimated() const { return estimated_; }    ///< of them, gravity and biases included
  int calibrated() const { return calibrated_; }  ///< without these
  int size() const { return size_; }              ///< of what is reported

  /// Covariance of functionals to what is reported; those beyond the ones given are 0.
  Eigen::MatrixXd Spread(const Eigen::MatrixXd& C) const;
  Eigen::VectorXd SpreadVector(const Eigen::VectorXd& x) const;
  /// Rows: what is reported; columns: functionals.
  Eigen::MatrixXd Basis() const;

 private:
  struct Block {
    int place, functional;
    Eigen::MatrixXd basis;
  };
  std::vector<Block> bases_;
  std::vector<int> columns_;
  std::vector<Mean> means_;
  int leading_ = 0, count_ = 0, size_ = 0, estimated_ = 0, calibrated_ = 0;
};

/// H and scores of the whole problem and of parts of it, when all but the border is eliminated.
/// Right-hand sides: scores of the clusters, functionals, exact columns of the clocks.
class ReducedProblem {
 public:
  ReducedProblem(const Ordering& ordering, const Functionals& functionals, LeastSquares* solved);

  /// Of the functionals.
  MarginalEstimates Estimate() const;
  /// Of those that are parameters of the border: all but mean biases.
  MarginalEstimate EstimateOfBorder(const Functionals& functionals) const;
  /// Of columns of what is calibrated by a part of the residuals, all else that is calibrated or
  /// could be being known.
  struct Part {
    Reduced reduced;
    std::vector<int> windows;  ///< that it has
    std::vector<int> acting;   ///< columns of what is calibrated
  };
  MarginalEstimate EstimateOf(const Part& part, const std::vector<int>& columns) const;
  /// As if what is held was known to be right.
  GaussNewtonStep FindStep() const;
  /// Of H, as far as it is kept; then it is gone.
  Panels TakeFactor();
  const std::shared_ptr<const Elimination>& elimination() const { return elimination_; }

  const std::vector<Part>& halves() const { return halves_; }
  const std::vector<Part>& sessions() const { return sessions_; }

 private:
  int RhsOfClock(size_t clock) const { return windows_ + functionals_ + static_cast<int>(clock); }
  /// H and scores of a window.
  Panels Assemble(size_t window, const std::vector<ExactColumn>& exact) const;
  /// What is known beforehand of the border counts in every part, not only where it stands.
  void AddPriors(const LeastSquares& solved, Part* part) const;
  /// The means of bias knots that are in one window, or are shared.
  void AddMeans(const Functionals& functionals, int window, Panels* panels) const;

  const Ordering& ordering_;
  const int windows_, functionals_, first_trajectory_;
  const NormalEquations equations_;
  const std::shared_ptr<const Elimination> elimination_;
  Eigen::VectorXd weights_;  ///< of right-hand sides, for the gradient
  std::vector<Part> halves_, sessions_;
  Reduced all_;
  std::optional<EliminatedWindows> eliminated_;
};

}  // namespace imu_pose_calib
