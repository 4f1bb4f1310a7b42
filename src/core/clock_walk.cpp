#include "imu_pose_calib/core/clock_walk.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "imu_pose_calib/core/initializer.h"
#include "imu_pose_calib/core/median.h"

namespace imu_pose_calib {
namespace {

constexpr double kInterval = 1.0;   // [s] between knots
constexpr double kRate = 100.0;     // [Hz] of the samples looked at
constexpr double kRobust = 5.0;     // sigma, Cauchy's scale of a sample
constexpr double kEvidence = 10.0;  // log likelihood by which a walk must beat a line
// Densities that are tried [s/sqrt(s)], evenly in the logarithm.
constexpr double kLeastDensity = 1e-7, kMostDensity = 1e-2;
constexpr int kDensities = 50;
constexpr int kRounds = 4;         // each about the clock of the one before
constexpr int kReweightings = 10;  // of the increments

/// A gyroscope sample and the marker where the clock puts it.
struct Sample {
  double t;              ///< [s] IMU clock
  Eigen::Vector3d r, a;  ///< [rad/s] measured less expected, [rad/s^2] its growth with the offset
};

/// Offsets near the knots, as the samples around each tell alone.
struct LocalOffsets {
  std::vector<double> z, variance;  ///< [s], [s^2]; infinite where there is no motion
};

/// A random walk through local offsets whose variances are known up to a factor.
struct Walk {
  double log_likelihood = -std::numeric_limits<double>::infinity();
  double scale2 = 1.0;                   ///< that factor
  double density2 = 0.0;                 ///< [s] of the increments, in units of scale2
  std::vector<double> offset;            ///< [s] smoothed
  std::vector<double> increment2;        ///< [s^2] expected squares of the increments
};

std::vector<Sample> Compare(const PoseTrajectory& trajectory,
                            const std::vector<TimedSample>& gyro,
                            const ClockLine& line,
                            const ClockWalk& walk) {
  const double duration = gyro.back().t - gyro.front().t;
  const size_t stride =
      std::max<size_t>(1, static_cast<size_t>(static_cast<double>(gyro.size()) / duration / kRate));
  std::vector<RatePair> pairs;
  std::vector<double> t;
  std::vector<Eigen::Vector3d> alpha_M;
  for (size_t i = 0; i < gyro.size(); i += stride) {
    const double t_M = line.PoseTime(gyro[i].t) + walk.At(gyro[i].t);
    MarkerRotation<double> marker;
    if (!trajectory.EvaluateRotation(t_M, &marker)) continue;
    pairs.push_back({t_M, marker.omega_M, gyro[i].value});
    t.push_back(gyro[i].t);
    alpha_M.push_back(marker.alpha_M);
  }
  std::vector<Sample> samples;
  if (pairs.size() < 3) return samples;
  const RateAlignment alignment = AlignRates(pairs);
  for (size_t i = 0; i < pairs.size(); ++i)
    samples.push_back(
        {t[i], alignment.Residual(pairs[i]), alignment.q_MI.conjugate() * alpha_M[i]});
  return samples;
}

LocalOffsets FindLocal(const std::vector<Sample>& samples, const ClockWalk& walk) {
  const auto count = static_cast<Eigen::Index>(walk.t.size());
  std::vector<double> magnitudes;
  for (const Sample& s : samples)
    for (int axis = 0; axis < 3; ++axis) magnitudes.push_back(s.r[axis]);
  const double sigma = RobustSigma(std::move(magnitudes));
  Eigen::VectorXd information = Eigen::VectorXd::Zero(count), sum = information;
  for (const Sample& s : samples) {
    const auto knot = static_cast<Eigen::Index>(std::round((s.t - walk.t[0]) / kInterval));
    const double weight = 1.0 / (1.0 + s.r.squaredNorm() / std::pow(kRobust * sigma, 2));
    information[knot] += weight * s.a.squaredNorm();
    sum[knot] += weight * s.a.dot(s.r);
  }
  LocalOffsets local;
  for (Eigen::Index k = 0; k < count; ++k) {
    local.z.push_back(walk.offset[static_cast<size_t>(k)] +
                      (information[k] > 0.0 ? sum[k] / information[k] : 0.0));
    local.variance.push_back(sigma * sigma / information[k]);
  }
  return local;
}

/// Kalman filter and smoother. `growth2`: variance of each increment for a density of 1.
Walk Smooth(const LocalOffsets& local, const std::vector<double>& growth2, double density2) {
  const size_t n = local.z.size();
  Walk walk;
  walk.density2 = density2;
  std::vector<double> x(n), P(n), x_before(n), P_before(n);
  double sum = 0.0, log_variance = 0.0, count = 0.0;
  bool is_known = false;
  for (size_t k = 0; k < n; ++k) {
    x_before[k] = k == 0 ? 0.0 : x[k - 1];
    P_before[k] = k == 0 ? 0.0 : P[k - 1] + density2 * growth2[k - 1];
    x[k] = x_before[k];
    P[k] = P_before[k];
    if (!std::isfinite(local.variance[k])) continue;
    if (!is_known) {  // nothing is known of the first
      x[k] = local.z[k];
      P[k] = local.variance[k];
      is_known = true;
      continue;
    }
    const double innovation = local.z[k] - x_before[k];
    const double F = P_before[k] + local.variance[k];
    sum += innovation * innovation / F;
    log_variance += std::log(F);
    count += 1.0;
    x[k] += P_before[k] / F * innovation;
    P[k] *= 1.0 - P_before[k] / F;
  }
  if (count < 1.0) return walk;
  walk.scale2 = sum / count;
  walk.log_likelihood = -0.5 * (count * std::log(walk.scale2) + log_variance);
  walk.offset = x;
  walk.increment2.resize(n - 1);
  for (size_t k = n - 1; k-- > 0;) {
    const double gain = P_before[k + 1] > 0.0 ? P[k] / P_before[k + 1] : 1.0;
    const double after = P[k + 1];
    walk.offset[k] = x[k] + gain * (walk.offset[k + 1] - x_before[k + 1]);
    P[k] += gain * gain * (after - P_before[k + 1]);
    walk.increment2[k] = std::pow(walk.offset[k + 1] - walk.offset[k], 2) +
                         walk.scale2 * std::max(0.0, after + P[k] - 2.0 * gain * after);
  }
  return walk;
}

/// The likeliest density. Increments have Cauchy's distribution, so that a step is one of them:
/// they are normal with the variances in `growth2`, which are found along.
Walk FindWalk(const LocalOffsets& local, std::vector<double>* growth2) {
  Walk best;
  for (int iteration = 0; iteration < kReweightings; ++iteration) {
    best = Walk();
    for (int k = 0; k < kDensities; ++k) {
      const double density =
          kLeastDensity * std::pow(kMostDensity / kLeastDensity, k / (kDensities - 1.0));
      const Walk walk = Smooth(local, *growth2, density * density);
      if (walk.log_likelihood > best.log_likelihood) best = walk;
    }
    for (size_t k = 0; k < growth2->size() && !best.offset.empty(); ++k)
      (*growth2)[k] =
          0.5 * (kInterval + best.increment2[k] / (best.scale2 * best.density2));
  }
  return best;
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

ClockWalk FitClockWalk(const PoseTrajectory& trajectory,
                       const std::vector<TimedSample>& gyro,
                       ClockLine* line) {
  const auto knots = [&](double t) {
    return std::ceil(std::abs(t - line->clock_reference) / kInterval);
  };
  ClockWalk walk;
  walk.reference = static_cast<size_t>(knots(gyro.front().t));
  const size_t count = walk.reference + static_cast<size_t>(knots(gyro.back().t)) + 1;
  for (size_t k = 0; k < count; ++k)
    walk.t.push_back(line->clock_reference + kInterval * (static_cast<double>(k) -
                                                          static_cast<double>(walk.reference)));
  walk.offset.assign(count, 0.0);
  if (count < 5) return {};
  std::vector<double> growth2(count - 1, kInterval);
  Walk found;
  for (int round = 0; round < kRounds; ++round) {
    const LocalOffsets local = FindLocal(Compare(trajectory, gyro, *line, walk), walk);
    found = FindWalk(local, &growth2);
    if (found.offset.empty()) return {};
    double increments = 0.0;  // what it costs that they are not all alike
    for (const double growth : growth2) increments += 0.5 * std::log(growth / kInterval);
    const Walk none = Smooth(local, growth2, 0.0);
    if (round == 0 && found.log_likelihood - none.log_likelihood < kEvidence + std::max(0.0, increments))
      return {};
    walk.offset = found.offset;
  }
  for (size_t k = 0; k + 1 < count; ++k)
    walk.std.push_back(std::sqrt(found.scale2 * found.density2 * growth2[k]));
  const double shift = walk.offset[walk.reference];
  for (double& offset : walk.offset) offset -= shift;
  line->time_shift += shift;
  return walk;
}

}  // namespace imu_pose_calib
