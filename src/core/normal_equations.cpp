#include "imu_pose_calib/core/normal_equations.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "imu_pose_calib/core/dense.h"
#include "imu_pose_calib/core/types.h"

namespace imu_pose_calib {
namespace {

using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
using RowMajor3 = Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor>;

/// Whether two columns of J are each other's negative, by the lower triangle of J^T J: parameters
/// that move the same samples along the trajectory, one on and one back.
bool AreOpposite(const Eigen::Map<Eigen::MatrixXd>& product, Eigen::Index a, Eigen::Index b) {
  constexpr double kRounding = 1e-13;
  const double norm2 = product(a, a), inner = product(std::max(a, b), std::min(a, b));
  return std::abs(product(b, b) - norm2) < kRounding * norm2 &&
         std::abs(inner + norm2) < kRounding * norm2;
}

}  // namespace

/// One residual block at a time, weighted by its loss; its columns in the order of elimination.
class NormalEquations::Linearisation {
 public:
  explicit Linearisation(const NormalEquations& equations) : equations_(equations) {
    for (const int block : equations.curved_)
      plus_.push_back(equations.problem_.PlusJacobian(block));
  }

  void Start(const Equation& equation) {
    const Problem& problem = equations_.problem_;
    residuals_ = &problem.residuals(equation.block);
    blocks_ = problem.BlocksOf(*residuals_);
    const std::vector<int32_t>& sizes = residuals_->cost->parameter_block_sizes();
    const int rows = residuals_->rows();
    parameters_.resize(sizes.size());
    terms_.clear();
    Eigen::Index columns = 0, numbers = 0;
    for (size_t k = 0; k < sizes.size(); ++k) {
      parameters_[k] = problem.data(blocks_[k]);
      const Place& at = equations_.places_[static_cast<size_t>(blocks_[k])];
      if (at.place < 0) continue;
      terms_.push_back({at.place, k, sizes[k], at.size, at.curved});
      columns += at.size;
      numbers += rows * sizes[k];
    }
    std::sort(terms_.begin(), terms_.end(), [](const Term& a, const Term& b) {
      return a.place < b.place;
    });
    places.clear();
    for (const Term& term : terms_) places.push_back(term.place);
    values_.resize(std::max(values_.size(), static_cast<size_t>(numbers)));
    r.resize(rows);
    J.resize(rows, columns);
    jacobians_.assign(sizes.size(), nullptr);
    double* next = values_.data();
    for (const Term& term : terms_) {
      jacobians_[term.parameter] = next;
      next += rows * term.size;
    }
  }

  /// Fills J and r; false where they are not defined.
  bool Evaluate() {
    if (!residuals_->Evaluate(parameters_.data(), r.data(), jacobians_.data())) return false;
    Eigen::Index column = 0;
    for (const Term& term : terms_) {
      const double* const own = jacobians_[term.parameter];
      if (term.curved >= 0)
        J.middleCols(column, term.columns).noalias() =
            Eigen::Map<const RowMajor>(own, J.rows(), term.size) *
            plus_[static_cast<size_t>(term.curved)];
      else if (term.size == 3)  // nearly all of them
        J.middleCols<3>(column) = Eigen::Map<const RowMajor3>(own, J.rows(), 3);
      else
        J.middleCols(column, term.size) = Eigen::Map<const RowMajor>(own, J.rows(), term.size);
      column += term.columns;
    }
    const double squared_norm = r.squaredNorm();
    cost = residuals_->Cost(squared_norm);
    // Concave beyond its scale, the loss weighs as Ceres has it there: rho'' is left out.
    const double weight = residuals_->Weight(squared_norm);
    if (weight != 1.0) {
      J *= std::sqrt(weight);
      r *= std::sqrt(weight);
    }
    return r.allFinite() && J.allFinite();
  }

  /// The same with a parameter of the residuals moved by `step`.
  bool EvaluateMoved(int block, double step) {
    double*& at = parameters_[Parameter(block)];
    double* const here = at;
    double moved = *here + step;
    at = &moved;
    const bool is_defined = Evaluate();
    at = here;
    return is_defined;
  }

  /// J^T r, by the rows of J as they are stored.
  Eigen::VectorXd Score() const {
    Eigen::VectorXd score = Eigen::VectorXd::Zero(J.cols());
    for (Eigen::Index i = 0; i < J.rows(); ++i) score += r[i] * J.row(i).transpose();
    return score;
  }

  /// Column of a parameter in J; -1 when the residuals do not have it.
  Eigen::Index Column(int block) const {
    Eigen::Index column = 0;
    for (const Term& term : terms_) {
      if (blocks_[term.parameter] == block) return column;
      column += term.columns;
    }
    return -1;
  }

  std::vector<int> places;
  Eigen::VectorXd r;
  RowMajor J;
  double cost = 0.0;

 private:
  struct Term {
    int place;
    size_t parameter;  ///< of the cost function
    int size, columns, curved;
  };
  size_t Parameter(int block) const {
    return static_cast<size_t>(std::find(blocks_, blocks_ + parameters_.size(), block) - blocks_);
  }

  const NormalEquations& equations_;
  std::vector<Eigen::MatrixXd> plus_;  ///< derivatives of curved blocks by their steps
  const Problem::Residuals* residuals_ = nullptr;
  const int* blocks_ = nullptr;
  std::vector<double*> parameters_, jacobians_;
  std::vector<Term> terms_;
  std::vector<double> values_;
};

NormalEquations::NormalEquations(const Problem& problem,
                                 const std::vector<int>& border,
                                 const std::vector<int>& inner,
                                 std::vector<Equation> equations,
                                 size_t windows)
    : problem_(problem), blocks_(border), equations_(std::move(equations)) {
  blocks_.insert(blocks_.end(), inner.begin(), inner.end());
  std::stable_sort(equations_.begin(), equations_.end(), [](const Equation& a, const Equation& b) {
    return std::make_pair(a.session, a.t) < std::make_pair(b.session, b.t);
  });
  places_.resize(problem.blocks());
  std::vector<int> sizes;
  for (size_t b = 0; b < blocks_.size(); ++b) {
    const int block = blocks_[b];
    sizes.push_back(problem.TangentSize(block));
    Place& own = places_[static_cast<size_t>(block)];
    own = {static_cast<int>(b), sizes.back(), -1};
    if (problem.kind(block) == BlockKind::kVector) continue;
    own.curved = static_cast<int>(curved_.size());
    curved_.push_back(block);
  }
  std::vector<std::vector<int>> residuals(equations_.size());
  for (size_t k = 0; k < equations_.size(); ++k) {
    while (first_of_window_.size() <= static_cast<size_t>(equations_[k].window))
      first_of_window_.push_back(k);
    const Problem::Residuals& own = problem.residuals(equations_[k].block);
    const int* blocks = problem.BlocksOf(own);
    const size_t count = own.cost->parameter_block_sizes().size();
    residuals[k].reserve(count);
    for (size_t i = 0; i < count; ++i) {
      const int place = places_[static_cast<size_t>(blocks[i])].place;
      if (place >= 0) residuals[k].push_back(place);
    }
  }
  first_of_window_.resize(windows, equations_.size());
  elimination_ =
      std::make_shared<const Elimination>(sizes, border.size(), residuals, first_of_window_);
  for (const int block : blocks_) {
    int& place = places_[static_cast<size_t>(block)].place;
    place = elimination_->place(place);
  }
}

Panels NormalEquations::Assemble(size_t window,
                                 const std::vector<ExactColumn>& exact,
                                 double* cost) const {
  Panels panels;
  Linearisation at(*this);
  std::vector<double> memory;
  Eigen::VectorXd score;
  const size_t end =
      window + 1 < first_of_window_.size() ? first_of_window_[window + 1] : equations_.size();
  for (size_t k = first_of_window_[window]; k < end; ++k) {
    at.Start(equations_[k]);
    if (!at.Evaluate()) throw DataError("the residuals cannot be differentiated");
    if (cost != nullptr) *cost += at.cost;
    if (at.places.empty()) continue;  // of what is held
    const Eigen::Index columns = at.J.cols();
    memory.assign(static_cast<size_t>(columns * columns), 0.0);
    Eigen::Map<Eigen::MatrixXd> product(memory.data(), columns, columns);
    AddProduct(1.0, at.J.transpose(), at.J.transpose(), true, product);
    score = at.Score();
    elimination_->Add(at.places, product, &panels);
    elimination_->AddRhs(at.places, static_cast<int>(window), score, &panels);
    Eigen::VectorXd excess;  // of the exact column over that of J^T J
    Eigen::Index of = -1;
    for (const ExactColumn& parameter : exact) {
      const Eigen::Index column = at.Column(parameter.block);
      if (column < 0 || product(column, column) == 0.0) continue;
      if (of >= 0 && AreOpposite(product, of, column)) {
        excess = -excess;
      } else {
        Eigen::VectorXd linear(columns);  // that of J^T J
        linear << product.row(column).head(column).transpose(),
            product.col(column).tail(columns - column);
        of = -1;
        if (!at.EvaluateMoved(parameter.block, parameter.step)) continue;
        excess = (at.Score() - score) / parameter.step - linear;
      }
      of = column;
      elimination_->AddRhs(at.places, parameter.rhs, excess, &panels);
    }
  }
  return panels;
}

}  // namespace imu_pose_calib
