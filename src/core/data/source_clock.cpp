#include "imu_pose_calib/core/data/source_clock.h"

#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>

#include "imu_pose_calib/core/base/median.h"

namespace imu_pose_calib {
namespace {

constexpr double kMaxPause = 10.0;   // [s] across which frames are counted
constexpr size_t kMinRun = 100;      // samples that make a clock, and
constexpr double kMinRunTime = 5.0;  // [s]
constexpr double kMinRecovered = 0.9;

// Counting, by latencies in periods.
constexpr size_t kWindow = 50;             // samples, whose median step is at least
constexpr double kMinMedian = 0.25;        // of the mean one
constexpr ptrdiff_t kHalfExcerpt = 10000;  // samples that a period is found from
constexpr int kStart = 10;                 // frames by which the first may be off the level
constexpr double kReach = 8.0;             // beyond which a latency costs no more
constexpr double kBeam = 500.0;  // counts that cost so much more than the best are given up
constexpr int kCounts = 5;
constexpr double kMinJumpCost = 2.0, kJumpScatters = 6.0;

// Clock.
constexpr double kKnotSpacing = 10.0;  // [s]
constexpr double kRateStep = 1e-5;     // sigma of the change of the rate at a knot
constexpr double kHuber = 1.5;         // sigma
constexpr int kRounds = 15;
/// The quantile of latencies that are often small and sometimes long is used when its sigma is
/// below so much of that of the mean; a density is bounded by that of so much of the sigma.
constexpr double kQuantile = 0.05, kMaxQuantileStd = 0.7, kSharpest = 0.02;

/// The clock breaks where the mean latency changes by more than a part of a period, and of its
/// sigma, over so long [s].
constexpr double kMaxChange = 0.15, kMaxChangeSigmas = 0.6;
constexpr double kBlockTime = 2.0;

/// Frames miss so rarely that a period is so many sigma of the mean latency between. The latency of
/// so many samples on either side is the same, within a part of a period and so many sigma.
constexpr double kJumpSigmas = 4.0;
constexpr size_t kNear = 5;
constexpr double kMaxDrop = 0.05, kMaxDropSigmas = 2.0;

/// Cost of latencies [periods], in bins.
class Cost {
 public:
  /// While their distribution is unknown.
  Cost() {
    for (size_t k = 0; k < table_.size(); ++k)
      table_[k] = std::min(kReach, kBin * std::abs(static_cast<double>(k) - kZero));
  }
  /// By the distribution of these: stamps that were cut, or by time of arrival, have a sharp edge.
  explicit Cost(const std::vector<double>& latency) {
    std::vector<double> share(table_.size(), 0.0);
    for (const double r : latency) share[Bin(r)] += 1.0 / static_cast<double>(latency.size());
    for (size_t k = 1; k + 1 < share.size(); ++k)
      table_[k] = -std::log(0.25 * share[k - 1] + 0.5 * share[k] + 0.25 * share[k + 1] + 1e-5);
  }
  double operator()(double latency) const { return table_[Bin(latency)]; }

 private:
  static constexpr double kBin = 0.1, kZero = 200.0, kLast = 598.0;  // -20 to 40 periods
  static size_t Bin(double r) {
    return static_cast<size_t>(std::clamp(kZero + std::round(r / kBin), 1.0, kLast));
  }
  std::vector<double> table_ = std::vector<double>(600, 0.0);
};

/// Frames that miss before each sample, and the cost at which they are counted.
struct Count {
  std::vector<int> missing;
  double cost = 0.0;

  double Jumps() const {
    double jumps = 0.0;
    for (size_t i = 1; i < missing.size(); ++i) jumps += missing[i] > missing[i - 1] ? 1.0 : 0.0;
    return jumps;
  }
};

/// The m_i >= m_(i-1) that minimise
///   sum_i cost(x_i - m_i - level_i) + jump_cost (number of m_i > m_(i-1))
/// by a Viterbi search. x_i [periods] is the time of sample i less i; the level follows the latency
/// of the best count by `gain`. So a frame is missing where the samples stay later for good.
Count CountMissing(const std::vector<double>& x, const Cost& cost, double jump_cost, double level,
                   double gain) {
  int low = -kStart;  // missing frames of the first count that is kept; each other has one more
  std::vector<double> costs(2 * kStart + 1, 0.0);
  std::vector<int> sources;                 // missing frames before, of the counts at each sample
  std::vector<ptrdiff_t> places(x.size());  // in `sources`, where none are missing
  size_t best = 0;
  for (size_t i = 0; i < x.size(); ++i) {
    const double rest = x[i] - level - low;
    const auto due = static_cast<size_t>(std::max(0.0, std::ceil(rest) + 1.0));
    if (i > 0 && due >= costs.size())
      costs.resize(due + 1, std::numeric_limits<double>::infinity());
    places[i] = static_cast<ptrdiff_t>(sources.size()) - low;
    size_t source = 0;
    double least = std::numeric_limits<double>::infinity();  // of those with fewer, before
    best = 0;
    for (size_t k = 0; k < costs.size(); ++k) {
      const double stays = costs[k];
      const bool jumps = i > 0 && least + jump_cost < stays;
      sources.push_back(low + static_cast<int>(jumps ? source : k));
      costs[k] = (jumps ? least + jump_cost : stays) + cost(rest - static_cast<double>(k));
      if (costs[k] < costs[best]) best = k;
      if (stays >= least) continue;
      least = stays;
      source = k;
    }
    level += gain * std::clamp(rest - static_cast<double>(best), -1.0, 1.0);
    // Those that can jump later as well go, and those that cost too much.
    while (costs.size() > std::max(due, best) + 1 && costs.back() >= costs[best] + jump_cost)
      costs.pop_back();
    size_t first = 0;
    while (costs[first] > costs[best] + kBeam) ++first;
    costs.erase(costs.begin(), costs.begin() + static_cast<ptrdiff_t>(first));
    best -= first;
    low += static_cast<int>(first);
  }
  Count count{std::vector<int>(x.size()), costs[best]};
  int missing = low + static_cast<int>(best);
  for (size_t i = x.size(); i-- > 0;) {
    count.missing[i] = missing;
    missing = sources[static_cast<size_t>(places[i] + missing)];
  }
  return count;
}

/// t_i / period - i.
std::vector<double> InPeriods(const std::vector<double>& t, double period) {
  std::vector<double> x;
  for (const double t_i : t) x.push_back(t_i / period - static_cast<double>(x.size()));
  return x;
}

double FirstLevel(const std::vector<double>& x) {
  return Median<double>({x.begin(), x.begin() + kWindow});
}

/// Median over windows of the mean distance from a line [s].
double Scatter(const std::vector<double>& t) {
  constexpr auto kSize = static_cast<Eigen::Index>(kWindow);
  const Eigen::ArrayXd u = Eigen::ArrayXd::LinSpaced(kSize, -1.0, 1.0);
  std::vector<double> sizes;
  for (size_t begin = 0; begin + kWindow <= t.size(); begin += kWindow) {
    const Eigen::Map<const Eigen::ArrayXd> window(t.data() + begin, kSize);
    const double slope = (u * window).sum() / u.square().sum();
    sizes.push_back((window - window.mean() - slope * u).abs().mean());
  }
  return Median(std::move(sizes));
}

/// Of a source [s], and what a missing frame costs: more where the stamps scatter more.
struct Period {
  double seconds, jump_cost;
};

/// The period that at least kMinRun stamps [s] are counted with at the least cost; a false one
/// costs a latency that the level cannot follow, or frames that miss. 0 when they hardly advance
/// but for pauses.
Period FindPeriod(const std::vector<double>& t) {
  std::vector<double> means;
  for (size_t i = kWindow; i < t.size(); ++i)
    means.push_back((t[i] - t[i - kWindow]) / static_cast<double>(kWindow));
  const double usual = Median(std::move(means));
  if (!(usual > kMinMedian * t.back() / static_cast<double>(t.size()))) return {0.0, 0.0};
  Period period{usual, std::max(kMinJumpCost, kJumpScatters * Scatter(t) / usual)};
  // `memory` of the level [samples].
  const auto search = [&](double low, double high, double step, double memory, ptrdiff_t half) {
    const auto middle = t.begin() + static_cast<ptrdiff_t>(t.size() / 2);
    half = std::min(half, static_cast<ptrdiff_t>(t.size() / 2));
    const std::vector<double> excerpt(middle - half, middle + half);
    const double start = period.seconds;
    double least = std::numeric_limits<double>::infinity();
    for (double factor = low; factor <= high; factor += step) {
      const std::vector<double> x = InPeriods(excerpt, factor * start);
      // The same latency [s] costs the same with every period.
      const double cost =
          factor * CountMissing(x, Cost(), period.jump_cost, FirstLevel(x), 1.0 / memory).cost;
      if (cost >= least) continue;
      least = cost;
      period.seconds = factor * start;
    }
  };
  search(0.75, 1.06, 3e-3, 50.0, kHalfExcerpt / 5);
  search(0.98, 1.02, 1e-3, 200.0, kHalfExcerpt / 5);
  search(0.997, 1.003, 3e-4, 500.0, kHalfExcerpt);
  return period;
}

/// Latency [s] of the stamps t [s] about a clock whose offset from period * frame is linear between
/// knots and whose rate seldom changes: robust least squares, or a low quantile of them.
std::vector<double> FitClock(const std::vector<double>& t, const std::vector<int>& missing,
                             double period, bool is_low) {
  const auto n = static_cast<Eigen::Index>(t.size());
  const auto frames = static_cast<double>(n - 1 + missing.back() - missing.front());
  const auto intervals =
      static_cast<Eigen::Index>(std::max(1.0, std::round(frames * period / kKnotSpacing)));
  const double spacing = frames / static_cast<double>(intervals);
  const double bend_sigma = kRateStep * spacing * period;
  Eigen::VectorXd y = Eigen::VectorXd::Zero(n + intervals - 1), w(y.size());
  std::vector<Eigen::Triplet<double>> elements;
  for (Eigen::Index i = 0; i < n; ++i) {
    const auto k = static_cast<size_t>(i);
    const auto frame = static_cast<double>(i + missing[k] - missing[0]);
    const auto knot = std::min(static_cast<Eigen::Index>(frame / spacing), intervals - 1);
    const double part = frame / spacing - static_cast<double>(knot);
    y[i] = t[k] - period * frame;
    elements.emplace_back(i, knot, 1.0 - part);
    elements.emplace_back(i, knot + 1, part);
  }
  for (Eigen::Index knot = 0; knot + 1 < intervals; ++knot)
    for (const int k : {0, 1, 2}) elements.emplace_back(n + knot, knot + k, k == 1 ? -2.0 : 1.0);
  Eigen::SparseMatrix<double> J(y.size(), intervals + 1);
  J.setFromTriplets(elements.begin(), elements.end());
  Eigen::VectorXd r = y;
  r.head(n).array() -= Median<double>({y.data(), y.data() + n});
  for (int round = 0; round < kRounds; ++round) {
    const double sigma = std::max(RobustSigma({r.data(), r.data() + n}), 1e-4 * period);
    for (Eigen::Index i = 0; i < w.size(); ++i) {
      const double size = i < n ? sigma : bend_sigma;
      w[i] = std::pow(sigma / size, 2) * std::min(1.0, kHuber * size / (std::abs(r[i]) + 1e-12));
      if (is_low && i < n)
        w[i] = sigma * (r[i] > 0.0 ? kQuantile : 1.0 - kQuantile) /
               std::max(std::abs(r[i]), kSharpest * sigma);
    }
    const Eigen::SparseMatrix<double> H = J.transpose() * w.asDiagonal() * J;
    const Eigen::VectorXd b = J.transpose() * w.cwiseProduct(y);
    r = y - J * Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>>(H).solve(b);
  }
  return {r.data(), r.data() + n};
}

/// Whether a low quantile of the latencies is known better than their mean, by their density there.
bool IsLowBetter(std::vector<double> latency) {
  const double sigma = RobustSigma(latency);
  std::sort(latency.begin(), latency.end());
  const auto at = [&](double quantile) {
    return latency[static_cast<size_t>(quantile * static_cast<double>(latency.size()))];
  };
  const double slope = (at(1.8 * kQuantile) - at(0.2 * kQuantile)) / (1.6 * kQuantile);
  return std::sqrt(kQuantile * (1.0 - kQuantile)) * slope < kMaxQuantileStd * sigma;
}

/// The sample from which on the latencies [periods] are others for good; 0: there is none.
size_t FindBreak(const std::vector<double>& latency, double period_s) {
  const double sigma = RobustSigma(latency), bound = std::max(0.5, 2.0 * sigma);
  std::vector<double> sums = {0.0};
  for (const double r : latency) sums.push_back(sums.back() + std::clamp(r, -bound, bound));
  const double mean = sums.back() / static_cast<double>(latency.size());
  const auto excursion = [&](size_t i) {
    return std::abs(sums[i] - mean * static_cast<double>(i));
  };
  size_t found = 0;
  for (size_t i = 1; i < latency.size(); ++i)
    if (excursion(i) > excursion(found)) found = i;
  const size_t block = std::max(kWindow, static_cast<size_t>(kBlockTime / period_s));
  const size_t before = std::min(found, block), after = std::min(latency.size() - found, block);
  if (std::min(before, after) < kWindow) return 0;
  const double change = (sums[found + after] - sums[found]) / static_cast<double>(after) -
                        (sums[found] - sums[found - before]) / static_cast<double>(before);
  return std::abs(change) > std::max(kMaxChange, kMaxChangeSigmas * sigma) ? found : 0;
}

/// Whether the missing frames are there: few enough for the latencies [periods], and the stamps
/// later by their periods all at once. An irregular source is followed by frames that are not.
bool AreJumpsCredible(const Count& count, const std::vector<double>& latency) {
  const double sigma = RobustSigma(latency), jumps = count.Jumps();
  if (jumps * std::pow(kJumpSigmas * sigma, 2) > static_cast<double>(latency.size())) return false;
  double rise = 0.0;
  for (size_t i = kNear; i + kNear <= latency.size(); ++i)
    for (size_t k = 0; k < kNear && count.missing[i] > count.missing[i - 1]; ++k)
      rise += (latency[i + k] - latency[i - 1 - k]) / static_cast<double>(kNear);
  return rise >= -kMaxDrop * jumps - kMaxDropSigmas * sigma * std::sqrt(jumps);
}

/// Replaces `size` stamps t [s] by those of a clock, or of several where it breaks. Returns how
/// many.
size_t RecoverRun(double* t, size_t size) {
  if (size < kMinRun || t[size - 1] - t[0] < kMinRunTime) return 0;
  std::vector<double> stamps(t, t + size);
  for (double& stamp : stamps) stamp -= t[0];
  const Period period = FindPeriod(stamps);
  if (period.seconds == 0.0) return 0;
  std::vector<double> x = InPeriods(stamps, period.seconds), latency;
  Count count = CountMissing(x, Cost(), period.jump_cost, FirstLevel(x), 1.0 / 200.0);
  bool is_low = false;
  for (int round = 1;; ++round) {
    latency = FitClock(stamps, count.missing, period.seconds, is_low);
    for (double& r : latency) r /= period.seconds;
    if (round == kCounts) break;
    for (size_t i = 0; i < size; ++i) x[i] = count.missing[i] + latency[i];
    const double jump_cost = std::log(static_cast<double>(size) / (1.0 + count.Jumps()));
    count = CountMissing(x, Cost(latency), jump_cost, 0.0, 0.0);
    is_low = IsLowBetter(latency);
  }
  if (const size_t middle = FindBreak(latency, period.seconds); middle > 0)
    return RecoverRun(t, middle) + RecoverRun(t + middle, size - middle);
  if (!AreJumpsCredible(count, latency)) return 0;
  const auto values =
      Eigen::Map<const Eigen::ArrayXd>(latency.data(), static_cast<Eigen::Index>(size));
  for (size_t i = 0; i < size; ++i) t[i] -= period.seconds * (latency[i] - values.mean());
  return size;
}

}  // namespace

std::optional<std::vector<int64_t>> RecoverClock(const std::vector<int64_t>& recorded_ns) {
  std::vector<double> t;
  for (const int64_t t_ns : recorded_ns)
    t.push_back(1e-9 * static_cast<double>(t_ns - recorded_ns.front()));
  size_t recovered = 0;
  for (size_t i = 1, begin = 0; i <= t.size(); ++i) {
    if (i < t.size() && t[i] - t[i - 1] <= kMaxPause) continue;
    recovered += RecoverRun(t.data() + begin, i - begin);
    begin = i;
  }
  if (recovered == 0 ||
      static_cast<double>(recovered) < kMinRecovered * static_cast<double>(t.size()))
    return std::nullopt;
  std::vector<int64_t> stamps;
  for (const double t_i : t) stamps.push_back(recorded_ns.front() + std::llround(1e9 * t_i));
  return stamps;
}

}  // namespace imu_pose_calib
