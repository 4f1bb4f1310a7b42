#pragma once

#include <Eigen/Core>
#include <map>
#include <utility>
#include <vector>

namespace imu_pose_calib {

/// Columns of H that are eliminated together, and right-hand sides of their rows by number.
struct Panel {
  /// Lower triangle: rows of the panel's own columns, then those that they act on and that are
  /// eliminated later. Once eliminated, of the Cholesky factor.
  Eigen::MatrixXd H;
  std::map<int, Eigen::VectorXd> rhs;
};
/// By place in the order of elimination, as far as they hold anything; the border is the last.
using Panels = std::map<int, Panel>;

/// What remains of H X = B when all but the border is eliminated.
struct Reduced {
  Eigen::MatrixXd H;      ///< of the border, symmetric; not finite when the inner part is singular
  Eigen::MatrixXd B;      ///< rows of the border
  Eigen::MatrixXd inner;  ///< B^T H^-1 B of what is eliminated

  void Add(const Reduced& other);
  /// B^T H^-1 B of the whole problem; not finite when it is singular.
  Eigen::MatrixXd Products() const;
};

/// Cholesky factorisation of normal equations whose residuals come in order of time. A block of
/// parameters is eliminated as soon as no later residual has it: control points leave a band, slow
/// biases a column or two beside it. The border, blocks that act nearly everywhere, comes last.
class Elimination {
 public:
  /// Degrees of freedom of the blocks, of which the first `border` are the border, and the blocks
  /// of each residual, in order of time and session after session; each session's first residual.
  Elimination(const std::vector<int>& sizes,
              size_t border,
              const std::vector<std::vector<int>>& residuals,
              const std::vector<size_t>& first_of_session);

  int columns() const { return columns_; }
  int border_columns() const { return shapes_.back().columns; }

  /// Of a block in the order of elimination.
  int place(int block) const { return place_[static_cast<size_t>(block)]; }
  /// Adds J^T J (its lower triangle) of a residual of which J has the blocks at these places, which
  /// increase; and a right-hand side of them.
  void Add(const std::vector<int>& places, const Eigen::MatrixXd& product, Panels* panels) const;
  void AddRhs(const std::vector<int>& places,
              int number,
              const Eigen::VectorXd& rhs,
              Panels* panels) const;
  static void Merge(Panels&& from, Panels* to);
  /// Whether anything beside the border acts together with a block of the border.
  bool ActsInside(int block, const Panels& panels) const;
  /// Calls visit(block, diagonal of H) for all blocks in `panels`.
  template <typename Visit>
  void VisitDiagonal(const Visit& visit, Panels* panels) const {
    for (auto& [p, panel] : *panels) {
      const Shape& shape = shapes_[static_cast<size_t>(p)];
      for (int k = shape.first; k < shape.end; ++k)
        visit(block_at_[static_cast<size_t>(k)],
              panel.H.diagonal().segment(offset_[static_cast<size_t>(k)],
                                         size_[static_cast<size_t>(k)]));
    }
  }

  /// Eliminates all but the border. Columns in which nothing acts are left out. With `keeps`, the
  /// panels take the factor and, as their only right-hand side, the combination `weights`, one for
  /// each right-hand side; else they stay.
  Reduced Eliminate(const Eigen::VectorXd& weights, bool keeps, Panels* panels) const;
  /// -H^-1 b, where Eliminate() kept b, when that of the border is known: the rows of `panels`.
  void SubstituteBack(const Panels& panels, Eigen::VectorXd* x) const;
  /// Replaces the factor by the elements of H^-1 at its places, given those of the border:
  /// Takahashi's recursion, as cheap as the factorisation.
  void Invert(const Eigen::MatrixXd& border, Panels* panels) const;
  /// Of them, by columns; 0 where there is no place.
  double At(const Panels& panels, int row, int column) const;

 private:
  struct Shape {
    int first = 0, end = 0;  ///< blocks of its columns, by place, as all that follow
    int columns = 0, height = 0;
    std::vector<int> rows, row_offset;  ///< blocks below
  };
  struct Update {
    std::vector<int> rows;
    Eigen::MatrixXd H, B;
  };
  int border_panel() const { return static_cast<int>(shapes_.size()) - 1; }
  Panel* Touch(int panel, Panels* panels) const;
  /// First row of a block in a panel; -1 when it has none there.
  int Offset(int block, int panel) const;
  /// Rows of all columns of the blocks.
  std::vector<int> Offsets(const int* begin, const int* end, int panel) const;

  int columns_ = 0;
  std::vector<Shape> shapes_;
  std::vector<int> place_;                             ///< of each block
  std::vector<int> block_at_, size_, panel_, offset_;  ///< by place
  std::vector<int> first_column_;                      ///< by place
  std::vector<std::pair<int, int>> place_of_column_;   ///< and which of the block's columns
};

/// Eliminate() for the panels of every session, which share the border.
Reduced EliminateAll(const Elimination& elimination,
                     const Eigen::VectorXd& weights,
                     bool keeps,
                     int threads,
                     std::vector<Panels>* sessions);

}  // namespace imu_pose_calib
