#include "imu_pose_calib/core/reduced_problem.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>

#include "imu_pose_calib/core/parallel.h"

namespace imu_pose_calib {
namespace {

/// On each coordinate of the trajectory's corrections [1/m^2, 1/rad^2]: nothing beside any sample.
constexpr double kWeakInformation = 1.0;
/// Blocks of the cluster-robust covariance by default, and their least length [s].
constexpr double kCovarianceBlocks = 24.0;
constexpr double kShortestBlock = 2.0;
/// Beyond which the change of the gradient is looked for [s].
constexpr double kClockStep = 1e-6;
constexpr double kRounding = 1e-6;

/// Of a parameter that is not estimated.
bool IsHeld(const Parameter& p, const Marginals& marginals) {
  return std::none_of(marginals.shown.begin(), marginals.shown.end(), [&p](const Parameter& q) {
    return q.data == p.data;
  });
}

}  // namespace

std::vector<int> Counted(size_t count) {
  std::vector<int> numbers(count);
  std::iota(numbers.begin(), numbers.end(), 0);
  return numbers;
}

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
  trajectory = columns;
  for (const int block : solved->trajectory_blocks) add(block, &inner);
}

Clusters::Clusters(const LeastSquares& solved) {
  double total = 0.0;
  for (const SessionEstimate& session : solved.estimate->sessions) {
    double begin = std::numeric_limits<double>::infinity(), end = -begin;
    const size_t s = spans_.size();
    for (size_t i = 0; i < session.imus.size(); ++i) {
      if (!session.imus[i].is_present) continue;
      const ConditionedImu& imu = solved.sessions[s].data.imus[i];
      begin = std::min(begin,
                       session.imus[i].PoseTime(std::min(imu.gyro.front().t, imu.accel.front().t)));
      end =
          std::max(end, session.imus[i].PoseTime(std::max(imu.gyro.back().t, imu.accel.back().t)));
    }
    spans_.push_back({begin, end, 0, 0});
    total += end - begin;
  }
  block_s_ = solved.options.covariance_block_s > 0.0
                 ? solved.options.covariance_block_s
                 : std::max(kShortestBlock, total / kCovarianceBlocks);
  for (size_t s = 0; s < spans_.size(); ++s) {
    Span& span = spans_[s];
    span.first = static_cast<int>(part_.size());
    // Not by rounding: a last block of nothing, a middle on either side.
    const double blocks = (span.end - span.begin) / block_s_;
    span.count = std::max(1, static_cast<int>(std::ceil(blocks - kRounding)));
    const int middle = static_cast<int>(0.5 * blocks + kRounding);
    for (int k = 0; k < span.count; ++k)
      part_.push_back(static_cast<int>(2 * s) + (k < middle ? 0 : 1));
  }
}

int Clusters::Of(size_t session, double t) const {
  const Span& span = spans_[session];
  const int block = static_cast<int>(std::max(0.0, t - span.begin) / block_s_);
  return span.first + std::min(block, span.count - 1);
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
      for (int k = 0; k < 2; ++k) columns_.push_back(gravity++);
      place({ParameterKind::kGravity, 0, s, 3, nullptr},
            true,
            PlusJacobian(BlockKind::kSphere, 3, session.g_W.data()));
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

ReducedProblem::ReducedProblem(const Ordering& ordering,
                               const Clusters& clusters,
                               const Functionals& functionals,
                               LeastSquares* solved)
    : ordering_(ordering),
      clusters_(static_cast<int>(clusters.parts().size())),
      functionals_(functionals.count()) {
  std::vector<Equation> all = solved->Equations();
  for (Equation& equation : all) equation.cluster = clusters.Of(equation.session, equation.t);
  const NormalEquations equations(
      solved->problem, ordering.border, ordering.inner, std::move(all), solved->Threads());
  blocks_ = equations.blocks();
  elimination_ = equations.elimination();
  std::vector<ExactColumn> exact;
  for (const int clock : ordering.clock_blocks)
    exact.push_back({clock, kClockStep, RhsOfClock(exact.size())});
  std::vector<Panels> of_cluster = equations.Assemble(clusters_, exact);
  std::vector<Panels> parts(2 * solved->sessions.size());
  for (size_t w = 0; w < of_cluster.size(); ++w)
    Elimination::Merge(std::move(of_cluster[w]), &parts[static_cast<size_t>(clusters.parts()[w])]);
  const auto first_trajectory = static_cast<int>(blocks_.size() - solved->trajectory_blocks.size());
  for (Panels& part : parts)
    elimination_->VisitDiagonal(
        [&](int block, auto diagonal) {
          if (block >= first_trajectory) diagonal.array() += 0.5 * kWeakInformation;
        },
        &part);

  // The gradient is the sum of the scores.
  Eigen::VectorXd weights = Eigen::VectorXd::Zero(RhsOfClock(exact.size()));
  weights.head(clusters_).setOnes();
  std::vector<Reduced> reduced(parts.size());
  InParallel(solved->Threads(), parts.size(), [&](size_t k) {
    reduced[k] = elimination_->Eliminate(weights, false, &parts[k]);
  });
  for (size_t k = 2; k < parts.size(); ++k) reduced[k % 2].Add(reduced[k]);
  halves_ = {{reduced[0], {}, {}}, {reduced[1], {}, {}}};
  sessions_.resize(parts.size() / 2);
  for (int w = 0; w < clusters_; ++w) {
    const auto part = static_cast<size_t>(clusters.parts()[static_cast<size_t>(w)]);
    halves_[part % 2].clusters.push_back(w);
    sessions_[part / 2].clusters.push_back(w);
  }

  std::vector<Panels> totals;
  for (size_t k = 0; k < parts.size(); k += 2) {
    Elimination::Merge(std::move(parts[k + 1]), &parts[k]);
    totals.push_back(std::move(parts[k]));
    sessions_[k / 2].acting = ActingColumns(totals.back());
  }
  AddMeans(functionals, &totals);
  HalveClocks(&totals);
  InParallel(solved->Threads(), totals.size(), [&](size_t s) {
    sessions_[s].reduced = elimination_->Eliminate(weights, true, &totals[s]);
  });
  all_ = sessions_[0].reduced;
  for (size_t s = 1; s < sessions_.size(); ++s) all_.Add(sessions_[s].reduced);
  for (Panels& own : totals) Elimination::Merge(std::move(own), &factor_);
  factor_.rbegin()->second = {all_.H, {}};
  for (int f = 0; f < functionals_; ++f) {
    const int column = functionals.columns()[static_cast<size_t>(f)];
    if (column >= 0) all_.B(column, clusters_ + f) = 1.0;
  }
}

MarginalEstimates ReducedProblem::Estimate() const {
  return EstimateMarginals(all_.Products(), clusters_, functionals_, ordering_.clocks);
}

MarginalEstimate ReducedProblem::EstimateOf(const Part& part,
                                            const std::vector<int>& columns) const {
  std::vector<int> kept = columns;
  for (int column = ordering_.leading; column < ordering_.biases; ++column)
    if (part.reduced.H(column, column) != 0.0) kept.push_back(column);
  return Select(EstimateBorder(part.reduced, kept, part.clusters), Counted(columns.size()));
}

void ReducedProblem::FindStep(Marginals* result) {
  std::vector<int> kept;
  int column = 0;
  const auto keep = [&](int size, bool is_held) {
    for (int k = 0; k < size; ++k, ++column)
      if (!is_held) kept.push_back(column);
  };
  keep(ordering_.estimated, false);
  for (const Parameter& p : ordering_.possible) keep(p.size, IsHeld(p, *result));
  keep(ordering_.biases - ordering_.leading, false);
  const MarginalEstimate border =
      EstimateBorder(all_, kept, Counted(static_cast<size_t>(clusters_)));
  result->step = Eigen::VectorXd::Zero(ordering_.columns);
  if (border.covariance.allFinite()) {
    const Eigen::VectorXd step = border.Step();
    for (size_t k = 0; k < kept.size(); ++k)
      result->step[kept[k]] = step[static_cast<Eigen::Index>(k)];
    elimination_->SubstituteBack(factor_, &result->step);
  }
  result->blocks = std::move(blocks_);
  result->elimination = elimination_;
  result->factor = std::move(factor_);
}

std::vector<int> ReducedProblem::ActingColumns(const Panels& session) const {
  std::vector<int> columns;
  int block = 0, column = 0;
  for (const Parameter& p : ordering_.calibrated) {
    const bool acts = elimination_->ActsInside(block++, session);
    for (int k = 0; k < p.size; ++k, ++column)
      if (acts) columns.push_back(column);
  }
  return columns;
}

/// The means of bias knots.
void ReducedProblem::AddMeans(const Functionals& functionals, std::vector<Panels>* totals) const {
  auto block = static_cast<int>(ordering_.border.size());
  for (const Functionals::Mean& mean : functionals.means())
    for (size_t k = 0; k < mean.knots; ++k, ++block)
      for (int axis = 0; axis < 3; ++axis)
        elimination_->AddRhs({elimination_->place(block)},
                             clusters_ + mean.functional + axis,
                             Eigen::Vector3d::Unit(axis) / static_cast<double>(mean.knots),
                             &(*totals)[mean.session]);
}

/// What exact columns have in each other comes twice.
void ReducedProblem::HalveClocks(std::vector<Panels>* totals) const {
  for (Panels& session : *totals)
    for (auto& [number, rhs] : session.rbegin()->second.rhs)
      if (number >= RhsOfClock(0))
        for (const int column : ordering_.clocks) rhs[column] *= 0.5;
}

}  // namespace imu_pose_calib
