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

/// A gyroscope sample and the marker where the clock puts it. That the growth is the gyroscope's
/// and not the poses' keeps mistakes of these from looking like motion.
struct Sample {
  double t;               ///< [s] IMU clock
  Eigen::Vector3d r, a;   ///< [rad/s] measured less expected, [rad/s^2] its growth with the offset
  Eigen::Vector3d omega;  ///< [rad/s] measured
};

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

/// [rad/s^2] of the sample's time.
Eigen::Vector3d Growth(const std::vector<TimedSample>& gyro, size_t sample) {
  size_t begin = sample, end = sample;
  while (begin > 0 && gyro[begin].t > gyro[sample].t - kReach) --begin;
  while (end + 1 < gyro.size() && gyro[end].t < gyro[sample].t + kReach) ++end;
  return (gyro[end].value - gyro[begin].value) / (gyro[end].t - gyro[begin].t);
}

/// Every sample that the clock puts on the trajectory, about kRate, and how the rates align there.
std::vector<Sample> Compare(const PoseTrajectory& trajectory, const std::vector<TimedSample>& gyro,
                            const ClockLine& line, const ClockWalk& walk,
                            RateAlignment* alignment) {
  const double duration = gyro.back().t - gyro.front().t;
  const size_t stride =
      std::max<size_t>(1, static_cast<size_t>(static_cast<double>(gyro.size()) / duration / kRate));
  std::vector<RatePair> pairs;
  std::vector<Sample> samples;
  for (size_t i = 0; i < gyro.size(); i += stride) {
    const double t_M = line.PoseTime(gyro[i].t) + walk.At(gyro[i].t);
    MarkerRotation<double> marker;
    if (!trajectory.EvaluateRotation(t_M, &marker)) continue;
    pairs.push_back({t_M, marker.omega_M, gyro[i].value});
    samples.push_back({gyro[i].t, Eigen::Vector3d::Zero(), Growth(gyro, i), gyro[i].value});
  }
  *alignment = AlignRates(pairs);
  for (size_t i = 0; i < pairs.size(); ++i) samples[i].r = alignment->Residual(pairs[i]);
  return samples;
}

/// Around each knot least squares for the offset, beside errors of the rates that last as long: of
/// the bias, and of scale, axes and attitude. They have priors, so that where the body rests the
/// samples tell nothing.
LocalOffsets FindLocal(const std::vector<Sample>& samples, const ClockWalk& walk) {
  using Information = Eigen::Matrix<double, kLocal, kLocal>;
  using Vector = Eigen::Matrix<double, kLocal, 1>;
  std::vector<double> magnitudes;
  for (const Sample& s : samples)
    for (int axis = 0; axis < 3; ++axis) magnitudes.push_back(s.r[axis]);
  const double sigma = RobustSigma(std::move(magnitudes));
  Vector prior = Vector::Constant(std::pow(sigma / kRateError, 2));
  prior[0] = 0.0;
  prior.tail<9>().setConstant(std::pow(sigma / kTurnError, 2));
  std::vector<Information> H(walk.t.size(), prior.asDiagonal());
  std::vector<Vector> b(walk.t.size(), Vector::Zero());
  std::vector<double> spurious(walk.t.size(), 0.0);  // information that is the noise of the growth
  const double growth_noise2 = 1.5 * std::pow(sigma / kReach, 2);
  for (const Sample& s : samples) {
    const auto knot = static_cast<size_t>(std::round((s.t - walk.t[0]) / kInterval));
    const double weight = 1.0 / (1.0 + s.r.squaredNorm() / std::pow(kRobust * sigma, 2));
    Eigen::Matrix<double, 3, kLocal> J = Eigen::Matrix<double, 3, kLocal>::Zero();
    J.col(0) = s.a;
    J.block<3, 3>(0, 1).setIdentity();
    for (int axis = 0; axis < 3; ++axis) J.block<1, 3>(axis, 4 + 3 * axis) = s.omega.transpose();
    H[knot] += (weight * J.transpose()).lazyProduct(J);
    b[knot] += (weight * J.transpose()).lazyProduct(s.r);
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

/// The likeliest walk of these densities [s/sqrt(s)]; 0: of none.
Walk FindWalk(const LocalOffsets& local, const std::vector<double>& densities, Tails* tails) {
  Walk best;
  for (int iteration = 0; iteration < kReweightings; ++iteration) {
    best = Walk();
    for (const double density : densities) {
      Walk walk = Smooth(local, *tails, density * density);
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
      return alignment.Residual({t_M, marker.omega_M, s->value}).squaredNorm();
    };
    gain += squared(after) - squared(before);
    if (gain <= most) continue;
    most = gain;
    best = static_cast<size_t>(s - gyro.begin());
  }
  return best;
}

/// Puts two knots for each step between the samples that it parts, of which the walk so far is a
/// ramp over some knots. `increment_std`: of the walk beside them, over kInterval.
void CutAtSteps(const PoseTrajectory& trajectory, const std::vector<TimedSample>& gyro,
                const ClockLine& line, const RateAlignment& alignment,
                const std::vector<double>& tails, double increment_std, ClockWalk* walk) {
  const ClockWalk ramps = *walk;
  const auto rise = [&](size_t k) { return std::abs(ramps.offset[k + 1] - ramps.offset[k - 1]); };
  for (size_t k = 1; k + 1 < ramps.t.size(); ++k) {
    // The window of knot k has the step: the walk rises before and after it.
    if (std::max(tails[k - 1], tails[k]) < kStep * kStep || rise(k) < kLeastStep) continue;
    if ((k > 1 && rise(k - 1) > rise(k)) || (k + 2 < ramps.t.size() && rise(k + 1) >= rise(k)))
      continue;
    const double before = ramps.offset[k - 1], after = ramps.offset[k + 1];
    const size_t sample =
        FindStep(trajectory, gyro, line, alignment, ramps.t[k - 1], ramps.t[k + 1], before, after);
    if (sample + 1 >= gyro.size()) continue;
    // Between the samples, on which other knots may lie.
    const double u = 0.25, begin = (1.0 - u) * gyro[sample].t + u * gyro[sample + 1].t;
    const double end = u * gyro[sample].t + (1.0 - u) * gyro[sample + 1].t;
    const auto place = std::upper_bound(walk->t.begin(), walk->t.end(), begin);
    const auto at = static_cast<size_t>(place - walk->t.begin());
    if (at == 0 || at + 1 >= walk->t.size()) continue;
    if (walk->t[at] <= end) {  // a knot that the step leaves out
      if (at == walk->reference) continue;
      for (auto* values : {&walk->t, &walk->offset, &walk->std})
        values->erase(values->begin() + static_cast<ptrdiff_t>(at));
      if (at < walk->reference) --walk->reference;
    }
    for (size_t i = 0; i + 1 < walk->t.size(); ++i) {
      if (walk->t[i] < ramps.t[k - 1] || walk->t[i] > ramps.t[k]) continue;
      if (walk->t[i] == ramps.t[k]) walk->offset[i] = i < at ? before : after;
      walk->std[i] = increment_std;
    }
    const auto insert = [at](auto* values, auto first, auto second) {
      values->insert(values->begin() + static_cast<ptrdiff_t>(at), {first, second});
    };
    insert(&walk->t, begin, end);
    insert(&walk->offset, before, after);
    insert(&walk->std, std::abs(after - before), increment_std);
    if (at <= walk->reference) walk->reference += 2;
    walk->steps.push_back(at);
  }
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

ClockWalk FitClockWalk(const PoseTrajectory& trajectory, const std::vector<TimedSample>& gyro,
                       ClockLine* line) {
  const auto knots = [&](double t) {
    return static_cast<size_t>(std::ceil(std::abs(t - line->clock_reference) / kInterval));
  };
  ClockWalk walk;
  walk.reference = knots(gyro.front().t);
  const size_t count = walk.reference + knots(gyro.back().t) + 1;
  if (count < 5) return {};
  for (size_t k = 0; k < count; ++k)
    walk.t.push_back(line->clock_reference +
                     kInterval * (static_cast<double>(k) - static_cast<double>(walk.reference)));
  walk.offset.assign(count, 0.0);
  std::vector<double> densities;
  for (int k = 0; k < kDensities; ++k)
    densities.push_back(kLeastDensity *
                        std::pow(kMostDensity / kLeastDensity, k / (kDensities - 1.0)));
  Tails tails{std::vector<double>(count - 1, 1.0), std::vector<double>(count, 1.0)};
  Tails of_line = tails;
  Walk found;
  RateAlignment alignment;
  for (int round = 0; round < kRounds; ++round) {
    const LocalOffsets local = FindLocal(Compare(trajectory, gyro, *line, walk, &alignment), walk);
    found = FindWalk(local, densities, &tails);
    if (found.offset.empty()) return {};
    if (round == 0 &&
        found.log_likelihood < FindWalk(local, {0.0}, &of_line).log_likelihood + kEvidence)
      return {};
    walk.offset = found.offset;
  }
  const double usual = std::sqrt(found.scale2 * found.density2 * kInterval);
  for (size_t k = 0; k + 1 < count; ++k) walk.std.push_back(usual * std::sqrt(tails.increments[k]));
  CutAtSteps(trajectory, gyro, *line, alignment, tails.increments, usual, &walk);
  const double shift = walk.offset[walk.reference];
  for (double& offset : walk.offset) offset -= shift;
  line->time_shift += shift;
  return walk;
}

}  // namespace imu_pose_calib
