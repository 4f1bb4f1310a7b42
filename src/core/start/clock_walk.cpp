#include "imu_pose_calib/core/start/clock_walk.h"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/start/rate_alignment.h"

namespace imu_pose_calib {
namespace {

constexpr double kInterval = 1.0;  // [s] between knots
constexpr double kRate = 100.0;    // [Hz] of the samples looked at
// Errors of the rates that last for a knot: of the bias [rad/s], of scale and attitude [1].
constexpr double kRateError = 2e-3, kTurnError = 5e-3;
constexpr int kLocal = 13;          // offset, bias, matrix
constexpr double kReach = 0.02;     // [s] to either side, of the gyroscope's derivative
constexpr double kRobust = 5.0;     // sigma, Cauchy's scale of a sample
constexpr double kEvidence = 10.0;  // log likelihood by which a walk must beat a line
// Densities that are tried [s/sqrt(s)], evenly in the logarithm.
constexpr double kLeastDensity = 1e-7, kMostDensity = 1e-2;
constexpr int kDensities = 25;
constexpr double kUnknown = 1.0;     // [s] sigma of the first offset
constexpr int kRounds = 4;           // each about the clock of the one before
constexpr int kReweightings = 20;    // of increments and offsets
constexpr double kStep = 4.0;        // times the usual increment: a step
constexpr double kLeastStep = 5e-4;  // [s]

/// Offsets near the knots, as the samples around each tell alone.
struct LocalOffsets {
  std::vector<double> z, variance;  ///< [s], [s^2]; infinite where there is no motion
};

/// Variances of increments and of local offsets as multiples of the usual ones: both have Cauchy's
/// distribution, so that a step is one increment, and a mistake of the poses one offset.
struct Tails {
  std::vector<double> increments, offsets;
};

/// A random walk through local offsets whose variances are known up to a factor.
struct Walk {
  double log_likelihood = -std::numeric_limits<double>::infinity();
  double scale2 = 1.0;             ///< that factor
  double density2 = 0.0;           ///< in units of scale2
  std::vector<double> offset;      ///< [s] smoothed
  std::vector<double> increment2;  ///< expected squares of the increments less the drift, and of
  std::vector<double> error2;      ///< the local offsets' errors, in usual variances
};

/// [rad/s^2] of a residual with the offset. That it is the gyroscope's and not the poses' keeps
/// mistakes of these from looking like motion.
Eigen::Vector3d Growth(const std::vector<TimedSample>& gyro, size_t sample) {
  size_t begin = sample, end = sample;
  while (begin > 0 && gyro[begin].t > gyro[sample].t - kReach) --begin;
  while (end + 1 < gyro.size() && gyro[end].t < gyro[sample].t + kReach) ++end;
  return (gyro[end].value - gyro[begin].value) / (gyro[end].t - gyro[begin].t);
}

/// Around each knot least squares for the offset, beside errors of the rates that last as long: of
/// the bias, and of scale, axes and attitude. They have priors, so that where the body rests the
/// samples tell nothing.
LocalOffsets FindLocal(const std::vector<TimedSample>& gyro, const std::vector<RatePair>& pairs,
                       const RateAlignment& alignment, const ClockWalk& walk) {
  using Information = Eigen::Matrix<double, kLocal, kLocal>;
  using Vector = Eigen::Matrix<double, kLocal, 1>;
  std::vector<double> residuals;
  for (const RatePair& pair : pairs) {
    const Eigen::Vector3d r = alignment.Residual(pair.gyro->value, pair.marker.omega_M);
    residuals.insert(residuals.end(), r.data(), r.data() + 3);
  }
  const double sigma = RobustSigma(residuals);
  Vector prior = Vector::Constant(std::pow(sigma / kRateError, 2));
  prior[0] = 0.0;
  prior.tail<9>().setConstant(std::pow(sigma / kTurnError, 2));
  std::vector<Information> H(walk.t.size(), prior.asDiagonal());
  std::vector<Vector> b(walk.t.size(), Vector::Zero());
  std::vector<double> spurious(walk.t.size(), 0.0);  // information that is the noise of the growth
  const double growth_noise2 = 1.5 * std::pow(sigma / kReach, 2);
  for (size_t i = 0; i < pairs.size(); ++i) {
    const TimedSample& s = *pairs[i].gyro;
    const Eigen::Map<const Eigen::Vector3d> r(&residuals[3 * i]);
    const auto knot = static_cast<size_t>(std::round((s.t - walk.t[0]) / kInterval));
    const double weight = 1.0 / (1.0 + r.squaredNorm() / std::pow(kRobust * sigma, 2));
    Eigen::Matrix<double, 3, kLocal> J = Eigen::Matrix<double, 3, kLocal>::Zero();
    J.col(0) = Growth(gyro, static_cast<size_t>(&s - gyro.data()));
    J.block<3, 3>(0, 1).setIdentity();
    for (int axis = 0; axis < 3; ++axis) J.block<1, 3>(axis, 4 + 3 * axis) = s.value.transpose();
    H[knot] += (weight * J.transpose()).lazyProduct(J);
    b[knot] += (weight * J.transpose()).lazyProduct(r);
    spurious[knot] += weight * growth_noise2;
  }
  LocalOffsets local;
  for (size_t k = 0; k < walk.t.size(); ++k) {
    local.z.push_back(walk.offset[k]);
    local.variance.push_back(std::numeric_limits<double>::infinity());
    if (spurious[k] == 0.0) continue;
    const double information = 1.0 / Solve(H[k], Vector::Unit(0))(0) - spurious[k];
    if (information <= 0.0) continue;
    local.z[k] += Solve(H[k], b[k])(0);
    local.variance[k] = sigma * sigma / information;
  }
  return local;
}

/// Kalman filter of (offset, drift) at the knots, and Rauch-Tung-Striebel smoother.
Walk Smooth(const LocalOffsets& local, const Tails& tails, double density2) {
  const size_t n = local.z.size();
  Eigen::Matrix2d F = Eigen::Matrix2d::Identity();  // from one knot to the next
  F(0, 1) = kInterval;
  std::vector<Eigen::Vector2d> x(n, Eigen::Vector2d::Zero()), predicted_x = x;
  std::vector<Eigen::Matrix2d> P(n), predicted_P(n);
  P[0] = Eigen::Vector2d(kUnknown * kUnknown, kDriftPrior * kDriftPrior).asDiagonal();
  double sum = 0.0, log_variance = 0.0, count = 0.0;  // of the innovations
  for (size_t k = 0; k < n; ++k) {
    if (k > 0) {
      x[k] = F * x[k - 1];
      P[k] = F * P[k - 1] * F.transpose();
      P[k](0, 0) += density2 * kInterval * tails.increments[k - 1];
    }
    predicted_x[k] = x[k];
    predicted_P[k] = P[k];
    if (!std::isfinite(local.variance[k])) continue;
    const double innovation = local.z[k] - x[k][0];
    const double variance = P[k](0, 0) + local.variance[k] * tails.offsets[k];
    if (variance < 0.1 * kUnknown * kUnknown) {
      sum += innovation * innovation / variance;
      log_variance += std::log(variance);
      count += 1.0;
    }
    const Eigen::Vector2d gain = P[k].col(0) / variance;
    x[k] += gain * innovation;
    P[k] -= gain * gain.transpose() * variance;
  }
  Walk walk;
  walk.density2 = density2;
  if (count < 1.0) return walk;
  walk.scale2 = sum / count;
  walk.log_likelihood = -0.5 * (count * std::log(walk.scale2) + log_variance);
  walk.offset.resize(n);
  walk.increment2.resize(n - 1);
  walk.error2.assign(n, 1.0);
  for (size_t k = n; k-- > 0;) {
    if (k + 1 < n) {
      const Eigen::Matrix2d gain = P[k] * F.transpose() * predicted_P[k + 1].inverse();
      x[k] += gain * (x[k + 1] - predicted_x[k + 1]);
      P[k] += gain * (P[k + 1] - predicted_P[k + 1]) * gain.transpose();
      const double increment = x[k + 1][0] - x[k][0] - kInterval * x[k][1];
      const double variance = P[k + 1](0, 0) + P[k](0, 0) - 2.0 * (gain * P[k + 1])(0, 0);
      walk.increment2[k] =
          (increment * increment / walk.scale2 + std::max(0.0, variance)) / (density2 * kInterval);
    }
    walk.offset[k] = x[k][0];
    if (!std::isfinite(local.variance[k])) continue;
    walk.error2[k] =
        (std::pow(local.z[k] - x[k][0], 2) / walk.scale2 + P[k](0, 0)) / local.variance[k];
  }
  return walk;
}

/// The likeliest walk, or line.
Walk FindWalk(const LocalOffsets& local, bool is_line, Tails* tails) {
  Walk best;
  for (int iteration = 0; iteration < kReweightings; ++iteration) {
    best = Walk();
    for (int k = 0; k < (is_line ? 1 : kDensities); ++k) {
      const double density =
          kLeastDensity * std::pow(kMostDensity / kLeastDensity, k / (kDensities - 1.0));
      Walk walk = Smooth(local, *tails, is_line ? 0.0 : density * density);
      if (walk.log_likelihood > best.log_likelihood) best = std::move(walk);
    }
    if (best.offset.empty()) return best;
    for (size_t k = 0; k < tails->offsets.size(); ++k)
      tails->offsets[k] = 0.5 * (1.0 + best.error2[k]);
    for (size_t k = 0; best.density2 > 0.0 && k < tails->increments.size(); ++k)
      tails->increments[k] = 0.5 * (1.0 + best.increment2[k]);
  }
  // Of what the variances are that were found along, by Cauchy's distribution.
  for (const auto* values : {&tails->offsets, &tails->increments})
    for (const double value : *values) best.log_likelihood -= 1.5 * std::log(value) + 0.5 / value;
  return best;
}

/// The sample from `begin` to `end` [s, IMU clock] after which a step from the offset `before` to
/// `after` [s] explains the rates best.
size_t FindStep(const PoseTrajectory& trajectory, const std::vector<TimedSample>& gyro,
                const ClockLine& line, const RateAlignment& alignment, double begin, double end,
                double before, double after) {
  const auto is_before = [](const TimedSample& s, double t) { return s.t < t; };
  const auto first = std::lower_bound(gyro.begin(), gyro.end(), begin, is_before);
  const auto last = std::lower_bound(first, gyro.end(), end, is_before);
  double gain = 0.0, most = 0.0;
  size_t best = static_cast<size_t>(first - gyro.begin());
  for (auto s = first; s != last; ++s) {
    const auto squared = [&](double offset) {
      const double t_M = line.PoseTime(s->t) + offset;
      MarkerRotation<double> marker;
      if (!trajectory.EvaluateRotation(t_M, &marker)) return 0.0;
      return alignment.Residual(s->value, marker.omega_M).squaredNorm();
    };
    gain += squared(after) - squared(before);
    if (gain <= most) continue;
    most = gain;
    best = static_cast<size_t>(s - gyro.begin());
  }
  return best;
}

/// No walk, at knots over the samples.
ClockWalk EvenKnots(const std::vector<TimedSample>& gyro, double reference) {
  const double before = std::ceil((reference - gyro.front().t) / kInterval);
  const double after = std::ceil((gyro.back().t - reference) / kInterval);
  ClockWalk walk;
  walk.reference = static_cast<size_t>(before);
  for (double k = -before; k <= after; ++k) walk.t.push_back(reference + kInterval * k);
  walk.offset.assign(walk.t.size(), 0.0);
  return walk;
}

/// A knot of a walk and what comes after it.
struct Knot {
  double t, offset, std;
  bool steps;
};

/// Puts two knots for each step between the samples that it parts, of which the walk so far is a
/// ramp over some knots. `increment_std`: of the walk beside them, over kInterval.
void CutAtSteps(const PoseTrajectory& trajectory, const std::vector<TimedSample>& gyro,
                const RateAlignment& alignment, const std::vector<double>& tails,
                double increment_std, Clock* clock) {
  const std::vector<double>&t = clock->walk.t, &offset = clock->walk.offset;
  const size_t last = t.size() - 1;
  std::vector<Knot> knots;
  for (size_t k = 0; k <= last; ++k)
    knots.push_back({t[k], offset[k], k < last ? clock->walk.std[k] : 0.0, false});
  const auto rise = [&](size_t k) {
    return k == 0 || k == last ? 0.0 : std::abs(offset[k + 1] - offset[k - 1]);
  };
  for (size_t k = 1; k < last; ++k) {
    // The window of knot k has the step: the walk rises before and after it.
    if (std::max(tails[k - 1], tails[k]) < kStep * kStep || rise(k) < kLeastStep) continue;
    if (rise(k - 1) > rise(k) || rise(k + 1) >= rise(k)) continue;
    const double before = offset[k - 1], after = offset[k + 1];
    const size_t sample =
        FindStep(trajectory, gyro, *clock, alignment, t[k - 1], t[k + 1], before, after);
    if (sample + 1 >= gyro.size()) continue;
    // Between the samples, and beside the knot that may lie there.
    const double next = gyro[sample + 1].t;
    const double begin = t[k] < next ? std::max(gyro[sample].t, t[k]) : gyro[sample].t;
    const double u = 0.25 * (next - begin);
    knots[k - 1].std = knots[k].std = increment_std;
    knots[k].offset = t[k] <= begin ? before : after;
    knots.push_back({begin + u, before, std::abs(after - before), true});
    knots.push_back({next - u, after, increment_std, false});
  }
  std::sort(knots.begin(), knots.end(), [](const Knot& a, const Knot& b) { return a.t < b.t; });
  ClockWalk cut;
  for (const Knot& knot : knots) {
    if (knot.steps) cut.steps.push_back(cut.t.size());
    if (knot.t == clock->clock_reference) cut.reference = cut.t.size();
    cut.t.push_back(knot.t);
    cut.offset.push_back(knot.offset);
    cut.std.push_back(knot.std);
  }
  cut.std.pop_back();
  clock->walk = std::move(cut);
}

}  // namespace

std::pair<size_t, double> ClockWalk::Locate(double instant) const {
  const auto after = std::upper_bound(t.begin() + 1, t.end() - 1, instant);
  const auto k = static_cast<size_t>(after - t.begin()) - 1;
  return {k, std::clamp((instant - t[k]) / (t[k + 1] - t[k]), 0.0, 1.0)};
}

double ClockWalk::At(double instant) const {
  if (IsLine()) return 0.0;
  const auto [k, u] = Locate(instant);
  return (1.0 - u) * offset[k] + u * offset[k + 1];
}

double Clock::ImuTime(double t_M) const {
  double t = ClockLine::ImuTime(t_M);
  // The walk is slow: each round leaves what it changes by within the change of the last one.
  for (int round = 0; round < 4 && !walk.IsLine(); ++round)
    t = ClockLine::ImuTime(t_M - walk.At(t));
  return t;
}

void FitClockWalk(const PoseTrajectory& trajectory, const std::vector<TimedSample>& gyro,
                  Clock* clock) {
  Clock found = *clock;
  ClockWalk& walk = found.walk;
  walk = EvenKnots(gyro, clock->clock_reference);
  const size_t count = walk.t.size();
  if (count < 5) return;
  const double rate = static_cast<double>(gyro.size()) / (gyro.back().t - gyro.front().t);
  const size_t stride = std::max<size_t>(1, static_cast<size_t>(rate / kRate));
  Tails tails{std::vector<double>(count - 1, 1.0), std::vector<double>(count, 1.0)};
  Tails of_line = tails;
  Walk smoothed;
  RateAlignment alignment;
  for (int round = 0; round < kRounds; ++round) {
    const auto pairs =
        PairRates(trajectory, gyro, stride, [&](double t) { return found.PoseTime(t); });
    alignment = AlignRates(pairs);
    const LocalOffsets local = FindLocal(gyro, pairs, alignment, walk);
    smoothed = FindWalk(local, false, &tails);
    if (smoothed.offset.empty()) return;
    if (round == 0 &&
        smoothed.log_likelihood < FindWalk(local, true, &of_line).log_likelihood + kEvidence)
      return;
    walk.offset = smoothed.offset;
  }
  const double usual = std::sqrt(smoothed.scale2 * smoothed.density2 * kInterval);
  for (size_t k = 0; k + 1 < count; ++k) walk.std.push_back(usual * std::sqrt(tails.increments[k]));
  CutAtSteps(trajectory, gyro, alignment, tails.increments, usual, &found);
  const double shift = walk.offset[walk.reference];
  for (double& offset : walk.offset) offset -= shift;
  found.time_shift += shift;
  *clock = std::move(found);
}

}  // namespace imu_pose_calib
