#pragma once

/// Room core/solver: large sparse least squares whose unknowns follow each other in time.
/// In: cost functions of Ceres on parameter blocks, put in order of time and cut into windows.
/// Out: normal equations of each window, their elimination into the few parameters all windows
/// share, steps, marginal covariance. Knows nothing of IMUs.
///
/// Why beside ceres::Problem, which Problem::SolveWithCeres() makes of the same blocks: windows are
/// assembled, eliminated and forgotten one by one, so a recording of hours fits in memory, where
/// Ceres holds the Jacobian and the factor of all of it; order and structure are known beforehand
/// and panels are dense, which is several times faster; and the same elimination, with the scores
/// of the windows as right-hand sides, gives the covariances of whole, halves and sessions, robust
/// ones too, and of the trajectory, for which ceres::Covariance would need the whole Jacobian.

#include <functional>
#include <memory>
#include <vector>

#include "imu_pose_calib/core/solver/elimination.h"
#include "imu_pose_calib/core/solver/problem.h"

namespace imu_pose_calib {

/// A residual block and what it is of.
struct Equation {
  int block;  ///< of residuals
  size_t session;
  double t;        ///< [s] pose clock
  int window = 0;  ///< in which its scores are summed up; grows with sessions and time
};

/// H = J^T J and the scores J^T r of a least squares problem, linearised where its parameters stand
/// when they are asked for. Refers to the problem.
class NormalEquations {
 public:
  /// `border`: parameter blocks that act nearly everywhere; `inner`: others that are estimated; in
  /// this order they are the columns of H. All other blocks are held. `windows`: their number.
  NormalEquations(const Problem& problem, const std::vector<int>& border,
                  const std::vector<int>& inner, std::vector<Equation> equations, size_t windows);

  /// H of a window and its score as right-hand side of that number; its share of the cost, unless
  /// that is null. Throws DataError where the residuals cannot be differentiated.
  Panels Assemble(size_t window, double* cost = nullptr) const;

  const std::vector<int>& blocks() const { return blocks_; }
  const std::shared_ptr<const Elimination>& elimination() const { return elimination_; }

 private:
  class Linearisation;

  const Problem& problem_;
  std::vector<int> blocks_;
  std::vector<Equation> equations_;
  std::vector<size_t> first_of_window_;
  std::shared_ptr<const Elimination> elimination_;
  std::vector<int> place_;  ///< of each block of the problem; -1: it is held
};

/// The windows of normal equations when their own columns are eliminated.
class EliminatedWindows {
 public:
  /// All that acts in a window.
  using Assemble = std::function<Panels(size_t window)>;

  /// One window after the other on each of `threads` threads. `weights`: the combination of
  /// right-hand sides that is substituted back. Factors that would take more than `max_factor_mb`
  /// [MB] are not kept.
  EliminatedWindows(std::shared_ptr<const Elimination> elimination, const Eigen::VectorXd& weights,
                    double max_factor_mb, int threads, const Assemble& assemble);

  /// Of some windows alone.
  Reduced Reduce(const std::vector<int>& windows) const;
  /// Of all, and of what else acts on the columns that they share; once.
  Reduced ReduceAll(Panels shared);
  /// The rows of all windows and of what they share, when x has those of the border. `assemble`: as
  /// before, for factors that were not kept.
  void SubstituteBack(const Assemble& assemble, Eigen::VectorXd* x) const;
  /// The factor of all but the border, then it is gone; nothing if it was not kept.
  Panels TakeFactor();

 private:
  Reduced Reduce(const std::vector<int>& windows, bool keeps, Panels* shared) const;

  std::shared_ptr<const Elimination> elimination_;
  Eigen::VectorXd weights_;
  bool keeps_;
  int threads_;
  std::vector<Panels> factors_;  ///< of each window
  std::vector<Rest> rests_;
  Panels shared_factor_;
};

/// 0, 1, ... count - 1.
std::vector<int> Counted(size_t count);

}  // namespace imu_pose_calib
