#include "imu_pose_calib/core/calibration/marginals.h"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/solver/covariance.h"

namespace imu_pose_calib {
namespace {

/// Whether the session has the IMU that the parameter is of, or any session's.
bool ActsIn(const Estimate& estimate, const Parameter& p, size_t session) {
  if (IsOfPoses(p.kind)) return true;
  return estimate.sessions[session].imus[p.imu].is_present &&
         (!IsOfSession(p.kind) || p.session == session);
}

/// What is reported, as functionals L of the parameters and back: what is calibrated with gravity
/// and mean biases. Turned to the units of the report by `basis`.
struct Functionals {
  Eigen::MatrixXd basis;  ///< rows: what is reported; columns: functionals

  /// Also lists the parameters in the result.
  Functionals(const Ordering& order, const LeastSquares& solved, Marginals* result) {
    int count = 0;
    const auto place = [&](const Parameter& p) {
      result->parameters.push_back({p, count});
      count += p.size;
    };
    const std::vector<SessionEstimate>& sessions = solved.estimate->sessions;
    for (const Parameter& p : order.calibrated) place(p);
    for (size_t s = 0; s < sessions.size() && solved.options.estimate_gravity; ++s)
      place({ParameterKind::kGravity, 0, s, 3, nullptr});
    for (size_t s = 0; s < sessions.size(); ++s) {
      for (size_t i = 0; i < sessions[s].imus.size(); ++i) {
        if (!sessions[s].imus[i].is_present) continue;
        place({ParameterKind::kGyroBias, i, s, 3, nullptr});
        place({ParameterKind::kAccelBias, i, s, 3, nullptr});
      }
    }
    // Ceres turns q_MI on the left by twice the step: to a rotation about the imu axes.
    basis = Eigen::MatrixXd::Identity(count, count);
    for (const PlacedParameter& p : result->parameters)
      if (p.parameter.kind == ParameterKind::kRotation)
        basis.block<3, 3>(p.place, p.place) =
            2.0 * solved.estimate->imus[p.parameter.imu].q_MI.toRotationMatrix().transpose();
  }

  /// Covariance of functionals to what is reported.
  Eigen::MatrixXd Spread(const Eigen::MatrixXd& C) const { return Propagate(basis, C); }
};

/// The half of its session that each window is in, 0 or 1: halves in which the IMUs turn as much
/// (their squared rates), since a rest tells nothing that could contradict.
std::vector<size_t> HalvesOfTurns(const LeastSquares& solved) {
  const Windows& windows = solved.windows;
  std::vector<double> turned(static_cast<size_t>(windows.count()), 0.0);
  std::vector<double> all(solved.sessions.size(), 0.0), before = all;
  for (size_t s = 0; s < solved.sessions.size(); ++s) {
    const PreparedSession& session = solved.sessions[s];
    for (size_t i = 0; i < session.data.imus.size(); ++i) {
      for (const TimedSample& sample : session.data.imus[i].gyro) {
        const double t = solved.estimate->sessions[s].imus[i].PoseTime(sample.t);
        if (!session.trajectory->Contains(t)) continue;
        const double own =
            sample.count * (sample.value - session.starts[i].gyro_bias).squaredNorm();
        turned[static_cast<size_t>(windows.Of(s, t))] += own;
        all[s] += own;
      }
    }
  }
  std::vector<size_t> halves;
  for (int w = 0; w < windows.count(); ++w) {
    const size_t s = windows.SessionOf(w);
    const double own = turned[static_cast<size_t>(w)];
    halves.push_back(before[s] + 0.5 * own < 0.5 * all[s] ? 0 : 1);
    before[s] += own;
  }
  return halves;
}

/// H and scores of the whole problem and of parts of it, when all but the border is eliminated.
class ReducedProblem {
 public:
  ReducedProblem(const LeastSquares& solved, const Linearisation& at);

  /// Of the functionals.
  MarginalEstimate Estimate(int functionals) const {
    MarginalEstimate all =
        EstimateMarginals(at_.reduced.Products(), solved_.windows.count(), functionals);
    const Eigen::MatrixXd prior = PriorOfCalibrated();  // with which the functionals begin
    const Eigen::Index n = prior.rows();
    all.known.head(n) = (prior * all.covariance.topLeftCorner(n, n)).diagonal();
    return all;
  }
  /// Part of the residuals: a half of every session, or a session.
  struct Part {
    Reduced reduced;
    std::vector<int> windows;
  };
  /// Of columns of what is calibrated by a part, all else that is calibrated or could be being
  /// known.
  MarginalEstimate EstimateOf(const Part& part, const std::vector<int>& columns) const;

  const std::vector<Part>& halves() const { return halves_; }
  const std::vector<Part>& sessions() const { return sessions_; }

 private:
  /// What is known beforehand of columns of the border: its part of H and of the gradient, and the
  /// window where it stands.
  struct Prior {
    std::vector<int> columns;
    int window;
    Eigen::MatrixXd H;
    Eigen::VectorXd gradient;

    void AddTo(Eigen::MatrixXd* all) const {
      for (size_t i = 0; i < columns.size(); ++i)
        for (size_t k = 0; k < columns.size(); ++k)
          (*all)(columns[i], columns[k]) +=
              H(static_cast<Eigen::Index>(i), static_cast<Eigen::Index>(k));
    }
  };
  std::vector<Prior> FindPriors() const;
  /// Their part of H.
  Eigen::MatrixXd PriorOfCalibrated() const;
  /// It counts in every part, not only where it stands.
  void AddPriors(Part* part) const;

  const LeastSquares& solved_;
  const Linearisation& at_;
  const Ordering& order_;
  const std::vector<Prior> priors_;
  std::vector<Part> halves_, sessions_;
};

ReducedProblem::ReducedProblem(const LeastSquares& solved, const Linearisation& at)
    : solved_(solved),
      at_(at),
      order_(at.order),
      priors_(FindPriors()),
      halves_(2),
      sessions_(solved.sessions.size()) {
  const std::vector<size_t> halves = HalvesOfTurns(solved);
  for (int w = 0; w < solved.windows.count(); ++w) {
    halves_[halves[static_cast<size_t>(w)]].windows.push_back(w);
    sessions_[solved.windows.SessionOf(w)].windows.push_back(w);
  }
  for (std::vector<Part>* parts : {&halves_, &sessions_}) {
    if (parts == &sessions_ && sessions_.size() == 1) continue;  // which is all
    for (Part& part : *parts) {
      part.reduced = at.windows->Reduce(part.windows);
      AddPriors(&part);
    }
  }
}

MarginalEstimate ReducedProblem::EstimateOf(const Part& part,
                                            const std::vector<int>& columns) const {
  std::vector<int> kept = columns;
  for (int column = order_.gravity; column < order_.biases; ++column)
    if (part.reduced.H(column, column) != 0.0) kept.push_back(column);
  MarginalEstimate estimate =
      Select(EstimateBorder(part.reduced, kept, part.windows), Counted(columns.size()));
  const Eigen::MatrixXd prior = Gather(PriorOfCalibrated(), columns, columns);
  estimate.known = (prior * estimate.covariance).diagonal();
  return estimate;
}

std::vector<ReducedProblem::Prior> ReducedProblem::FindPriors() const {
  using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  const Problem& problem = solved_.problem;
  std::map<int, int> columns;  // of the border's blocks
  int next = 0;
  for (const int block : order_.border) next = (columns[block] = next) + problem.TangentSize(block);
  std::vector<Prior> priors;
  for (const Equation& equation : solved_.equations) {
    const Problem::Residuals& residuals = problem.residuals(equation.block);
    const int* const blocks = problem.BlocksOf(residuals);
    // One of several parameters is of what is calibrated: others are steps of walks.
    const auto is_prior = [&](int block) {
      const auto found = columns.find(block);
      return found != columns.end() && (residuals.blocks() == 1 || found->second < order_.gravity);
    };
    if (!std::all_of(blocks, blocks + residuals.blocks(), is_prior)) continue;
    Prior prior{{}, equation.window, {}, {}};
    std::vector<const double*> parameters;
    std::vector<RowMajor> jacobians;
    std::vector<double*> pointers;
    for (int k = 0; k < static_cast<int>(residuals.blocks()); ++k) {
      parameters.push_back(problem.data(blocks[k]));
      jacobians.emplace_back(residuals.rows(), problem.TangentSize(blocks[k]));
      for (int i = 0; i < problem.TangentSize(blocks[k]); ++i)
        prior.columns.push_back(columns[blocks[k]] + i);
    }
    for (RowMajor& jacobian : jacobians) pointers.push_back(jacobian.data());
    Eigen::VectorXd r(residuals.rows());
    residuals.Evaluate(parameters.data(), r.data(), pointers.data());
    Eigen::MatrixXd J(r.size(), static_cast<Eigen::Index>(prior.columns.size()));
    Eigen::Index column = 0;
    for (const RowMajor& jacobian : jacobians) {
      J.middleCols(column, jacobian.cols()) = jacobian;
      column += jacobian.cols();
    }
    prior.H = J.transpose() * J;
    prior.gradient = J.transpose() * r;
    priors.push_back(std::move(prior));
  }
  return priors;
}

Eigen::MatrixXd ReducedProblem::PriorOfCalibrated() const {
  Eigen::MatrixXd H = Eigen::MatrixXd::Zero(order_.gravity, order_.gravity);
  for (const Prior& prior : priors_)
    if (prior.columns.front() < order_.gravity) prior.AddTo(&H);
  return H;
}

void ReducedProblem::AddPriors(Part* part) const {
  const std::vector<int>& windows = part->windows;
  for (const Prior& prior : priors_) {
    if (std::binary_search(windows.begin(), windows.end(), prior.window)) continue;
    const auto is_told = [&H = part->reduced.H](int column) { return H(column, column) != 0.0; };
    if (std::none_of(prior.columns.begin(), prior.columns.end(), is_told))
      continue;  // another session's
    prior.AddTo(&part->reduced.H);
    for (const int w : windows)
      for (size_t k = 0; k < prior.columns.size(); ++k)
        part->reduced.B(prior.columns[k], w) +=
            prior.gradient[static_cast<Eigen::Index>(k)] / static_cast<double>(windows.size());
  }
}

/// Marginals::inverse, of the factor, which is gone then.
std::shared_future<Panels> TakeInverse(const CalibrationOptions& options, Linearisation* at) {
  Panels factor = at->windows->TakeFactor();
  const Eigen::MatrixXd& H = at->reduced.H;
  const Eigen::MatrixXd border = SolvePositive(H, Eigen::MatrixXd::Identity(H.rows(), H.rows()));
  if (factor.empty() || !border.allFinite()) return {};
  const auto invert = [elimination = at->equations.elimination(), border,
                       threads = options.Threads()](Panels panels) {
    elimination->Invert(border, threads, &panels);
    return panels;
  };
  return std::async(std::launch::deferred, invert, std::move(factor)).share();
}

/// Share of the scores' degrees of freedom that the fit used up. Scores have as many dimensions per
/// cluster as there are parameters that act in it; the fit sets as many of them to 0 as it has
/// parameters.
double FittedShare(const Ordering& order, const LeastSquares& solved) {
  double dimensions = 0.0;
  for (size_t s = 0; s < solved.sessions.size(); ++s) {
    int local = solved.options.estimate_gravity ? 3 : 0;
    for (const ImuSessionEstimate& imu : solved.estimate->sessions[s].imus)
      if (imu.is_present) local += 6;
    for (const Parameter& p : order.calibrated)
      if (ActsIn(*solved.estimate, p, s)) local += p.size;
    dimensions += static_cast<double>(local * solved.windows.Count(s));
  }
  const int shared = order.walks - order.gravity;  // knots of clocks act in one cluster
  return std::min(kLargestFittedShare, static_cast<double>(order.gravity + shared) / dimensions);
}

/// A step that remains moves all clusters alike: that is no scatter.
Eigen::MatrixXd Sandwich(MarginalEstimate estimate, double fitted) {
  estimate.influence.colwise() -= estimate.influence.rowwise().mean().eval();
  return ClusterRobustCovariance(estimate, fitted);
}

/// The larger of model and sandwich.
Eigen::VectorXd LargerStd(const MarginalEstimate& estimate, double fitted) {
  return estimate.covariance.diagonal().cwiseMax(Sandwich(estimate, fitted).diagonal()).cwiseSqrt();
}

/// Columns of what is calibrated and acts in a session; of one IMU, with what is of the poses, or
/// of all for -1.
std::vector<int> Acting(const Ordering& order, const Estimate& estimate, size_t session, int imu) {
  std::vector<int> columns;
  int column = 0;
  for (const Parameter& p : order.calibrated) {
    const bool is_of_imu = imu < 0 || IsOfPoses(p.kind) || p.imu == static_cast<size_t>(imu);
    for (int k = 0; k < p.size; ++k, ++column)
      if (is_of_imu && ActsIn(estimate, p, session)) columns.push_back(column);
  }
  return columns;
}

/// The sandwich needs more clusters than parameters, so it is formed of each IMU with one session's
/// clock at a time; gravity and biases stand for themselves.
Eigen::MatrixXd RobustCovariance(const MarginalEstimate& marginal, const Ordering& order,
                                 const Estimate& estimate, double fitted) {
  Eigen::MatrixXd robust =
      Eigen::MatrixXd::Zero(marginal.covariance.rows(), marginal.covariance.cols());
  const auto add = [&](const std::vector<int>& places) {
    const Eigen::MatrixXd C = Sandwich(Select(marginal, places), fitted);
    for (size_t i = 0; i < places.size(); ++i)
      for (size_t j = 0; j < places.size(); ++j) {
        double& value = robust(places[i], places[j]);
        const double other = C(static_cast<Eigen::Index>(i), static_cast<Eigen::Index>(j));
        if (value == 0.0 || (i == j && other > value)) value = other;
      }
  };
  for (size_t s = 0; s < estimate.sessions.size(); ++s)
    for (size_t imu = 0; imu < estimate.imus.size(); ++imu)
      if (estimate.sessions[s].imus[imu].is_present)
        if (const auto own = Acting(order, estimate, s, static_cast<int>(imu)); !own.empty())
          add(own);
  for (int place = order.gravity; place < robust.rows(); ++place) add({place});
  return robust;
}

/// What the second halves say less what the first halves say; sigmas are those of T_MI and clocks:
/// what averages over time has no Gaussian prior, which one half of noisy rotations need not know.
void CompareHalves(const MarginalEstimate& first, const MarginalEstimate& second,
                   const Ordering& order, const Functionals& functionals, double fitted,
                   Marginals* result) {
  const Eigen::VectorXd difference = second.Step() - first.Step();
  const Eigen::VectorXd difference_std =
      (LargerStd(first, fitted).cwiseAbs2() + LargerStd(second, fitted).cwiseAbs2()).cwiseSqrt();
  result->halves_difference = functionals.basis.leftCols(difference.size()) * difference;
  const Eigen::VectorXd sigmas = difference.cwiseQuotient(difference_std).cwiseAbs();
  double largest = 0.0;
  Eigen::Index column = 0;
  for (const Parameter& p : order.calibrated) {
    if (p.kind <= ParameterKind::kClockDrift)
      largest = std::max(largest, sigmas.segment(column, p.size).maxCoeff());
    column += p.size;
  }
  result->halves_sigmas = std::isfinite(largest) ? largest : 0.0;
}

/// What each session says alone.
void FindSessions(const ReducedProblem& problem, const Ordering& order, const Estimate& estimate,
                  const Functionals& functionals, double fitted, const Eigen::VectorXd& step,
                  Marginals* result) {
  const size_t count = problem.sessions().size();
  if (count < 2 || result->parameters.empty()) return;
  for (size_t s = 0; s < count; ++s) {
    const std::vector<int> acting = Acting(order, estimate, s, -1);
    const MarginalEstimate own = problem.EstimateOf(problem.sessions()[s], acting);
    SessionMarginals session;
    session.places = acting;  // what is calibrated is reported first
    const Eigen::MatrixXd kept = Gather(functionals.basis, acting, acting);
    session.difference = kept * own.Step() - Gather(step, acting, {0});
    const Eigen::MatrixXd robust =
        own.covariance.allFinite() ? Sandwich(own, fitted) : own.covariance;
    const Eigen::MatrixXd model = Propagate(kept, own.covariance);
    const Eigen::VectorXd larger = Enlargement(model, Propagate(kept, robust));
    session.model_variance = model.diagonal();
    session.covariance = larger.asDiagonal() * model * larger.asDiagonal();
    result->sessions.push_back(session);
  }
}

}  // namespace

Marginals FindMarginals(LeastSquares* solved) {
  Marginals result;
  Linearisation at = solved->Linearise();
  const Ordering& order = at.order;
  const ReducedProblem problem(*solved, at);
  const Functionals functionals(order, *solved, &result);
  const MarginalEstimate marginal = problem.Estimate(static_cast<int>(functionals.basis.rows()));
  const Estimate& estimate = *solved->estimate;

  const double fitted = FittedShare(order, *solved);
  result.model = functionals.Spread(marginal.covariance);
  result.robust = functionals.Spread(result.model.allFinite()
                                         ? RobustCovariance(marginal, order, estimate, fitted)
                                         : marginal.covariance);
  const std::vector<int> calibrated = Counted(static_cast<size_t>(order.gravity));
  CompareHalves(problem.EstimateOf(problem.halves()[0], calibrated),
                problem.EstimateOf(problem.halves()[1], calibrated), order, functionals, fitted,
                &result);
  FindSessions(problem, order, estimate, functionals, fitted, functionals.basis * marginal.Step(),
               &result);
  result.elimination = at.equations.elimination();
  result.inverse = TakeInverse(solved->options, &at);
  result.calibrated_end = order.gravity;
  result.trajectory_begin = order.trajectory;
  return result;
}

int Marginals::Find(ParameterKind kind, size_t imu, size_t session) const {
  const bool is_of_imu = kind != ParameterKind::kGravity && !IsOfPoses(kind);
  const bool is_of_session = kind == ParameterKind::kGravity || kind == ParameterKind::kGyroBias ||
                             kind == ParameterKind::kAccelBias || IsOfSession(kind);
  for (const PlacedParameter& p : parameters)
    if (p.parameter.kind == kind && (!is_of_imu || p.parameter.imu == imu) &&
        (!is_of_session || p.parameter.session == session))
      return p.place;
  return -1;
}

Eigen::VectorXd Enlargement(const Eigen::MatrixXd& model, const Eigen::MatrixXd& robust) {
  Eigen::VectorXd factor = Eigen::VectorXd::Ones(model.rows());
  for (Eigen::Index i = 0; i < model.rows(); ++i)
    if (model(i, i) > 0.0) factor[i] = std::sqrt(std::max(1.0, robust(i, i) / model(i, i)));
  return factor;
}

}  // namespace imu_pose_calib
