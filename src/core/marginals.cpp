#include "imu_pose_calib/core/marginals.h"

#include <ceres/cost_function.h>

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <future>
#include <limits>
#include <numeric>

#include "imu_pose_calib/core/covariance.h"
#include "imu_pose_calib/core/manifolds.h"

namespace imu_pose_calib {
namespace {

using SparseMatrix = Eigen::SparseMatrix<double>;

/// On each coordinate of the trajectory's corrections [1/m^2, 1/rad^2]: nothing beside any sample.
constexpr double kWeakInformation = 1.0;
/// Blocks of the cluster-robust covariance by default, and their least length [s].
constexpr double kCovarianceBlocks = 24.0;
constexpr double kShortestBlock = 2.0;
/// Rows of the Jacobian that are held at a time.
constexpr size_t kPortionRows = 100000;
/// Beyond which the change of the gradient is looked for [s].
constexpr double kClockStep = 1e-6;
/// From which one matrix is factorised at a time.
constexpr int kManyColumns = 100000;
constexpr double kRounding = 1e-6;
/// Of its sigma: the size effect of an IMU that shows it.
constexpr double kShown = 4.0;

/// Of one session alone.
bool IsOfSession(const Parameter& p) {
  return p.kind == ParameterKind::kTimeShift || p.kind == ParameterKind::kClockDrift;
}

/// Parameter blocks in the order of H: what is calibrated, what could have been, all others.
struct Ordering {
  std::vector<double*> blocks;
  std::vector<int> column;  ///< first of each block
  int columns = 0;
  int estimated = 0, leading = 0;  ///< columns of what is calibrated, with what could have been
  int trajectory = 0;              ///< first column of the trajectory
  std::vector<Parameter> calibrated, possible;
  std::vector<std::pair<double*, int>> clocks;  ///< that are estimated, and their columns

  explicit Ordering(LeastSquares* solved) {
    ceres::Problem& problem = solved->problem;
    for (const Parameter& p : CalibrationParameters(solved->estimate)) {
      if (!problem.HasParameterBlock(p.data)) continue;
      const bool is_estimated = !problem.IsParameterBlockConstant(p.data);
      if (!is_estimated && !IsHint(p.kind)) continue;
      (is_estimated ? calibrated : possible).push_back(p);
    }
    for (const Parameter& p : calibrated) {
      if (p.kind == ParameterKind::kTimeShift || p.kind == ParameterKind::kAccelDelay)
        clocks.emplace_back(p.data, columns);
      Add(problem, p.data);
    }
    estimated = columns;
    for (const Parameter& p : possible) {
      problem.SetParameterBlockVariable(p.data);
      Add(problem, p.data);
    }
    leading = columns;
    for (SessionEstimate& session : solved->estimate->sessions) {
      if (solved->options.estimate_gravity) Add(problem, session.g_W.data());
      for (ImuSessionEstimate& imu : session.imus)
        for (BiasKnots* knots : {&imu.gyro_bias, &imu.accel_bias})
          for (Eigen::Vector3d& value : knots->values) Add(problem, value.data());
    }
    trajectory = columns;
    for (double* block : solved->trajectory_blocks) Add(problem, block);
  }

 private:
  void Add(const ceres::Problem& problem, double* block) {
    blocks.push_back(block);
    column.push_back(columns);
    columns += TangentSize(problem, block);
  }
};

/// Time blocks whose scores are summed up, and the half of a session that they belong to: part
/// 2 s + 0 or 1.
class Clusters {
 public:
  explicit Clusters(const LeastSquares& solved) {
    double total = 0.0;
    for (const SessionEstimate& session : solved.estimate->sessions) {
      double begin = std::numeric_limits<double>::infinity(), end = -begin;
      const size_t s = spans_.size();
      for (size_t i = 0; i < session.imus.size(); ++i) {
        if (!session.imus[i].is_present) continue;
        const ConditionedImu& imu = solved.sessions[s].data.imus[i];
        begin = std::min(
            begin, session.imus[i].PoseTime(std::min(imu.gyro.front().t, imu.accel.front().t)));
        end = std::max(end,
                       session.imus[i].PoseTime(std::max(imu.gyro.back().t, imu.accel.back().t)));
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

  /// Cluster of an instant t [s, pose clock].
  int Of(size_t session, double t) const {
    const Span& span = spans_[session];
    const int block = static_cast<int>(std::max(0.0, t - span.begin) / block_s_);
    return span.first + std::min(block, span.count - 1);
  }
  const std::vector<int>& parts() const { return part_; }
  /// Of all sessions' first (0) or second (1) halves.
  std::vector<int> Half(int half) const {
    std::vector<int> parts;
    for (size_t s = 0; s < spans_.size(); ++s) parts.push_back(static_cast<int>(2 * s) + half);
    return parts;
  }
  int Count(size_t session) const { return spans_[session].count; }

 private:
  struct Span {
    double begin, end;
    int first, count;
  };
  std::vector<Span> spans_;
  std::vector<int> part_;
  double block_s_;
};

/// H and the scores of the clusters, in portions, so that the Jacobian is never there as a whole.
MarginalEstimator Accumulate(const Ordering& ordering,
                             const Clusters& clusters,
                             LeastSquares* solved) {
  MarginalEstimator estimator(ordering.columns, ordering.leading, clusters.parts());
  ceres::Problem::EvaluateOptions evaluate;
  evaluate.num_threads = solved->Threads();
  evaluate.parameter_blocks = ordering.blocks;
  std::vector<int> cluster;  // of each row
  const auto add_portion = [&] {
    if (cluster.empty()) return;  // Ceres takes no blocks for all
    std::vector<double> residuals;
    ceres::CRSMatrix jacobian;
    if (!solved->problem.Evaluate(evaluate, nullptr, &residuals, nullptr, &jacobian))
      throw DataError("the residuals cannot be differentiated where the solve ended");
    estimator.Add(jacobian, residuals, cluster);
    for (const auto& [clock, column] : ordering.clocks)
      estimator.AddCurvature(
          column,
          Curvature(&solved->problem, evaluate, jacobian, residuals, clock, column, kClockStep));
    evaluate.residual_blocks.clear();
    cluster.clear();
  };
  const auto add = [&](ceres::ResidualBlockId block, size_t session, double t) {
    const int rows = solved->problem.GetCostFunctionForResidualBlock(block)->num_residuals();
    evaluate.residual_blocks.push_back(block);
    cluster.insert(cluster.end(), static_cast<size_t>(rows), clusters.Of(session, t));
    if (cluster.size() > kPortionRows) add_portion();
  };
  for (const SensorBlocks& sensor : solved->sensors)
    for (size_t i = 0; i < sensor.blocks.size(); ++i)
      add(sensor.blocks[i], sensor.model->session, sensor.block_t[i]);
  for (const PriorBlock& prior : solved->priors) add(prior.block, prior.session, prior.t);
  add_portion();
  estimator.AddPrior(ordering.trajectory, kWeakInformation);
  return estimator;
}

/// What is reported, as functionals L of the parameters and back: the leading parameters with
/// gravity and mean biases between those that are estimated and those that could have been.
class Report {
 public:
  Report(const Ordering& ordering, LeastSquares* solved, Marginals* result) {
    std::vector<Eigen::Triplet<double>> L;
    const auto place = [&](const Parameter& p, bool is_estimated, const Eigen::MatrixXd& basis) {
      result->parameters.push_back({p, size_, is_estimated});
      bases_.push_back({size_, functionals_, basis});
      size_ += p.size;
      functionals_ += static_cast<int>(basis.cols());
    };
    const auto place_leading = [&](const Parameter& p, bool is_estimated) {
      // Ceres turns q_MI on the left by twice the step: to a rotation about the imu axes.
      Eigen::MatrixXd basis = Eigen::MatrixXd::Identity(p.size, p.size);
      if (p.kind == ParameterKind::kRotation)
        basis = 2.0 * solved->estimate->imus[p.imu].q_MI.toRotationMatrix().transpose();
      for (int k = 0; k < p.size; ++k) L.emplace_back(leading_++, functionals_ + k, 1.0);
      place(p, is_estimated, basis);
    };
    for (const Parameter& p : ordering.calibrated) place_leading(p, true);
    calibrated_ = functionals_;
    int column = ordering.leading;
    for (size_t s = 0; s < solved->estimate->sessions.size(); ++s) {
      SessionEstimate& session = solved->estimate->sessions[s];
      if (solved->options.estimate_gravity) {
        for (int k = 0; k < 2; ++k) L.emplace_back(column++, functionals_ + k, 1.0);
        place({ParameterKind::kGravity, 0, s, 3, nullptr},
              true,
              PlusJacobian(solved->problem, session.g_W.data()));
      }
      for (size_t i = 0; i < session.imus.size(); ++i) {
        const auto place_mean = [&](ParameterKind kind, const BiasKnots& knots) {
          if (knots.values.empty()) return;
          for (size_t k = 0; k < knots.values.size(); ++k)
            for (int axis = 0; axis < 3; ++axis)
              L.emplace_back(
                  column++, functionals_ + axis, 1.0 / static_cast<double>(knots.values.size()));
          place({kind, i, s, 3, nullptr}, true, Eigen::Matrix3d::Identity());
        };
        place_mean(ParameterKind::kGyroBias, session.imus[i].gyro_bias);
        place_mean(ParameterKind::kAccelBias, session.imus[i].accel_bias);
      }
    }
    estimated_ = functionals_;
    for (const Parameter& p : ordering.possible) place_leading(p, false);
    L_.resize(ordering.columns, functionals_);
    L_.setFromTriplets(L.begin(), L.end());
  }

  const SparseMatrix& L() const { return L_; }
  int functionals() const { return functionals_; }
  int estimated() const { return estimated_; }    ///< functionals, gravity and biases included
  int calibrated() const { return calibrated_; }  ///< functionals without these
  int size() const { return size_; }

  /// Functionals to what is reported; those beyond the ones given are 0.
  Eigen::MatrixXd Spread(const Eigen::MatrixXd& C) const {
    const Eigen::MatrixXd T = Basis().leftCols(C.rows());
    return T * C * T.transpose();
  }
  Eigen::VectorXd SpreadVector(const Eigen::VectorXd& x) const {
    return Basis().leftCols(x.size()) * x;
  }
  /// Rows: what is reported; columns: functionals.
  Eigen::MatrixXd Basis() const {
    Eigen::MatrixXd T = Eigen::MatrixXd::Zero(size_, functionals_);
    for (const Block& b : bases_)
      T.block(b.place, b.functional, b.basis.rows(), b.basis.cols()) = b.basis;
    return T;
  }

 private:
  struct Block {
    int place, functional;
    Eigen::MatrixXd basis;
  };
  std::vector<Block> bases_;
  SparseMatrix L_;
  int leading_ = 0, functionals_ = 0, size_ = 0, estimated_ = 0, calibrated_ = 0;
};

/// Whether the session has the IMU that the parameter is of, or any session's.
bool ActsIn(const Estimate& estimate, const Parameter& p, size_t session) {
  if (IsOfPoses(p.kind)) return true;
  return estimate.sessions[session].imus[p.imu].is_present &&
         (!IsOfSession(p) || p.session == session);
}

/// Share of the scores' degrees of freedom that the fit used up. Scores have as many dimensions per
/// cluster as there are parameters that act in it; the fit sets as many of them to 0 as it has
/// parameters.
double FittedShare(const Ordering& ordering, const Clusters& clusters, const LeastSquares& solved) {
  double dimensions = 0.0;
  for (size_t s = 0; s < solved.sessions.size(); ++s) {
    int local = solved.options.estimate_gravity ? 2 : 0;
    for (const ImuSessionEstimate& imu : solved.estimate->sessions[s].imus)
      if (imu.is_present) local += 6;
    for (const Parameter& p : ordering.calibrated)
      if (ActsIn(*solved.estimate, p, s)) local += p.size;
    dimensions += static_cast<double>(local * clusters.Count(s));
  }
  const int shared = ordering.trajectory - ordering.leading;
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
Eigen::MatrixXd RobustCovariance(const MarginalEstimate& exact,
                                 const Ordering& ordering,
                                 const Estimate& estimate,
                                 double fitted) {
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
void CompareHalves(const MarginalEstimate& first,
                   const MarginalEstimate& second,
                   const Report& report,
                   double fitted,
                   Marginals* result) {
  const Eigen::VectorXd difference = second.Step() - first.Step();
  const Eigen::VectorXd difference_std =
      (LargerStd(first, fitted).cwiseAbs2() + LargerStd(second, fitted).cwiseAbs2()).cwiseSqrt();
  result->halves_difference = report.SpreadVector(difference);
  const double largest =
      difference.size() > 0 ? difference.cwiseQuotient(difference_std).cwiseAbs().maxCoeff() : 0.0;
  result->halves_sigmas = std::isfinite(largest) ? largest : 0.0;
}

/// Where parameters that are held would move to.
void FindHints(const MarginalEstimate& all,
               const Report& report,
               double fitted,
               Marginals* result) {
  // A parameter that is missing makes blocks differ slowly, as drift does: that is no scatter.
  std::vector<int> leading(static_cast<size_t>(all.covariance.rows()));
  std::iota(leading.begin(), leading.end(), 0);
  leading.erase(leading.begin() + report.calibrated(), leading.begin() + report.estimated());
  MarginalEstimate neighbours = Select(all, leading);
  const Eigen::MatrixXd influence = neighbours.influence;
  neighbours.influence =
      (influence.rightCols(influence.cols() - 1) - influence.leftCols(influence.cols() - 1)) /
      std::sqrt(2.0);
  const Eigen::VectorXd std_dev = LargerStd(neighbours, fitted);
  const Eigen::VectorXd step = all.Step();
  const auto held = step.size() - report.estimated();
  result->hint = Eigen::VectorXd::Zero(report.size());
  result->hint_std = Eigen::VectorXd::Zero(report.size());
  // Held parameters are reported as they are, and last.
  result->hint.tail(held) = step.tail(held);
  result->hint_std.tail(held) = std_dev.tail(held);
}

/// The IMUs whose accelerometer does not have its axes at one place, as the hints tell.
std::vector<Parameter> FindShown(const Ordering& ordering, const Marginals& marginals) {
  std::vector<Parameter> shown;
  for (const Parameter& p : ordering.possible) {
    if (p.kind != ParameterKind::kAccelPositions) continue;
    const int place = marginals.Find(p.kind, p.imu);
    if ((marginals.hint.segment(place, p.size).array().abs() >
         kShown * marginals.hint_std.segment(place, p.size).array())
            .any())
      shown.push_back(p);
  }
  return shown;
}

/// The Gauss-Newton step as if what is held was known to be right, but for what is shown.
Eigen::VectorXd FindStep(const MarginalEstimates& estimates,
                         const Report& report,
                         const Marginals& marginals) {
  std::vector<int> held;
  for (const PlacedParameter& p : marginals.parameters) {
    const auto is_same = [&](const Parameter& q) { return q.data == p.parameter.data; };
    if (p.is_estimated || std::any_of(marginals.shown.begin(), marginals.shown.end(), is_same))
      continue;
    // Places and functionals end alike.
    for (int k = 0; k < p.parameter.size; ++k)
      held.push_back(p.place + k - report.size() + report.functionals());
  }
  if (held.empty() || estimates.gain.size() == 0) return estimates.step;
  const MarginalEstimate others = Select(estimates.gauss_newton, held);
  const Eigen::VectorXd back = others.covariance.ldlt().solve(others.Step());
  Eigen::VectorXd step = estimates.step;
  for (size_t k = 0; k < held.size(); ++k)
    step -= back[static_cast<Eigen::Index>(k)] * estimates.gain.col(held[k]);
  return step;
}

/// What each session says alone.
void FindSessions(const MarginalEstimator& estimator,
                  const Ordering& ordering,
                  const Report& report,
                  double fitted,
                  const Eigen::VectorXd& step,
                  Marginals* result) {
  const size_t count = result->parameters.empty() ? 0 : estimator.parts() / 2;
  if (count < 2) return;
  for (size_t s = 0; s < count; ++s) {
    const std::vector<int> parts = {static_cast<int>(2 * s), static_cast<int>(2 * s) + 1};
    const std::vector<int> acting = estimator.ActingIn(parts);
    const auto estimated = std::count_if(
        acting.begin(), acting.end(), [&](int column) { return column < ordering.estimated; });
    const MarginalEstimate own =
        GivenOthers(estimator.SolveParts(parts, acting), static_cast<int>(estimated));
    SessionMarginals session;
    // To the places of the report, all others being left out.
    const Eigen::MatrixXd T = report.Basis();
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

int Marginals::Find(ParameterKind kind, size_t imu, size_t session) const {
  const bool is_of_imu = kind != ParameterKind::kGravity && !IsOfPoses(kind);
  const bool is_of_session = kind == ParameterKind::kGravity || kind == ParameterKind::kGyroBias ||
                             kind == ParameterKind::kAccelBias ||
                             IsOfSession({kind, imu, session, 0, nullptr});
  for (const PlacedParameter& p : parameters)
    if (p.parameter.kind == kind && (!is_of_imu || p.parameter.imu == imu) &&
        (!is_of_session || p.parameter.session == session))
      return p.place;
  return -1;
}

int Marginals::FindColumn(ParameterKind kind, size_t imu) const {
  int column = 0;
  for (const PlacedParameter& p : parameters) {
    if (!p.is_estimated) continue;
    if (p.parameter.kind == kind && p.parameter.imu == imu) return column;
    column += p.parameter.size;
  }
  return -1;
}

Eigen::VectorXd Enlargement(const Eigen::MatrixXd& model, const Eigen::MatrixXd& robust) {
  Eigen::VectorXd factor = Eigen::VectorXd::Ones(model.rows());
  for (Eigen::Index i = 0; i < model.rows(); ++i)
    if (model(i, i) > 0.0) factor[i] = std::sqrt(std::max(1.0, robust(i, i) / model(i, i)));
  return factor;
}

Marginals FindMarginals(LeastSquares* solved) {
  Marginals result;
  const Ordering ordering(solved);
  const Clusters clusters(*solved);
  const MarginalEstimator estimator = Accumulate(ordering, clusters, solved);
  const Report report(ordering, solved, &result);
  for (const Parameter& p : ordering.possible) solved->problem.SetParameterBlockConstant(p.data);

  // Side by side, unless that takes too much memory or threads are not wanted.
  const bool is_parallel = ordering.columns < kManyColumns && solved->Threads() > 1;
  std::vector<int> leading(static_cast<size_t>(ordering.leading));
  std::iota(leading.begin(), leading.end(), 0);
  const auto solve_half = [&](int half) {
    return std::async(is_parallel ? std::launch::async : std::launch::deferred, [&, half] {
      return GivenOthers(estimator.SolveParts(clusters.Half(half), leading), ordering.estimated);
    });
  };
  auto first_half = solve_half(0), second_half = solve_half(1);
  MarginalEstimates estimates = estimator.Solve(report.L());

  const double fitted = FittedShare(ordering, clusters, *solved);
  const MarginalEstimate& all = estimates.gauss_newton;
  const MarginalEstimate marginal = GivenOthers(all, report.estimated());
  result.model = report.Spread(marginal.covariance);
  result.robust = report.Spread(
      result.model.allFinite() ? RobustCovariance(GivenOthers(estimates.exact, report.estimated()),
                                                  ordering,
                                                  *solved->estimate,
                                                  fitted)
                               : marginal.covariance);
  result.feigned_information = solved->feigned_information;
  CompareHalves(first_half.get(), second_half.get(), report, fitted, &result);
  FindHints(all, report, fitted, &result);

  if (solved->options.estimate_size_effect) result.shown = FindShown(ordering, result);
  result.step = FindStep(estimates, report, result);
  result.blocks = ordering.blocks;
  result.held_begin = ordering.estimated;
  result.held_end = ordering.leading;
  result.trajectory_begin = ordering.trajectory;
  result.H.swap(estimates.H);
  FindSessions(estimator, ordering, report, fitted, report.SpreadVector(marginal.Step()), &result);
  return result;
}

}  // namespace imu_pose_calib
