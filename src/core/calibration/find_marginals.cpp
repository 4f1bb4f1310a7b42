#include "imu_pose_calib/core/calibration/find_marginals.h"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>

#include "imu_pose_calib/core/calibration/reduced_problem.h"

namespace imu_pose_calib {
namespace {

/// Whether the session has the IMU that the parameter is of, or any session's.
bool ActsIn(const Estimate& estimate, const Parameter& p, size_t session) {
  if (IsOfPoses(p.kind)) return true;
  return estimate.sessions[session].imus[p.imu].is_present &&
         (!IsOfSession(p.kind) || p.session == session);
}

/// Share of the scores' degrees of freedom that the fit used up. Scores have as many dimensions per
/// cluster as there are parameters that act in it; the fit sets as many of them to 0 as it has
/// parameters.
double FittedShare(const Ordering& ordering, const LeastSquares& solved) {
  double dimensions = 0.0;
  for (size_t s = 0; s < solved.sessions.size(); ++s) {
    int local = solved.options.estimate_gravity ? 3 : 0;
    for (const ImuSessionEstimate& imu : solved.estimate->sessions[s].imus)
      if (imu.is_present) local += 6;
    for (const Parameter& p : ordering.calibrated)
      if (ActsIn(*solved.estimate, p, s)) local += p.size;
    dimensions += static_cast<double>(local * solved.windows.Count(s));
  }
  const int shared = ordering.walks - ordering.leading;  // knots of clocks act in one cluster
  return std::min(kLargestFittedShare,
                  static_cast<double>(ordering.estimated + shared) / dimensions);
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

/// The sandwich needs more clusters than parameters, so it is formed of each IMU with one session's
/// clock at a time; gravity and biases stand for themselves.
Eigen::MatrixXd RobustCovariance(const MarginalEstimate& exact, const Ordering& ordering,
                                 const Estimate& estimate, double fitted) {
  Eigen::MatrixXd robust = Eigen::MatrixXd::Zero(exact.covariance.rows(), exact.covariance.cols());
  const auto add = [&](const std::vector<int>& places) {
    const Eigen::MatrixXd C = Sandwich(Select(exact, places), fitted);
    for (size_t i = 0; i < places.size(); ++i)
      for (size_t j = 0; j < places.size(); ++j) {
        double& value = robust(places[i], places[j]);
        const double other = C(static_cast<Eigen::Index>(i), static_cast<Eigen::Index>(j));
        if (value == 0.0 || (i == j && other > value)) value = other;
      }
  };
  for (size_t s = 0; s < estimate.sessions.size(); ++s) {
    for (size_t imu = 0; imu < estimate.imus.size(); ++imu) {
      if (!estimate.sessions[s].imus[imu].is_present) continue;
      std::vector<int> places;
      int place = 0;
      for (const Parameter& p : ordering.calibrated) {
        const bool is_of_imu = IsOfPoses(p.kind) || p.imu == imu;
        if (is_of_imu && ActsIn(estimate, p, s))
          for (int k = 0; k < p.size; ++k) places.push_back(place + k);
        place += p.size;
      }
      if (!places.empty()) add(places);
    }
  }
  for (int place = ordering.estimated; place < robust.rows(); ++place) add({place});
  return robust;
}

/// What the second halves say less what the first halves say.
void CompareHalves(const MarginalEstimate& first, const MarginalEstimate& second,
                   const Functionals& functionals, double fitted, Marginals* result) {
  const Eigen::VectorXd difference = second.Step() - first.Step();
  const Eigen::VectorXd difference_std =
      (LargerStd(first, fitted).cwiseAbs2() + LargerStd(second, fitted).cwiseAbs2()).cwiseSqrt();
  result->halves_difference = functionals.SpreadVector(difference);
  const double largest =
      difference.size() > 0 ? difference.cwiseQuotient(difference_std).cwiseAbs().maxCoeff() : 0.0;
  result->halves_sigmas = std::isfinite(largest) ? largest : 0.0;
}

/// Where parameters that are held would move to.
void FindHints(const MarginalEstimate& all, const Functionals& functionals, double fitted,
               Marginals* result) {
  // A parameter that is missing makes blocks differ slowly, as drift does: that is no scatter.
  std::vector<int> leading = Counted(static_cast<size_t>(all.covariance.rows()));
  const auto held = functionals.count() - functionals.estimated();
  leading.erase(leading.begin() + functionals.calibrated(), leading.end() - held);
  MarginalEstimate neighbours = Select(all, leading);
  const Eigen::MatrixXd influence = neighbours.influence;
  neighbours.influence =
      (influence.rightCols(influence.cols() - 1) - influence.leftCols(influence.cols() - 1)) /
      std::sqrt(2.0);
  const Eigen::VectorXd std_dev = LargerStd(neighbours, fitted);
  const Eigen::VectorXd step = all.Step();
  result->hint = Eigen::VectorXd::Zero(functionals.size());
  result->hint_std = Eigen::VectorXd::Zero(functionals.size());
  // Held parameters are reported as they are, and last.
  result->hint.tail(held) = step.tail(held);
  result->hint_std.tail(held) = std_dev.tail(held);
}

/// What each session says alone.
void FindSessions(const ReducedProblem& problem, const Functionals& functionals, double fitted,
                  const Eigen::VectorXd& step, Marginals* result) {
  const size_t count = result->parameters.empty() ? 0 : problem.sessions().size();
  if (count < 2) return;
  for (size_t s = 0; s < count; ++s) {
    const std::vector<int>& acting = problem.sessions()[s].acting;
    const auto estimated = static_cast<Eigen::Index>(acting.size());
    const MarginalEstimate own = problem.EstimateOf(problem.sessions()[s], acting);
    SessionMarginals session;
    // To the places of the functionals, all others being left out.
    const Eigen::MatrixXd T = functionals.Basis();
    Eigen::MatrixXd to_report(T.rows(), estimated);
    for (Eigen::Index k = 0; k < estimated; ++k)
      to_report.col(k) = T.col(acting[static_cast<size_t>(k)]);
    for (Eigen::Index place = 0; place < T.rows(); ++place)
      if (!to_report.row(place).isZero(0.0)) session.places.push_back(static_cast<int>(place));
    Eigen::MatrixXd kept(static_cast<Eigen::Index>(session.places.size()), estimated);
    Eigen::VectorXd common(kept.rows());
    for (Eigen::Index k = 0; k < kept.rows(); ++k) {
      kept.row(k) = to_report.row(session.places[static_cast<size_t>(k)]);
      common[k] = step[session.places[static_cast<size_t>(k)]];
    }
    session.difference = kept * own.Step() - common;
    const Eigen::MatrixXd robust =
        own.covariance.allFinite() ? Sandwich(own, fitted) : own.covariance;
    const Eigen::MatrixXd model = kept * own.covariance * kept.transpose();
    const Eigen::VectorXd larger = Enlargement(model, kept * robust * kept.transpose());
    session.model_variance = model.diagonal();
    session.covariance = larger.asDiagonal() * model * larger.asDiagonal();
    result->sessions.push_back(session);
  }
}

}  // namespace

Marginals FindMarginals(LeastSquares* solved) {
  Marginals result;
  const Ordering ordering(solved);
  const Functionals functionals(ordering, solved, &result);
  ReducedProblem problem(ordering, functionals, solved);
  const MarginalEstimates estimates = problem.Estimate();

  const double fitted = FittedShare(ordering, *solved);
  const MarginalEstimate marginal = GivenOthers(estimates.gauss_newton, functionals.estimated());
  result.model = functionals.Spread(marginal.covariance);
  result.robust = functionals.Spread(
      result.model.allFinite()
          ? RobustCovariance(GivenOthers(estimates.exact, functionals.estimated()), ordering,
                             *solved->estimate, fitted)
          : marginal.covariance);
  result.spurious_information = solved->spurious_information;
  const std::vector<int> calibrated = Counted(static_cast<size_t>(ordering.estimated));
  CompareHalves(problem.EstimateOf(problem.halves()[0], calibrated),
                problem.EstimateOf(problem.halves()[1], calibrated), functionals, fitted, &result);
  FindHints(problem.EstimateOfBorder(functionals), functionals, fitted, &result);

  result.step = problem.FindStep();
  result.elimination = problem.elimination();
  result.factor = problem.TakeFactor();
  result.held_begin = ordering.estimated;
  result.held_end = ordering.leading;
  result.trajectory_begin = ordering.trajectory;
  FindSessions(problem, functionals, fitted, functionals.SpreadVector(marginal.Step()), &result);
  return result;
}

}  // namespace imu_pose_calib
