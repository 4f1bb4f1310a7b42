#include "imu_pose_calib/core/source_clock.h"

#include <Eigen/Core>
#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>
#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

#include "imu_pose_calib/core/frame_count.h"
#include "imu_pose_calib/core/median.h"

namespace imu_pose_calib {
namespace {

constexpr double kMaxPause = 10.0;   // [s] across which frames are counted
constexpr size_t kMinRun = 100;      // samples that make a clock, and
constexpr double kMinRunTime = 5.0;  // [s]
constexpr double kMinRecovered = 0.9;

constexpr double kKnotSpacing = 10.0;  // [s]
constexpr double kRateStep = 1e-5;     // sigma of the change of the rate at a knot
constexpr double kHuber = 1.5;         // sigma
constexpr int kRounds = 15, kCounts = 2;
/// A quantile is used when its sigma is below so much of that of the mean; a density is bounded by
/// that of so much of the sigma.
constexpr double kMaxQuantileStd = 0.7, kSharpest = 0.02;

/// The clock breaks where the latency changes by more than a part of a period, and of its sigma,
/// between two blocks: of so many samples, at least, and so long [s]. Not in most blocks, and on
/// average not as often as this [s].
constexpr double kMaxChange = 0.15, kMaxChangeSigmas = 0.6;
constexpr size_t kBlock = 50;
constexpr double kBlockTime = 2.0;
constexpr double kMaxBroken = 0.5, kBreakInterval = 20.0;

/// Frames that miss: at most before this share of the samples, and so rarely that a period is so
/// many sigma of the mean latency between. Where they are said to miss, the latency of so many
/// samples on either side is the same, within a part of a period and so many sigma.
constexpr double kMaxJumps = 0.3, kJumpSigmas = 4.0;
constexpr size_t kNear = 5;
constexpr double kMaxDrop = 0.05, kMaxDropSigmas = 2.0;

double RobustSigma(std::vector<double> values) {
  for (double& value : values) value = std::abs(value);
  return kMadToSigma * Median(std::move(values));
}

/// Latency [s] of the stamps t [s] about a clock whose offset from period * frame is linear between
/// knots: their mean, robust, or a quantile of them if it is not 0. Changes of the rate are few.
std::vector<double> FitClock(const std::vector<double>& t,
                             const FrameCount& count,
                             double period,
                             double quantile = 0.0) {
  const auto n = static_cast<double>(count.frames.back());
  const auto intervals = static_cast<int>(std::max(1.0, std::round(n * period / kKnotSpacing)));
  const double spacing = n / intervals;  // in frames
  const auto place = [&](size_t i) {
    const double u = static_cast<double>(count.frames[i]) / spacing;
    const int knot = std::min(static_cast<int>(u), intervals - 1);
    return std::make_pair(knot, u - knot);
  };
  std::vector<double> y(t.size());
  for (size_t i = 0; i < t.size(); ++i) y[i] = t[i] - period * static_cast<double>(count.frames[i]);
  const double bend_sigma = kRateStep * spacing * period;
  const auto weight = [](double r, double sigma) {
    return std::min(1.0, kHuber * sigma / (std::abs(r) + 1e-12));
  };
  constexpr std::array<double, 3> kBend = {1.0, -2.0, 1.0};
  const int size = intervals + 1;
  Eigen::VectorXd c = Eigen::VectorXd::Constant(size, Median(y));
  std::vector<double> r(t.size());
  const auto update = [&] {
    for (size_t i = 0; i < t.size(); ++i) {
      const auto [knot, part] = place(i);
      r[i] = y[i] - (1.0 - part) * c[knot] - part * c[knot + 1];
    }
  };
  update();
  for (int round = 0; round < kRounds; ++round) {
    const double sigma = std::max(RobustSigma(r), 1e-4 * period);
    std::vector<Eigen::Triplet<double>> H;
    Eigen::VectorXd b = Eigen::VectorXd::Zero(size);
    for (size_t i = 0; i < t.size(); ++i) {
      const auto [knot, part] = place(i);
      const std::array<double, 2> row = {1.0 - part, part};
      const double w = quantile == 0.0 ? weight(r[i], sigma)
                                       : (r[i] > 0.0 ? quantile : 1.0 - quantile) * sigma /
                                             std::max(std::abs(r[i]), kSharpest * sigma);
      for (int k = 0; k < 2; ++k) {
        b[knot + k] += w * row[static_cast<size_t>(k)] * y[i];
        for (int l = 0; l < 2; ++l)
          H.emplace_back(
              knot + k, knot + l, w * row[static_cast<size_t>(k)] * row[static_cast<size_t>(l)]);
      }
    }
    for (int knot = 0; knot + 2 < size; ++knot) {
      const double bend = c[knot] - 2.0 * c[knot + 1] + c[knot + 2];
      const double w = weight(bend, bend_sigma) * std::pow(sigma / bend_sigma, 2);
      for (int k = 0; k < 3; ++k)
        for (int l = 0; l < 3; ++l)
          H.emplace_back(knot + k,
                         knot + l,
                         w * kBend[static_cast<size_t>(k)] * kBend[static_cast<size_t>(l)]);
    }
    Eigen::SparseMatrix<double> matrix(size, size);
    matrix.setFromTriplets(H.begin(), H.end());
    c = Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>>(matrix).solve(b);
    update();
  }
  return r;
}

/// The quantile of the latencies that is known best, from the density there; 0 for the mean. Of
/// latencies that are often small and sometimes long it is a low one.
double BestQuantile(std::vector<double> latency) {
  const double sigma = RobustSigma(latency);
  std::sort(latency.begin(), latency.end());
  const auto at = [&](double quantile) {
    return latency[static_cast<size_t>(quantile * static_cast<double>(latency.size() - 1))];
  };
  double best = 0.0, least = kMaxQuantileStd * sigma;
  for (const double quantile : {0.05, 0.1, 0.25, 0.75, 0.9, 0.95}) {
    const double reach = 0.8 * std::min(quantile, 1.0 - quantile);
    const double slope = (at(quantile + reach) - at(quantile - reach)) / (2.0 * reach);
    const double std = std::sqrt(quantile * (1.0 - quantile)) * std::max(slope, kSharpest * sigma);
    if (std >= least) continue;
    least = std;
    best = quantile;
  }
  return best;
}

/// Robust mean.
double Location(const std::vector<double>& values) {
  const double middle = Median(values);
  std::vector<double> sizes;
  for (const double value : values) sizes.push_back(value - middle);
  const double bound = kHuber * RobustSigma(sizes);
  double sum = 0.0;
  for (const double value : sizes) sum += std::clamp(value, -bound, bound);
  return middle + sum / static_cast<double>(values.size());
}

/// Share of the blocks of samples whose mean latency is not that of the block before.
double ShareBroken(const std::vector<double>& latency, double period) {
  const double sigma = RobustSigma(latency);
  const double bound = std::max(0.5 * period, 2.0 * sigma);
  const double limit = std::max(kMaxChange * period, kMaxChangeSigmas * sigma);
  const size_t length = std::max(kBlock, static_cast<size_t>(kBlockTime / period));
  double broken = 0.0, blocks = 0.0, before = 0.0;
  for (size_t i = 0; i + length <= latency.size(); i += length, blocks += 1.0) {
    double mean = 0.0;
    for (size_t k = i; k < i + length; ++k)
      mean += std::clamp(latency[k], -bound, bound) / static_cast<double>(length);
    if (i > 0 && std::abs(mean - before) > limit) broken += 1.0;
    before = mean;
  }
  return broken / std::max(blocks, 1.0);
}

/// The sample from which on the latency differs most from that before.
size_t FindBreak(const std::vector<double>& latency, double period) {
  const auto bounded = [&](double r) { return std::clamp(r, -period, period); };
  double sum = 0.0, mean = 0.0, largest = -1.0;
  for (const double r : latency) mean += bounded(r) / static_cast<double>(latency.size());
  size_t found = 0;
  for (size_t i = 0; i < latency.size(); ++i) {
    if (i > 0 && std::abs(sum) > largest) {
      largest = std::abs(sum);
      found = i;
    }
    sum += bounded(latency[i]) - mean;
  }
  return found;
}

/// Whether the missing frames are there: few enough for the jitter, and the stamps later by their
/// periods all at once. An irregular source is followed by frames that are not.
bool AreJumpsCredible(const FrameCount& count, const std::vector<double>& latency, double period) {
  const auto jumps = static_cast<double>(count.Jumps()), n = static_cast<double>(latency.size());
  const double sigma = RobustSigma(latency) / period;
  if (jumps > kMaxJumps * n || jumps * std::pow(kJumpSigmas * sigma, 2) > n) return false;
  double rise = 0.0;
  for (size_t i = kNear; i + kNear <= latency.size(); ++i)
    for (size_t k = 0; k < kNear && count.frames[i] - count.frames[i - 1] > 1; ++k)
      rise += (latency[i + k] - latency[i - 1 - k]) / (period * static_cast<double>(kNear));
  return rise >= -kMaxDrop * jumps - kMaxDropSigmas * sigma * std::sqrt(jumps);
}

/// Replaces the stamps t [s] by those of a clock, or of one before and one after a break, of which
/// there may be `breaks` more. Returns how many.
size_t RecoverRun(Period period, int* breaks, std::vector<double>* t) {
  if (t->size() < kMinRun || t->back() - t->front() < kMinRunTime) return 0;
  period = RefinePeriod(*t, period);
  FrameCount count = CountFrames(*t, period);
  std::vector<double> latency = FitClock(*t, count, period.seconds);
  for (int round = 0; round < kCounts; ++round) {
    count = CountAgain(count, latency, period);
    latency = FitClock(*t, count, period.seconds);
  }
  if (!AreJumpsCredible(count, latency, period.seconds)) return 0;
  const double broken = ShareBroken(latency, period.seconds);
  if (broken == 0.0) {
    const double quantile = BestQuantile(latency);
    if (quantile != 0.0) latency = FitClock(*t, count, period.seconds, quantile);
    const double mean = Location(latency);
    for (size_t i = 0; i < t->size(); ++i) (*t)[i] -= latency[i] - mean;
    return t->size();
  }
  if (broken > kMaxBroken || --*breaks < 0) return 0;
  const auto middle = t->begin() + static_cast<ptrdiff_t>(FindBreak(latency, period.seconds));
  std::vector<double> before(t->begin(), middle), after(middle, t->end());
  const size_t recovered = RecoverRun(period, breaks, &before) + RecoverRun(period, breaks, &after);
  std::copy(before.begin(), before.end(), t->begin());
  std::copy(after.begin(), after.end(), middle);
  return recovered;
}

/// Runs of stamps [s] without a pause.
std::vector<std::vector<double>> SplitAtPauses(const std::vector<int64_t>& t_ns) {
  std::vector<std::vector<double>> runs;
  for (size_t i = 0; i < t_ns.size(); ++i) {
    if (i == 0 || 1e-9 * static_cast<double>(t_ns[i] - t_ns[i - 1]) > kMaxPause)
      runs.emplace_back();
    runs.back().push_back(1e-9 * static_cast<double>(t_ns[i] - t_ns.front()));
  }
  return runs;
}

}  // namespace

std::optional<std::vector<int64_t>> RecoverClock(const std::vector<int64_t>& recorded_ns) {
  if (recorded_ns.size() < kMinRun) return std::nullopt;
  std::vector<std::vector<double>> runs = SplitAtPauses(recorded_ns);
  const auto longest = std::max_element(
      runs.begin(), runs.end(), [](const auto& a, const auto& b) { return a.size() < b.size(); });
  if (longest->size() < kMinRun) return std::nullopt;
  const Period period = FindPeriod(*longest);
  if (period.seconds == 0.0) return std::nullopt;
  size_t recovered = 0;
  std::vector<int64_t> stamps;
  for (std::vector<double>& run : runs) {
    int breaks = 1 + static_cast<int>((run.back() - run.front()) / kBreakInterval);
    recovered += RecoverRun(period, &breaks, &run);
    for (const double t : run) stamps.push_back(recorded_ns.front() + std::llround(1e9 * t));
  }
  if (static_cast<double>(recovered) < kMinRecovered * static_cast<double>(stamps.size()))
    return std::nullopt;
  return stamps;
}

}  // namespace imu_pose_calib
