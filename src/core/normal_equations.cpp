#include "imu_pose_calib/core/normal_equations.h"

#include <ceres/cost_function.h>
#include <ceres/loss_function.h>

#include <algorithm>
#include <cmath>
#include <utility>

#include "imu_pose_calib/core/manifolds.h"
#include "imu_pose_calib/core/parallel.h"
#include "imu_pose_calib/core/types.h"

namespace imu_pose_calib {
namespace {

/// Residual blocks that a thread takes at a time.
constexpr size_t kPortion = 512;

}  // namespace

/// One residual block at a time, weighted by its loss; its columns in the order of elimination.
class NormalEquations::Linearisation {
 public:
  explicit Linearisation(const NormalEquations& equations) : equations_(equations) {
    for (const double* block : equations.curved_)
      plus_.push_back(PlusJacobian(equations.problem_, block));
  }

  void Start(const Equation& equation) {
    const ceres::Problem& problem = equations_.problem_;
    cost_ = problem.GetCostFunctionForResidualBlock(equation.block);
    loss_ = problem.GetLossFunctionForResidualBlock(equation.block);
    problem.GetParameterBlocksForResidualBlock(equation.block, &parameters_);
    terms_.clear();
    for (size_t k = 0; k < parameters_.size(); ++k) {
      const auto found = equations_.places_.find(parameters_[k]);
      if (found != equations_.places_.end()) terms_.push_back({&found->second, k});
    }
    std::sort(terms_.begin(), terms_.end(), [](const Term& a, const Term& b) {
      return a.at->place < b.at->place;
    });
    places.clear();
    Eigen::Index columns = 0, numbers = 0;
    for (const Term& term : terms_) {
      places.push_back(term.at->place);
      columns += term.at->size;
      numbers += cost_->num_residuals() * cost_->parameter_block_sizes()[term.parameter];
    }
    r.resize(cost_->num_residuals());
    J.resize(cost_->num_residuals(), columns);
    values_.resize(static_cast<size_t>(numbers));
  }

  /// Fills J and r; false where they are not defined.
  bool Evaluate() {
    jacobians_.assign(parameters_.size(), nullptr);
    double* next = values_.data();
    for (const Term& term : terms_) {
      jacobians_[term.parameter] = next;
      next += J.rows() * cost_->parameter_block_sizes()[term.parameter];
    }
    if (!cost_->Evaluate(parameters_.data(), r.data(), jacobians_.data())) return false;
    Eigen::Index column = 0;
    for (const Term& term : terms_) {
      const Eigen::Map<const Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>>
          own(jacobians_[term.parameter], J.rows(), cost_->parameter_block_sizes()[term.parameter]);
      if (term.at->curved < 0)
        J.middleCols(column, term.at->size) = own;
      else
        J.middleCols(column, term.at->size).noalias() =
            own * plus_[static_cast<size_t>(term.at->curved)];
      column += term.at->size;
    }
    if (loss_ != nullptr) {  // concave beyond its scale, as Ceres takes it there: rho'' is left out
      double rho[3];
      loss_->Evaluate(r.squaredNorm(), rho);
      J *= std::sqrt(rho[1]);
      r *= std::sqrt(rho[1]);
    }
    return r.allFinite() && J.allFinite();
  }

  /// The same with a parameter moved by `step`, unless the block does not have it.
  bool EvaluateMoved(const double* parameter, double step) {
    const auto found = std::find(parameters_.begin(), parameters_.end(), parameter);
    double moved = *parameter + step;
    *found = &moved;
    const bool is_defined = Evaluate();
    *found = const_cast<double*>(parameter);
    return is_defined;
  }

  /// Its column in J; -1 when the block does not have it.
  Eigen::Index Column(const double* parameter) const {
    Eigen::Index column = 0;
    for (const Term& term : terms_) {
      if (parameters_[term.parameter] == parameter) return column;
      column += term.at->size;
    }
    return -1;
  }

  std::vector<int> places;
  Eigen::MatrixXd J;
  Eigen::VectorXd r;

 private:
  struct Term {
    const Place* at;
    size_t parameter;  ///< of the cost function
  };
  const NormalEquations& equations_;
  std::vector<Eigen::MatrixXd> plus_;  ///< derivatives of curved blocks by their steps
  const ceres::CostFunction* cost_ = nullptr;
  const ceres::LossFunction* loss_ = nullptr;
  std::vector<double*> parameters_, jacobians_;
  std::vector<Term> terms_;
  std::vector<double> values_;
};

NormalEquations::NormalEquations(const ceres::Problem& problem,
                                 const std::vector<double*>& border,
                                 const std::vector<double*>& inner,
                                 std::vector<Equation> equations,
                                 int threads)
    : problem_(problem), threads_(threads), blocks_(border), equations_(std::move(equations)) {
  blocks_.insert(blocks_.end(), inner.begin(), inner.end());
  std::stable_sort(equations_.begin(), equations_.end(), [](const Equation& a, const Equation& b) {
    return std::make_pair(a.session, a.t) < std::make_pair(b.session, b.t);
  });
  std::vector<int> sizes;
  for (size_t b = 0; b < blocks_.size(); ++b) {
    sizes.push_back(TangentSize(problem, blocks_[b]));
    const bool is_curved = problem.ParameterBlockSize(blocks_[b]) != sizes.back();
    places_.emplace(
        blocks_[b],
        Place{
            static_cast<int>(b), sizes.back(), is_curved ? static_cast<int>(curved_.size()) : -1});
    if (is_curved) curved_.push_back(blocks_[b]);
  }
  std::vector<std::vector<int>> residuals;
  std::vector<size_t> first_of_session;
  std::vector<double*> parameters;
  for (size_t k = 0; k < equations_.size(); ++k) {
    if (k > 0 && equations_[k].session != equations_[k - 1].session) first_of_session.push_back(k);
    problem.GetParameterBlocksForResidualBlock(equations_[k].block, &parameters);
    residuals.emplace_back();
    for (const double* block : parameters) {
      const auto found = places_.find(block);
      if (found != places_.end()) residuals.back().push_back(found->second.place);
    }
  }
  elimination_ =
      std::make_shared<const Elimination>(sizes, border.size(), residuals, first_of_session);
  for (auto& [block, place] : places_) place.place = elimination_->place(place.place);
}

std::vector<Panels> NormalEquations::Assemble(int clusters,
                                              const std::vector<ExactColumn>& exact) const {
  std::vector<size_t> begins;
  for (size_t k = 0; k < equations_.size(); ++k)
    if (k == 0 || k - begins.back() == kPortion ||
        equations_[k].cluster != equations_[k - 1].cluster)
      begins.push_back(k);
  std::vector<Panels> portions(begins.size());
  InParallel(threads_, begins.size(), [&](size_t p) {
    Linearisation at(*this);
    Eigen::MatrixXd product;
    Eigen::VectorXd score, moved;
    const size_t end = p + 1 < begins.size() ? begins[p + 1] : equations_.size();
    for (size_t k = begins[p]; k < end; ++k) {
      at.Start(equations_[k]);
      if (at.places.empty()) continue;
      if (!at.Evaluate()) throw DataError("the residuals cannot be differentiated");
      product.noalias() = at.J.transpose() * at.J;
      score.noalias() = at.J.transpose() * at.r;
      elimination_->Add(at.places, product, &portions[p]);
      elimination_->AddRhs(at.places, equations_[k].cluster, score, &portions[p]);
      for (const ExactColumn& parameter : exact) {
        const Eigen::Index column = at.Column(parameter.data);
        if (column < 0 || product(column, column) == 0.0) continue;
        if (!at.EvaluateMoved(parameter.data, parameter.step)) continue;
        moved.noalias() = at.J.transpose() * at.r;
        elimination_->AddRhs(at.places,
                             parameter.rhs,
                             (moved - score) / parameter.step - product.col(column),
                             &portions[p]);
      }
    }
  });
  std::vector<Panels> all(static_cast<size_t>(clusters));
  for (size_t p = 0; p < begins.size(); ++p)
    Elimination::Merge(std::move(portions[p]),
                       &all[static_cast<size_t>(equations_[begins[p]].cluster)]);
  return all;
}

}  // namespace imu_pose_calib
