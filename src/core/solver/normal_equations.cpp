#include "imu_pose_calib/core/solver/normal_equations.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <utility>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/parallel.h"
#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {
namespace {

using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

}  // namespace

/// One residual block at a time, weighted by its loss; its columns in the order of elimination.
class NormalEquations::Linearisation {
 public:
  explicit Linearisation(const NormalEquations& equations) : equations_(equations) {}

  void Start(const Equation& equation) {
    const Problem& problem = equations_.problem_;
    residuals_ = &problem.residuals(equation.block);
    blocks_ = problem.BlocksOf(*residuals_);
    const std::vector<int32_t>& sizes = residuals_->cost->parameter_block_sizes();
    const int rows = residuals_->rows();
    parameters_.resize(sizes.size());
    jacobians_.assign(sizes.size(), nullptr);
    terms_.clear();
    int columns = 0, ambient = 0;
    for (size_t k = 0; k < sizes.size(); ++k) {
      parameters_[k] = problem.data(blocks_[k]);
      const int place = equations_.place_[static_cast<size_t>(blocks_[k])];
      if (place < 0) continue;
      terms_.push_back({place, k, sizes[k], problem.TangentSize(blocks_[k])});
      columns += terms_.back().columns;
      ambient += sizes[k];
    }
    std::sort(terms_.begin(), terms_.end(),
              [](const Term& a, const Term& b) { return a.place < b.place; });
    places.clear();
    r.resize(rows);
    J.resize(rows, columns);
    values_.resize(std::max(values_.size(), static_cast<size_t>(rows * ambient)));
    double* next = values_.data();
    for (const Term& term : terms_) {
      places.push_back(term.place);
      jacobians_[term.parameter] = std::exchange(next, next + rows * term.size);
    }
  }

  /// Fills J and r; false where they are not defined.
  bool Evaluate() {
    if (!residuals_->Evaluate(parameters_.data(), r.data(), jacobians_.data())) return false;
    Eigen::Index column = 0;
    for (const Term& term : terms_) {
      const Eigen::Map<const RowMajor> own(jacobians_[term.parameter], r.size(), term.size);
      if (term.columns < term.size)
        J.middleCols(column, term.columns) = own * PlusJacobian(parameters_[term.parameter]);
      else
        J.middleCols(column, term.columns) = own;
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

  /// J^T r, by the rows of J as they are stored.
  Eigen::VectorXd Score() const {
    Eigen::VectorXd score = Eigen::VectorXd::Zero(J.cols());
    for (Eigen::Index i = 0; i < J.rows(); ++i) score += r[i] * J.row(i).transpose();
    return score;
  }

  std::vector<int> places;
  Eigen::VectorXd r;
  RowMajor J;
  double cost = 0.0;

 private:
  struct Term {
    int place;
    size_t parameter;  ///< of the cost function
    int size, columns;
  };

  const NormalEquations& equations_;
  const Problem::Residuals* residuals_ = nullptr;
  const int* blocks_ = nullptr;
  std::vector<const double*> parameters_;
  std::vector<double*> jacobians_;
  std::vector<Term> terms_;
  std::vector<double> values_;  ///< of the Jacobians as the cost function has them
};

NormalEquations::NormalEquations(const Problem& problem, const std::vector<int>& border,
                                 const std::vector<int>& inner, std::vector<Equation> equations,
                                 size_t windows)
    : problem_(problem), blocks_(border), equations_(std::move(equations)) {
  blocks_.insert(blocks_.end(), inner.begin(), inner.end());
  const auto is_before = [](const Equation& a, const Equation& b) {
    return a.session != b.session ? a.session < b.session : a.t < b.t;
  };
  // Those of a sensor are in order of time already.
  const auto begin = equations_.begin(), end = equations_.end();
  for (auto next = std::is_sorted_until(begin, end, is_before); next != end;) {
    const auto sorted = std::exchange(next, std::is_sorted_until(next, end, is_before));
    std::inplace_merge(begin, sorted, next, is_before);
  }
  std::vector<int> number(problem.blocks(), -1), sizes;  // among those that are estimated
  for (const int block : blocks_) {
    number[static_cast<size_t>(block)] = static_cast<int>(sizes.size());
    sizes.push_back(problem.TangentSize(block));
  }
  std::vector<std::vector<int>> residuals(equations_.size());
  for (size_t k = 0; k < equations_.size(); ++k) {
    while (first_of_window_.size() <= static_cast<size_t>(equations_[k].window))
      first_of_window_.push_back(k);
    const Problem::Residuals& own = problem.residuals(equations_[k].block);
    residuals[k].reserve(own.blocks());
    for (size_t i = 0; i < own.blocks(); ++i) {
      const int block = number[static_cast<size_t>(problem.BlocksOf(own)[i])];
      if (block >= 0) residuals[k].push_back(block);
    }
  }
  first_of_window_.resize(windows, equations_.size());
  elimination_ =
      std::make_shared<const Elimination>(sizes, border.size(), residuals, first_of_window_);
  for (const int block : number) place_.push_back(block < 0 ? -1 : elimination_->place(block));
}

Panels NormalEquations::Assemble(size_t window, double* cost) const {
  Panels panels;
  Linearisation at(*this);
  Eigen::MatrixXd product;
  const size_t end =
      window + 1 < first_of_window_.size() ? first_of_window_[window + 1] : equations_.size();
  for (size_t k = first_of_window_[window]; k < end; ++k) {
    at.Start(equations_[k]);
    if (!at.Evaluate()) throw DataError("the residuals cannot be differentiated");
    if (cost != nullptr) *cost += at.cost;
    if (at.places.empty()) continue;  // of what is held
    const Eigen::Index columns = at.J.cols();
    product.setZero(columns, columns);
    AddProduct(1.0, at.J.transpose(), at.J.transpose(), true, product);
    elimination_->Add(at.places, product, &panels);
    elimination_->AddRhs(at.places, static_cast<int>(window), at.Score(), &panels);
  }
  return panels;
}

EliminatedWindows::EliminatedWindows(std::shared_ptr<const Elimination> elimination,
                                     const Eigen::VectorXd& weights, double max_factor_mb,
                                     int threads, const Assemble& assemble)
    : elimination_(std::move(elimination)),
      weights_(weights),
      keeps_(elimination_->factor_mb() <= max_factor_mb),
      threads_(threads),
      factors_(static_cast<size_t>(elimination_->windows())),
      rests_(factors_.size()) {
  InParallel(threads, factors_.size(), [&](size_t w) {
    Panels own = assemble(w);
    rests_[w] = elimination_->EliminateWindow(static_cast<int>(w), weights_, keeps_, &own);
    if (keeps_) factors_[w] = std::move(own);
  });
}

Reduced EliminatedWindows::Reduce(const std::vector<int>& windows, bool keeps,
                                  Panels* shared) const {
  std::vector<const Rest*> rests;
  for (const int w : windows) rests.push_back(&rests_[static_cast<size_t>(w)]);
  return elimination_->Reduce(rests, weights_, keeps, shared);
}

Reduced EliminatedWindows::Reduce(const std::vector<int>& windows) const {
  Panels shared;
  return Reduce(windows, false, &shared);
}

Reduced EliminatedWindows::ReduceAll(Panels shared) {
  shared_factor_ = std::move(shared);
  return Reduce(Counted(rests_.size()), true, &shared_factor_);
}

void EliminatedWindows::SubstituteBack(const Assemble& assemble, Eigen::VectorXd* x) const {
  elimination_->SubstituteBack(shared_factor_, x);
  InParallel(threads_, factors_.size(), [&](size_t w) {
    if (keeps_) return elimination_->SubstituteBack(factors_[w], x);
    Panels own = assemble(w);
    elimination_->EliminateWindow(static_cast<int>(w), weights_, true, &own);
    elimination_->SubstituteBack(own, x);
  });
}

Panels EliminatedWindows::TakeFactor() {
  if (!keeps_) return {};
  Panels factor = std::move(shared_factor_);
  for (Panels& own : factors_) factor.merge(own);
  return factor;
}

std::vector<int> Counted(size_t count) {
  std::vector<int> numbers(count);
  std::iota(numbers.begin(), numbers.end(), 0);
  return numbers;
}

}  // namespace imu_pose_calib
