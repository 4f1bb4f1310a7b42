#include "imu_pose_calib/core/calibration/reduced_problem.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace imu_pose_calib {
namespace {

/// On each coordinate of the trajectory's corrections [1/m^2, 1/rad^2]: nothing beside any sample.
constexpr double kWeakInformation = 1.0;
/// Beyond which the change of the gradient is looked for [s].
constexpr double kClockStep = 1e-6;

}  // namespace

Ordering::Ordering(LeastSquares* solved) {
  const Problem& problem = solved->problem;
  for (const Parameter& p : CalibrationParameters(solved->estimate)) {
    if (problem.Find(p.data) < 0) continue;
    const bool is_estimated = problem.IsEstimated(p.data);
    if (!is_estimated && !IsHint(p.kind)) continue;
    (is_estimated ? calibrated : possible).push_back(p);
  }
  const auto add = [&](int block, std::vector<int>* blocks) {
    blocks->push_back(block);
    columns += problem.TangentSize(block);
  };
  for (const Parameter& p : calibrated) {
    if (p.kind == ParameterKind::kTimeShift || p.kind == ParameterKind::kAccelDelay) {
      clocks.push_back(columns);
      clock_blocks.push_back(problem.Find(p.data));
    }
    add(problem.Find(p.data), &border);
  }
  estimated = columns;
  for (const Parameter& p : possible) add(problem.Find(p.data), &border);
  leading = columns;
  for (SessionEstimate& session : solved->estimate->sessions)
    if (solved->options.estimate_gravity) add(problem.Find(session.g_W.data()), &border);
  biases = columns;
  for (const int block : solved->BiasBlocks()) add(block, &inner);
  walks = columns;
  for (const int block : solved->SlowBlocks()) add(block, &inner);
  trajectory = columns;
  for (const int block : solved->trajectory_blocks) add(block, &inner);
}

Functionals::Functionals(const Ordering& ordering, LeastSquares* solved, Marginals* result) {
  const auto place = [&](const Parameter& p, bool is_estimated, const Eigen::MatrixXd& basis) {
    result->parameters.push_back({p, size_, is_estimated});
    bases_.push_back({size_, count_, basis});
    size_ += p.size;
    count_ += static_cast<int>(basis.cols());
  };
  const auto place_leading = [&](const Parameter& p, bool is_estimated) {
    // Ceres turns q_MI on the left by twice the step: to a rotation about the imu axes.
    Eigen::MatrixXd basis = Eigen::MatrixXd::Identity(p.size, p.size);
    if (p.kind == ParameterKind::kRotation)
      basis = 2.0 * solved->estimate->imus[p.imu].q_MI.toRotationMatrix().transpose();
    for (int k = 0; k < p.size; ++k) columns_.push_back(leading_++);
    place(p, is_estimated, basis);
  };
  for (const Parameter& p : ordering.calibrated) place_leading(p, true);
  calibrated_ = count_;
  int gravity = ordering.leading;
  for (size_t s = 0; s < solved->estimate->sessions.size(); ++s) {
    SessionEstimate& session = solved->estimate->sessions[s];
    if (solved->options.estimate_gravity) {
      for (int k = 0; k < 3; ++k) columns_.push_back(gravity++);
      place({ParameterKind::kGravity, 0, s, 3, nullptr}, true, Eigen::Matrix3d::Identity());
    }
    for (size_t i = 0; i < session.imus.size(); ++i) {
      const auto place_mean = [&](ParameterKind kind, const BiasKnots& knots) {
        if (knots.values.empty()) return;
        for (int axis = 0; axis < 3; ++axis) columns_.push_back(-1);
        means_.push_back({s, count_, knots.values.size()});
        place({kind, i, s, 3, nullptr}, true, Eigen::Matrix3d::Identity());
      };
      place_mean(ParameterKind::kGyroBias, session.imus[i].gyro_bias);
      place_mean(ParameterKind::kAccelBias, session.imus[i].accel_bias);
    }
  }
  estimated_ = count_;
  for (const Parameter& p : ordering.possible) place_leading(p, false);
}

Eigen::MatrixXd Functionals::Spread(const Eigen::MatrixXd& C) const {
  const Eigen::MatrixXd T = Basis().leftCols(C.rows());
  return T * C * T.transpose();
}

Eigen::VectorXd Functionals::SpreadVector(const Eigen::VectorXd& x) const {
  return Basis().leftCols(x.size()) * x;
}

Eigen::MatrixXd Functionals::Basis() const {
  Eigen::MatrixXd T = Eigen::MatrixXd::Zero(size_, count_);
  for (const Block& b : bases_)
    T.block(b.place, b.functional, b.basis.rows(), b.basis.cols()) = b.basis;
  return T;
}

ReducedProblem::ReducedProblem(const Ordering& ordering, const Functionals& functionals,
                               LeastSquares* solved)
    : ordering_(ordering),
      windows_(solved->windows.count()),
      functionals_(functionals.count()),
      first_trajectory_(static_cast<int>(ordering.border.size() + ordering.inner.size()) -
                        static_cast<int>(solved->trajectory_blocks.size())),
      equations_(solved->problem, ordering.border, ordering.inner, solved->Equations(),
                 static_cast<size_t>(windows_)),
      elimination_(equations_.elimination()) {
  const auto count = static_cast<size_t>(windows_);
  std::vector<ExactColumn> exact;
  for (size_t k = 0; k < ordering.clock_blocks.size(); ++k)
    exact.push_back({ordering.clock_blocks[k], kClockStep, RhsOfClock(k)});
  // The gradient is the sum of the scores.
  weights_ = Eigen::VectorXd::Zero(RhsOfClock(exact.size()));
  weights_.head(windows_).setOnes();

  std::vector<std::vector<bool>> acts(count);  // blocks of what is calibrated
  eliminated_.emplace(elimination_, weights_, solved->options.max_factor_mb,
                      solved->options.Threads(), [&](size_t w) {
                        Panels own = Assemble(w, exact);
                        for (size_t b = 0; b < ordering.calibrated.size(); ++b)
                          acts[w].push_back(elimination_->ActsInside(static_cast<int>(b), own));
                        AddMeans(functionals, static_cast<int>(w), &own);
                        return own;
                      });
  halves_.resize(2);
  sessions_.resize(solved->sessions.size());
  for (int w = 0; w < windows_; ++w) {
    const Windows::Place at = solved->windows.PlaceOf(w);
    halves_[at.half].windows.push_back(w);
    sessions_[at.session].windows.push_back(w);
  }
  for (std::vector<Part>* parts : {&halves_, &sessions_}) {
    for (Part& part : *parts) {
      part.reduced = eliminated_->Reduce(part.windows);
      AddPriors(*solved, &part);
      int block = 0, column = 0;
      for (const Parameter& p : ordering.calibrated) {
        const bool is_acting = std::any_of(part.windows.begin(), part.windows.end(), [&](int w) {
          return acts[static_cast<size_t>(w)][static_cast<size_t>(block)];
        });
        for (int k = 0; k < p.size; ++k, ++column)
          if (is_acting) part.acting.push_back(column);
        ++block;
      }
    }
  }
  Panels means;
  AddMeans(functionals, windows_, &means);
  all_ = eliminated_->ReduceAll(std::move(means));
  for (int f = 0; f < functionals_; ++f) {
    const int column = functionals.columns()[static_cast<size_t>(f)];
    if (column >= 0) all_.B(column, windows_ + f) = 1.0;
  }
}

MarginalEstimates ReducedProblem::Estimate() const {
  return EstimateMarginals(all_.Products(), windows_, functionals_, ordering_.clocks);
}

MarginalEstimate ReducedProblem::EstimateOfBorder(const Functionals& functionals) const {
  std::vector<int> columns = functionals.columns();
  columns.erase(std::remove(columns.begin(), columns.end(), -1), columns.end());
  return EstimateBorder(all_, columns, Counted(static_cast<size_t>(windows_)));
}

MarginalEstimate ReducedProblem::EstimateOf(const Part& part,
                                            const std::vector<int>& columns) const {
  std::vector<int> kept = columns;
  for (int column = ordering_.leading; column < ordering_.biases; ++column)
    if (part.reduced.H(column, column) != 0.0) kept.push_back(column);
  return Select(EstimateBorder(part.reduced, kept, part.windows), Counted(columns.size()));
}

GaussNewtonStep ReducedProblem::FindStep() const {
  std::vector<int> kept;
  for (int column = 0; column < ordering_.biases; ++column)
    if (column < ordering_.estimated || column >= ordering_.leading) kept.push_back(column);
  const MarginalEstimate border =
      EstimateBorder(all_, kept, Counted(static_cast<size_t>(windows_)));
  GaussNewtonStep result{equations_.blocks(), Eigen::VectorXd::Zero(ordering_.columns)};
  if (!border.covariance.allFinite()) return result;
  const Eigen::VectorXd step = border.Step();
  for (size_t k = 0; k < kept.size(); ++k) result.x[kept[k]] = step[static_cast<Eigen::Index>(k)];
  eliminated_->SubstituteBack([this](size_t w) { return Assemble(w, {}); }, &result.x);
  return result;
}

Panels ReducedProblem::TakeFactor() {
  Panels factor = eliminated_->TakeFactor();
  if (!factor.empty()) factor.rbegin()->second = {all_.H, {}};
  return factor;
}

void ReducedProblem::AddPriors(const LeastSquares& solved, Part* part) const {
  const Problem& problem = solved.problem;
  for (const PriorBlock& prior : solved.priors) {
    const Problem::Residuals& residuals = problem.residuals(prior.block);
    const int window = solved.windows.Of(prior.session, prior.t),
              *blocks = problem.BlocksOf(residuals);
    const bool is_there =
        std::find(part->windows.begin(), part->windows.end(), window) != part->windows.end();
    if (is_there || residuals.cost->parameter_block_sizes().size() > 1) continue;
    const auto place = std::find(ordering_.border.begin(), ordering_.border.end(), blocks[0]);
    if (place == ordering_.border.end()) continue;
    int column = 0;
    for (auto block = ordering_.border.begin(); block != place; ++block)
      column += problem.TangentSize(*block);
    if (part->reduced.H(column, column) == 0.0) continue;  // of another session
    const int size = problem.TangentSize(*place);
    Eigen::VectorXd r(residuals.rows());
    Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor> J(r.size(), size);
    const double* parameters[] = {problem.data(blocks[0])};
    double* jacobians[] = {J.data()};
    residuals.Evaluate(parameters, r.data(), jacobians);
    part->reduced.H.block(column, column, size, size) += J.transpose() * J;
    const Eigen::VectorXd share = J.transpose() * r / static_cast<double>(part->windows.size());
    for (const int w : part->windows) part->reduced.B.col(w).segment(column, size) += share;
  }
}

Panels ReducedProblem::Assemble(size_t window, const std::vector<ExactColumn>& exact) const {
  Panels panels = equations_.Assemble(window, exact);
  elimination_->VisitDiagonal(
      [&](int block, auto diagonal) {
        if (block >= first_trajectory_) diagonal.array() += 0.5 * kWeakInformation;
      },
      &panels);
  return panels;
}

void ReducedProblem::AddMeans(const Functionals& functionals, int window, Panels* panels) const {
  auto block = static_cast<int>(ordering_.border.size());
  for (const Functionals::Mean& mean : functionals.means())
    for (size_t k = 0; k < mean.knots; ++k, ++block)
      for (int axis = 0; axis < 3 && elimination_->WindowOf(block) == window; ++axis)
        elimination_->AddRhs({elimination_->place(block)}, windows_ + mean.functional + axis,
                             Eigen::Vector3d::Unit(axis) / static_cast<double>(mean.knots), panels);
}

}  // namespace imu_pose_calib
