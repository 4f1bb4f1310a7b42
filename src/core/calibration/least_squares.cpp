#include "imu_pose_calib/core/calibration/least_squares.h"

#include <ceres/normal_prior.h>

#include <algorithm>
#include <cmath>
#include <complex>
#include <limits>
#include <numeric>
#include <string>
#include <utility>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/parallel.h"
#include "imu_pose_calib/core/base/text.h"
#include "imu_pose_calib/core/calibration/priors.h"
#include "imu_pose_calib/core/calibration/residuals.h"

namespace imu_pose_calib {
namespace {

/// Residuals of a sensor that the trajectory follows more closely say little about its noise.
constexpr double kLeastRedundancy = 0.1;
/// Spans that a spectrum is the mean of, evenly over the session, at most; and share of the usual
/// samples that each has at least.
constexpr size_t kSpans = 100;
constexpr double kLeastFull = 0.25;
constexpr size_t kTouched = 20;  // one span of so many is left out, that of the largest residuals

/// Share of the time between samples that one of those which stand for others reaches, so as to
/// miss none of them.
constexpr double kReach = 0.75;
constexpr double kRounding = 1e-6;
/// Windows, at most: memory goes with their square.
constexpr int kMostWindows = 1000;

/// Share of the diagonal of H that is added to it after a step that does not reduce the cost by a
/// share kLeastGain of what it should (Levenberg-Marquardt), at first; and share of the cost that
/// is nothing.
constexpr double kDamping = 1e-4, kLeastGain = 1e-3, kNothing = 1e-6;
/// With a larger one, what Ceres leaves of the way is more than a pass may move when it is the
/// last.
constexpr double kCeresTolerance = 1e-6;

/// Of the poses that are left, between the first and the last one of segments [Hz].
double MeanRate(const ConditionedData& data) {
  double steps = 0.0, duration = 0.0;
  for (const IndexRange& segment : data.segments) {
    if (segment.size() < 2) continue;
    for (size_t i = segment.begin + 1; i < segment.end; ++i) steps += data.poses[i].count;
    duration += data.poses[segment.end - 1].t - data.poses[segment.begin].t;
  }
  return duration > 0.0 ? steps / duration : data.pose_report.rate_hz;
}

/// The largest move of T_MI, a time shift or an accel delay in its sigma; `x`, `std`: of what acts
/// everywhere.
double LargestMove(const Ordering& order, const Eigen::VectorXd& x, const Eigen::VectorXd& std) {
  double largest = 0.0;
  Eigen::Index column = 0;
  for (const Parameter& p : order.calibrated) {
    if (p.kind <= ParameterKind::kAccelDelay && std.size() > 0)
      largest = std::max(largest, x.segment(column, p.size)
                                      .cwiseQuotient(std.segment(column, p.size))
                                      .lpNorm<Eigen::Infinity>());
    column += p.size;
  }
  return largest;
}

RecordedSample SampleOf(const ConditionedData& data, const SensorModel& model, size_t index) {
  const auto of_imu = [](const TimedSample& s) -> RecordedSample {
    return {s.t, 1.0, s.count, s.rest};
  };
  switch (model.quantity) {
    case Quantity::kPosition: {
      const TimedPose& pose = data.poses[index];
      return {pose.t, pose.position_scale, pose.count, pose.position_rest};
    }
    case Quantity::kRotation: {
      const TimedPose& pose = data.poses[index];
      return {pose.t, pose.rotation_scale, pose.count, pose.rotation_rest};
    }
    case Quantity::kGyro:
      return of_imu(data.imus[model.imu].gyro[index]);
    case Quantity::kAccel:
      break;
  }
  return of_imu(data.imus[model.imu].accel[index]);
}

/// Samples of a sensor.
size_t CountOf(const ConditionedData& data, const SensorModel& model) {
  if (IsOfPoses(model.quantity)) return data.poses.size();
  const ConditionedImu& imu = data.imus[model.imu];
  return model.quantity == Quantity::kGyro ? imu.gyro.size() : imu.accel.size();
}

}  // namespace

void ThrowNotConverged(const CalibrationOptions& options) {
  throw DataError("the solve did not converge within max_iterations = " +
                  std::to_string(options.max_iterations));
}

std::vector<SensorModel> InitialModels(const CalibrationOptions& options,
                                       const std::vector<PreparedSession>& sessions) {
  std::vector<SensorModel> models;
  for (size_t s = 0; s < sessions.size(); ++s) {
    const ConditionedData& data = sessions[s].data;
    const auto add = [&](Quantity quantity, size_t imu, double rate_hz, double noise, size_t size) {
      models.push_back(
          {quantity, s, imu, rate_hz, noise, {noise, 0.0}, std::vector<double>(size, 1.0)});
    };
    const double rate_hz = MeanRate(data);
    const size_t poses = data.poses.size();
    add(Quantity::kPosition, 0, rate_hz, sessions[s].pose_noise.position, poses);
    add(Quantity::kRotation, 0, rate_hz, sessions[s].pose_noise.rotation, poses);
    for (size_t i = 0; i < data.imus.size(); ++i) {
      const ConditionedImu& imu = data.imus[i];
      if (!imu.IsPresent()) continue;
      const auto add_imu = [&](Quantity quantity, double density, double rate, size_t size) {
        add(quantity, i, rate, density * std::sqrt(rate), size);
      };
      add_imu(Quantity::kGyro, options.gyro_noise_density, imu.gyro_report.rate_hz,
              imu.gyro.size());
      add_imu(Quantity::kAccel, options.accel_noise_density, imu.accel_report.rate_hz,
              imu.accel.size());
    }
  }
  return models;
}

Windows::Windows(const CalibrationOptions& options, const std::vector<PreparedSession>& sessions,
                 const Estimate& estimate) {
  double total = 0.0;
  for (size_t s = 0; s < estimate.sessions.size(); ++s) {
    const SessionEstimate& session = estimate.sessions[s];
    double begin = std::numeric_limits<double>::infinity(), end = -begin;
    for (size_t i = 0; i < session.imus.size(); ++i) {
      if (!session.imus[i].is_present) continue;
      const ConditionedImu& imu = sessions[s].data.imus[i];
      begin = std::min(begin,
                       session.imus[i].PoseTime(std::min(imu.gyro.front().t, imu.accel.front().t)));
      end =
          std::max(end, session.imus[i].PoseTime(std::max(imu.gyro.back().t, imu.accel.back().t)));
    }
    if (begin > end) begin = end = 0.0;
    spans_.push_back({begin, end, 0, 0});
    total += end - begin;
  }
  length_s_ = options.covariance_block_s > 0.0 ? options.covariance_block_s
                                               : std::max(kShortestWindow, total / kWindows);
  if (total > kMostWindows * length_s_)
    Throw<InputError>("covariance_block_s = ", length_s_, " makes more than ", kMostWindows,
                      " blocks of ", total, " s");
  for (size_t s = 0; s < spans_.size(); ++s) {
    Span& span = spans_[s];
    span.first = count();
    // Not by rounding: a last window of nothing.
    const double windows = (span.end - span.begin) / length_s_;
    span.count = std::max(1, static_cast<int>(std::ceil(windows - kRounding)));
    sessions_.insert(sessions_.end(), static_cast<size_t>(span.count), s);
  }
}

int Windows::Of(size_t session, double t) const {
  const Span& span = spans_[session];
  const int window = static_cast<int>(std::max(0.0, t - span.begin) / length_s_ + kRounding);
  return span.first + std::min(window, span.count - 1);
}

LeastSquares::LeastSquares(const CalibrationOptions& options,
                           const std::vector<PreparedSession>& sessions,
                           const std::vector<SensorModel>& models, Estimate* estimate)
    : options(options),
      sessions(sessions),
      models(models),
      estimate(estimate),
      windows(options, sessions, *estimate) {
  for (const SensorModel& model : models) {
    sensors.emplace_back();
    sensors.back().model = &model;
  }
}

SensorBlocks* LeastSquares::Find(Quantity quantity, size_t session, size_t imu) {
  for (SensorBlocks& sensor : sensors)
    if (sensor.model->quantity == quantity && sensor.model->session == session &&
        sensor.model->imu == imu)
      return &sensor;
  return nullptr;
}

void LeastSquares::Add(int block, size_t session, double t) {
  equations.push_back({block, session, t, windows.Of(session, t)});
}

void LeastSquares::AddPrior(std::unique_ptr<const ceres::CostFunction> prior,
                            const std::vector<double*>& data, size_t session) {
  const ImuSessionEstimate& clock =
      estimate->sessions[session].imus[estimate->sessions[session].FirstImu()];
  Add(problem.AddResidualsOf(data, std::move(prior)), session,
      clock.PoseTime(clock.clock_reference));
}

void LeastSquares::AddCalibration(bool is_joint) {
  std::vector<Parameter> with_peaks;
  for (const Parameter& p : CalibrationParameters(estimate)) {
    if (!is_joint && p.kind > ParameterKind::kAccelDelay) continue;
    problem.AddParameters(p.data, p.kind == ParameterKind::kRotation ? 4 : p.size);
    const bool is_held = !IsEstimated(options, p.kind);
    problem.SetHeld(p.data, is_held);
    if (is_held) continue;
    if (HasPeak(p.kind)) {
      with_peaks.push_back(p);
      continue;
    }
    Eigen::VectorXd mean(p.size), information(p.size);
    for (int k = 0; k < p.size; ++k) {
      const GaussianPrior prior = PriorOf(p, k, options);
      mean[k] = prior.mean;
      information[k] = prior.std > 0.0 ? 1.0 / prior.std : 0.0;
    }
    if (!information.isZero(0.0))
      AddPrior(std::make_unique<const ceres::NormalPrior>(information.asDiagonal(), mean), {p.data},
               p.session);
  }
  if (!with_peaks.empty()) {
    if (estimate->peaks.b.size() == 0) estimate->peaks = FirstPeaks(*estimate, with_peaks);
    std::vector<double*> data;
    for (const Parameter& p : with_peaks) data.push_back(p.data);
    AddPrior(PeakPriors(with_peaks, estimate->peaks), data, 0);
  }
  for (size_t s = 0; s < sessions.size(); ++s) {
    double* const g_W = estimate->sessions[s].g_W.data();
    problem.AddParameters(g_W, 3);
    problem.SetHeld(g_W, !options.estimate_gravity);
    if (options.estimate_gravity)
      AddPrior(GravityPrior{options.GravityMagnitude(), options.GravityStd()}.Create(), {g_W}, s);
  }
}

void LeastSquares::AddBiasWalk(double walk, size_t session, size_t imu, BiasKnots* knots) {
  const ImuSessionEstimate& clock = estimate->sessions[session].imus[imu];
  for (size_t k = 0; k + 1 < knots->t.size(); ++k) {
    const double sigma = walk * std::sqrt(knots->t[k + 1] - knots->t[k]);
    Add(problem.AddResidualsOf({knots->values[k].data(), knots->values[k + 1].data()},
                               WalkResidual<3>{sigma}.Create()),
        session, clock.PoseTime(knots->t[k]));
  }
}

void LeastSquares::AddClockWalk(size_t session, size_t imu) {
  ImuSessionEstimate& clock = estimate->sessions[session].imus[imu];
  for (size_t k = 0; k + 1 < clock.walk.t.size(); ++k)
    Add(problem.AddResidualsOf({&clock.walk.offset[k], &clock.walk.offset[k + 1]},
                               WalkResidual<1>{clock.walk.std[k]}.Create()),
        session, clock.PoseTime(clock.walk.t[k]));
}

void LeastSquares::AddSlowErrors(size_t session, SlowErrors* errors) {
  BiasKnots& knots = errors->knots;
  Add(problem.AddResidualsOf(
          {knots.values[0].data()},
          std::make_unique<const ceres::NormalPrior>(Eigen::Matrix3d::Identity() / errors->std,
                                                     Eigen::Vector3d::Zero())),
      session, knots.t[0]);
  for (size_t k = 0; k + 1 < knots.t.size(); ++k) {
    const double kept = errors->Kept(k);
    const WalkResidual<3> decay{errors->std * std::sqrt(1.0 - kept * kept), kept};
    Add(problem.AddResidualsOf({knots.values[k].data(), knots.values[k + 1].data()},
                               decay.Create()),
        session, knots.t[k]);
  }
}

void Linearisation::Eliminate(const CalibrationOptions& options, double damping) {
  const auto count = static_cast<size_t>(equations.elimination()->windows());
  // The gradient is the sum of the scores.
  Eigen::VectorXd weights = Eigen::VectorXd::Zero(
      static_cast<Eigen::Index>(count + 3 * order.means.size()) + order.biases);
  weights.head(static_cast<Eigen::Index>(count)).setOnes();
  std::vector<double> costs(count, 0.0);
  windows.emplace(equations.elimination(), weights, options.max_factor_mb, options.Threads(),
                  [&](size_t w) { return Assemble(w, damping, &costs[w]); });
  cost = std::accumulate(costs.begin(), costs.end(), 0.0);
  Panels means;
  AddMeans(static_cast<int>(count), &means);
  reduced = windows->ReduceAll(std::move(means));
  reduced.B.middleCols(static_cast<Eigen::Index>(count), order.biases).setIdentity();
}

Panels Linearisation::Assemble(size_t window, double damping, double* cost) const {
  Panels own = equations.Assemble(window, cost);
  equations.elimination()->VisitDiagonal(
      [damping](int, auto diagonal) { diagonal *= 1.0 + damping; }, &own);
  AddMeans(static_cast<int>(window), &own);
  return own;
}

void Linearisation::AddMeans(int window, Panels* panels) const {
  const Elimination& elimination = *equations.elimination();
  auto block = static_cast<int>(order.border.size());
  int functional = elimination.windows() + order.biases;
  for (const size_t knots : order.means) {
    for (size_t k = 0; k < knots; ++k, ++block)
      for (int axis = 0; axis < 3 && elimination.WindowOf(block) == window; ++axis)
        elimination.AddRhs({elimination.place(block)}, functional + axis,
                           Eigen::Vector3d::Unit(axis) / static_cast<double>(knots), panels);
    functional += 3;
  }
}

GaussNewtonStep Linearisation::FindStep() const {
  Eigen::MatrixXd H = reduced.H;
  for (Eigen::Index k = 0; k < H.rows(); ++k)
    if (H(k, k) == 0.0) H(k, k) = 1.0;  // nothing acts on it: it stays
  const Eigen::Index count = equations.elimination()->windows();
  const Eigen::VectorXd b = reduced.B.leftCols(count).rowwise().sum(), x = -SolvePositive(H, b);
  GaussNewtonStep step{Eigen::VectorXd::Zero(order.columns), std::nan(""), {}};
  if (!x.allFinite()) return step;
  step.x.head(b.size()) = x;
  step.decrease = 0.5 * (reduced.inner.topLeftCorner(count, count).sum() - b.dot(x));
  step.covariance = SolvePositive(H, Eigen::MatrixXd::Identity(b.size(), b.size()));
  return step;
}

void Linearisation::SubstituteBack(double damping, Eigen::VectorXd* x) const {
  windows->SubstituteBack([&](size_t w) { return Assemble(w, damping, nullptr); }, x);
}

Eigen::Vector3d LeastSquares::AtUsualWeight(const SensorBlocks& sensor, size_t i) const {
  const Eigen::Vector3d& residual = sensor.residuals[i];
  if (!IsOfPoses(sensor.model->quantity)) return residual;  // it weighs as its neighbours do
  const size_t index = sensor.samples[i].index;
  const RecordedSample pose = At(*sensor.model, index);
  const double leverage = std::min(1.0 - kLeastRedundancy, sensor.fitted * pose.count);
  // The trajectory follows what is in its band, not the rest.
  const Eigen::Vector3d rest = pose.rest / pose.scale;
  return rest + ToUsualWeight(leverage, sensor.model->weights[index]) * (residual - rest);
}

RecordedSample LeastSquares::At(const SensorModel& model, size_t index) const {
  return SampleOf(sessions[model.session].data, model, index);
}

Ordering LeastSquares::Order() const {
  Ordering order;
  const auto add = [&](const double* data, std::vector<int>* blocks) {
    if (!problem.IsEstimated(data)) return;
    blocks->push_back(problem.Find(data));
    order.columns += problem.TangentSize(blocks->back());
  };
  for (const Parameter& p : CalibrationParameters(estimate)) {
    add(p.data, &order.border);
    if (problem.IsEstimated(p.data)) order.calibrated.push_back(p);
  }
  order.gravity = order.columns;
  for (const SessionEstimate& session : estimate->sessions) add(session.g_W.data(), &order.border);
  order.biases = order.columns;
  for (const SessionEstimate& session : estimate->sessions)
    for (const ImuSessionEstimate& imu : session.imus)
      for (const BiasKnots* knots : {&imu.gyro_bias, &imu.accel_bias}) {
        const size_t before = order.inner.size();
        for (const Eigen::Vector3d& value : knots->values) add(value.data(), &order.inner);
        if (order.inner.size() > before) order.means.push_back(order.inner.size() - before);
      }
  order.walks = order.columns;
  for (const SessionEstimate& session : estimate->sessions)
    for (const ImuSessionEstimate& imu : session.imus)
      for (const double& offset : imu.walk.offset) add(&offset, &order.inner);
  for (const SessionEstimate& session : estimate->sessions)
    for (const SlowErrors* const errors : session.AllErrors())
      for (const Eigen::Vector3d& value : errors->knots.values) add(value.data(), &order.inner);
  order.trajectory = order.columns;
  for (const int block : trajectory_blocks) add(problem.data(block), &order.inner);
  return order;
}

std::optional<int> LeastSquares::SolveWithCeres(double function_tolerance) {
  rows_.clear();
  return problem.SolveWithCeres(function_tolerance, options.max_iterations, options.Threads());
}

Linearisation LeastSquares::Linearise() {
  if (linearisation_) {
    Linearisation known = std::move(*linearisation_);
    linearisation_.reset();
    return known;
  }
  Ordering order = Order();
  NormalEquations normal(problem, order.border, order.inner, equations,
                         static_cast<size_t>(windows.count()));
  Linearisation at{std::move(order), std::move(normal), {}, {}, 0.0};
  at.Eliminate(options, 0.0);
  return at;
}

StepSummary LeastSquares::Step(double least) {
  Linearisation at = Linearise();
  double damping = 0.0, growth = 1.0;
  for (int iteration = 1; iteration <= options.max_iterations; ++iteration) {
    if (damping > 0.0) at.Eliminate(options, damping);
    GaussNewtonStep step = at.FindStep();
    const double moved = LargestMove(at.order, step.x, step.covariance.diagonal().cwiseSqrt());
    // A step that there is none of has a decrease of NaN.
    if (damping == 0.0 && std::isfinite(step.decrease) && moved < least) {
      linearisation_.emplace(std::move(at));
      return {true, 0, moved};
    }
    if (options.solver == SolverKind::kCeres) {
      const auto iterations = SolveWithCeres(kCeresTolerance);
      if (!iterations || !std::isfinite(step.decrease)) break;
      estimate->peaks = MatchPeaks(*estimate, at.order.calibrated, step.covariance);
      return {true, *iterations, moved};
    }
    at.SubstituteBack(damping, &step.x);
    const std::vector<double> before = problem.Move(at.equations.blocks(), step.x);
    double found = 0.0;
    if (!problem.Evaluate(options.Threads(), &rows_, &found)) found = std::nan("");
    // Never without a step, whose decrease is NaN.
    if (at.cost - found >= kLeastGain * step.decrease - kNothing * at.cost) {
      estimate->peaks = MatchPeaks(*estimate, at.order.calibrated, step.covariance);
      return {damping == 0.0, iteration, moved};
    }
    problem.Restore(at.equations.blocks(), before);
    rows_.clear();
    damping = std::max(kDamping, damping * (growth *= 2.0));
  }
  return {false, options.max_iterations, std::numeric_limits<double>::infinity()};
}

NoiseSpectrum LeastSquares::FindSpectrum(const SensorBlocks& sensor, const float* rows,
                                         const StudentT& spread) const {
  const SensorModel& model = *sensor.model;
  const std::vector<ProblemSample>& samples = sensor.samples;
  const bool is_rotation = model.quantity == Quantity::kRotation;
  const SlowErrors* const slow = IsOfPoses(model.quantity)
                                     ? estimate->sessions[model.session].AllErrors()[is_rotation]
                                     : nullptr;
  const int bins = static_cast<int>(sensor.band * NoiseSpectrum::kSpan) - NoiseSpectrum::kFirst + 1;
  if (bins < 1) return {};
  const double first_t = samples.front().t;
  const auto spans = static_cast<size_t>((samples.back().t - first_t) / NoiseSpectrum::kSpan);
  const size_t stride = 1 + spans / kSpans;
  NoiseSpectrum spectrum{std::vector<double>(static_cast<size_t>(bins), 0.0)};
  std::vector<Eigen::RowVectorXd> periodograms;
  size_t i = 0;
  for (size_t span = 0; span < spans; span += stride) {
    const double begin = first_t + static_cast<double>(span) * NoiseSpectrum::kSpan;
    Eigen::Matrix3Xcd sums = Eigen::Matrix3Xcd::Zero(3, bins);
    double window2 = 0.0, count = 0.0, information = 0.0;
    while (i < samples.size() && samples[i].t < begin) ++i;
    for (; i < samples.size() && samples[i].t < begin + NoiseSpectrum::kSpan; ++i) {
      const double angle = 2.0 * M_PI * (samples[i].t - begin) / NoiseSpectrum::kSpan;
      const double window = 1.0 - std::cos(angle);  // Hann's
      const RecordedSample recorded = At(model, samples[i].index);
      Eigen::Vector3d error =
          samples[i].sigma * Eigen::Map<const Eigen::Vector3f>(rows + 3 * i).cast<double>();
      if (slow)
        error += slow->knots.At(recorded.t);
      else  // a shock is no noise
        error *= std::sqrt(spread.Weight(sensor.residuals[i].squaredNorm()));
      const double weight = recorded.count / (recorded.scale * recorded.scale);
      const Eigen::Vector3d r = weight * window * error;
      const std::complex<double> turn = std::polar(1.0, angle);
      std::complex<double> phase = std::polar(1.0, NoiseSpectrum::kFirst * angle);
      for (int k = 0; k < bins; ++k, phase *= turn) sums.col(k) += phase * r;
      window2 += weight * window * window;
      count += recorded.count;
      information += weight;
    }
    if (count < kLeastFull * NoiseSpectrum::kSpan * model.rate_hz) continue;
    periodograms.emplace_back(sums.colwise().squaredNorm() /
                              (3.0 * window2 * model.rate_hz * information / count));
  }
  if (periodograms.empty()) return {};
  // A touch or a clock that steps is no noise.
  std::sort(periodograms.begin(), periodograms.end(),
            [](const auto& a, const auto& b) { return a.sum() < b.sum(); });
  const size_t largest = periodograms.size() / kTouched;
  periodograms.resize(periodograms.size() - largest);
  for (const Eigen::RowVectorXd& periodogram : periodograms)
    for (int k = 0; k < bins; ++k) spectrum.density[static_cast<size_t>(k)] += periodogram[k];
  spectrum.count = static_cast<double>(periodograms.size());
  for (double& density : spectrum.density) density /= spectrum.count;
  spectrum.count *= 3.0;
  return spectrum;
}

std::vector<SensorStatistics> LeastSquares::FindStatistics() {
  double cost = 0.0;
  if (rows_.empty() && !problem.Evaluate(options.Threads(), &rows_, &cost))
    throw DataError("the residuals cannot be evaluated where the solve ended");
  std::vector<SensorStatistics> statistics(sensors.size());
  InParallel(options.Threads(), sensors.size(), [&](size_t k) {
    SensorBlocks& sensor = sensors[k];
    sensor.residuals.clear();
    if (sensor.samples.empty()) {
      statistics[k] = {sensor.model->noise, 0.0, sensor.model->spread, {}};
      return;
    }
    const float* const rows = &rows_[sensor.first_row];
    const float* r_sigma = rows;
    std::vector<float> variances;
    variances.reserve(sensor.samples.size());
    sensor.residuals.reserve(sensor.samples.size());
    double sum2 = 0.0;
    for (const ProblemSample& sample : sensor.samples) {
      const RecordedSample recorded = At(*sensor.model, sample.index);
      const double scale = recorded.scale;
      const Eigen::Vector3d r =
          (sample.sigma * Eigen::Map<const Eigen::Vector3f>(r_sigma).cast<double>() +
           recorded.rest) /
          scale;
      r_sigma += 3;
      variances.push_back(sample.trajectory_variance);
      sensor.residuals.push_back(r);
      sum2 += scale * scale * r.squaredNorm();
    }
    const double count = 3.0 * static_cast<double>(sensor.samples.size());
    const double redundancy = std::max(kLeastRedundancy, 1.0 - sensor.fitted);
    std::vector<Eigen::Vector3d> at_usual_weight;
    for (size_t i = 0; i < sensor.samples.size(); ++i)
      at_usual_weight.push_back(AtUsualWeight(sensor, i));
    StudentT spread = FitStudentT(at_usual_weight);
    spread.scale /= std::sqrt(redundancy);
    const double spread2 = spread.scale * spread.scale;
    // The trajectory's share is known only roughly: it never explains the residuals alone.
    const double own2 = std::max(spread2 - Median(std::move(variances)), 0.01 * spread2);
    statistics[k] = {std::sqrt(own2), std::sqrt(sum2 / count), spread,
                     FindSpectrum(sensor, rows, spread)};
  });
  rows_ = {};
  return statistics;
}

std::vector<SensorResiduals> LeastSquares::FindResiduals(
    const std::vector<PreparedSession>& recorded) const {
  std::vector<SensorResiduals> all;
  for (const SensorBlocks& sensor : sensors) {
    const SensorModel& model = *sensor.model;
    const ConditionedData& data = recorded[model.session].data;
    const std::vector<ProblemSample>& samples = sensor.samples;
    // Of a sample of the problem, without its rest.
    const auto smooth = [&](size_t i) -> Eigen::Vector3d {
      const RecordedSample own = At(model, samples[i].index);
      return sensor.residuals[i] * own.scale - own.rest;
    };
    SensorResiduals found{model.quantity, model.session, model.imu, model.noise, {}, {}, {}};
    const size_t count = CountOf(data, model);
    size_t next = 0;  // of the samples as recorded
    for (size_t i = 0; i < samples.size(); ++i) {
      const RecordedSample own = At(model, samples[i].index);
      const double reach = kReach * own.count / model.rate_hz;
      const double end =
          i + 1 < samples.size()
              ? std::min(own.t + reach, 0.5 * (own.t + At(model, samples[i + 1].index).t))
              : own.t + reach;
      for (; next < count; ++next) {
        const RecordedSample one = SampleOf(data, model, next);
        if (one.t < own.t - reach) continue;
        if (one.t > end) break;
        // In between it is linear.
        const size_t near =
            one.t < own.t ? std::max<size_t>(i, 1) - 1 : std::min(i + 1, samples.size() - 1);
        const RecordedSample other = At(model, samples[near].index);
        const double share = near == i ? 0.0 : (one.t - own.t) / (other.t - own.t);
        found.t.push_back(samples[i].t + one.t - own.t);
        found.residual.push_back((1.0 - share) * smooth(i) + share * smooth(near) + one.rest);
        found.weight.push_back(model.weights[samples[i].index]);
      }
    }
    all.push_back(std::move(found));
  }
  return all;
}

bool IsOnTrajectory(const PoseTrajectory& trajectory, double t_M) {
  return trajectory.Covers(t_M - kSegmentEdge, t_M + kSegmentEdge);
}

}  // namespace imu_pose_calib
