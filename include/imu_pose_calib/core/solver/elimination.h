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

  /// B^T H^-1 B of the whole problem; not finite when it is singular.
  Eigen::MatrixXd Products() const;
};

/// What is left when the columns of a window are eliminated.
struct Rest {
  Panels shared;             ///< columns that windows share, border included
  std::vector<int> numbers;  ///< of right-hand sides
  Eigen::MatrixXd inner;     ///< as in Reduced, of these
  bool is_singular = false;
};

/// Cholesky factorisation of normal equations whose residuals come in order of time and are cut
/// into windows. Blocks of parameters that act in one window only are eliminated there, as soon as
/// no later residual has them: control points leave a band, slow biases a column or two beside it.
/// Windows need no more than their own residuals, so that they can be taken one by one and by any
/// thread. Then come the blocks that windows share, and at last the border: blocks that act nearly
/// everywhere.
class Elimination {
 public:
  /// Degrees of freedom of the blocks, of which the first `border` are the border, and the blocks
  /// of each residual, in order of time; the first residual of each window, which increase.
  Elimination(const std::vector<int>& sizes, size_t border,
              const std::vector<std::vector<int>>& residuals,
              const std::vector<size_t>& first_of_window);

  int windows() const { return static_cast<int>(first_panel_.size()) - 1; }
  /// Window of a block; windows() when several share it.
  int WindowOf(int block) const;

  double factor_mb() const;  ///< of the whole factor [MB]
  int columns() const { return static_cast<int>(place_of_column_.size()); }
  int border_columns() const { return shapes_.back().columns; }

  /// Of a block in the order of elimination.
  int place(int block) const { return place_[static_cast<size_t>(block)]; }
  /// Adds a symmetric matrix (its lower triangle) with rows at these places, which increase, as
  /// J^T J of a residual; and a right-hand side of them. Without `creates`, panels that are not
  /// there are left out.
  void Add(const std::vector<int>& places, const Eigen::Ref<const Eigen::MatrixXd>& product,
           Panels* panels, bool creates = true) const;
  void AddRhs(const std::vector<int>& places, int number,
              const Eigen::Ref<const Eigen::VectorXd>& rhs, Panels* panels,
              bool creates = true) const;
  static void Merge(const Panels& from, Panels* to);
  /// Calls visit(block, diagonal of H) for all blocks in `panels`.
  template <typename Visit>
  void VisitDiagonal(const Visit& visit, Panels* panels) const {
    for (auto& [p, panel] : *panels) {
      const Shape& shape = shapes_[static_cast<size_t>(p)];
      for (int k = shape.first; k < shape.end; ++k)
        visit(At(k).number, panel.H.diagonal().segment(At(k).offset, At(k).size));
    }
  }

  /// Eliminates the columns of a window, given all that acts there, of which what is shared goes to
  /// the rest. Columns in which nothing acts are left out. With `keeps`, the panels take, as their
  /// only right-hand side, the combination `weights`, one for each right-hand side.
  Rest EliminateWindow(int window, const Eigen::VectorXd& weights, bool keeps,
                       Panels* panels) const;
  /// The same of what windows share, and of what else acts there.
  Reduced Reduce(const std::vector<const Rest*>& windows, const Eigen::VectorXd& weights,
                 bool keeps, Panels* shared) const;
  /// -H^-1 b, where b was kept, when those of later columns are known: the rows of `panels`.
  void SubstituteBack(const Panels& panels, Eigen::VectorXd* x) const;
  /// Replaces the factor by the elements of H^-1 at its places, given those of the border:
  /// Takahashi's recursion, as cheap as the factorisation.
  void Invert(const Eigen::MatrixXd& border, int threads, Panels* panels) const;
  /// Of them, by columns; 0 where there is no place.
  double At(const Panels& panels, int row, int column) const;

 private:
  struct Block {
    int number, size, panel;
    int offset;      ///< in the panel
    int column = 0;  ///< of H
  };
  struct Shape {
    int first = 0, end = 0;  ///< blocks of its columns, by place, as all that follow
    int columns = 0, height = 0;
    std::vector<int> rows, row_offset;  ///< blocks below
  };
  /// By window and the last residual that has them, the border last; returns the window of each.
  std::vector<int> OrderBlocks(size_t border, const std::vector<std::vector<int>>& residuals,
                               const std::vector<size_t>& first_of_window, std::vector<int>* order);
  /// Of blocks in that order.
  void FormPanels(const std::vector<int>& sizes, size_t border, const std::vector<int>& order,
                  const std::vector<int>& window, int windows);
  /// The blocks below each panel: of its residuals, and of what is eliminated before.
  void FindRows(const std::vector<std::vector<int>>& residuals);
  void EliminatePanels(int begin, int end, const Eigen::VectorXd& weights, bool keeps,
                       Panels* panels, Rest* rest) const;
  /// Those before `end`, the last first, when those that they act on are inverted.
  void InvertPanels(int begin, int end, Panels* panels) const;
  int border_panel() const { return static_cast<int>(shapes_.size()) - 1; }
  const Block& At(int place) const { return blocks_[static_cast<size_t>(place)]; }
  /// Null when it is not there and not created.
  Panel* Find(int panel, bool creates, Panels* panels) const;
  /// First row of a block in a panel; -1 when it has none there.
  int Offset(int place, int panel) const;

  std::vector<Shape> shapes_;
  std::vector<int> first_panel_;                      ///< of each window, and of what they share
  std::vector<int> place_;                            ///< of each block
  std::vector<Block> blocks_;                         ///< by place
  std::vector<std::pair<int, int>> place_of_column_;  ///< and which of the block's columns
};

}  // namespace imu_pose_calib
