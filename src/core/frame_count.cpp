#include "imu_pose_calib/core/frame_count.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "imu_pose_calib/core/median.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kWindow = 50;    // samples
constexpr int kStart = 10;        // frames by which the first sample may be off the level
constexpr double kBeam = 500.0;   // counts that cost so much more than the best are given up
constexpr size_t kMemory = 500;   // [samples] of the level while frames are counted
constexpr double kLongest = 8.0;  // latency [periods] beyond which it costs no more; or
constexpr double kLongestScatters = 4.0;

/// What missing frames cost, in periods of latency: more where the stamps scatter more.
constexpr double kMinJumpCost = 2.0, kJumpScatters = 6.0;

/// A search for the period: factors of the one assumed, and the memory of the level.
struct Search {
  double low, high, step;
  size_t memory;
};
constexpr Search kCoarse{0.75, 1.02, 3e-3, 50}, kMiddle{0.98, 1.02, 1e-3, 200},
    kFine{0.997, 1.003, 3e-4, kMemory};
constexpr size_t kShortExcerpt = 4000, kExcerpt = 20000;

/// Cost of a latency while its distribution is unknown.
struct LatencyCost {
  double longest = kLongest;
  double factor = 1.0;

  double operator()(double r) const { return std::min(factor * std::abs(r), longest); }
};

LatencyCost CostOf(const Period& period, double factor) {
  return {std::max(kLongest, kLongestScatters * period.scatter), factor};
}

double JumpCost(const Period& period) {
  return std::max(kMinJumpCost, kJumpScatters * period.scatter);
}

/// The frames n_i of stamps t_i that minimise
///   sum_i cost(t_i / period - n_i - level_i) + jump_cost (number of n_i > n_(i-1) + 1)
/// by dynamic programming over the number of missing frames; returns the sum. The level follows the
/// latency with a memory of so many samples, or stays at 0 when that is 0.
template <typename Cost>
double Count(const std::vector<double>& t,
             double period,
             size_t memory,
             double jump_cost,
             const Cost& cost,
             FrameCount* count) {
  struct State {
    double cost, level;
  };
  const auto latency = [&](size_t i) { return t[i] / period - static_cast<double>(i); };
  const double gain = memory > 0 ? 1.0 / static_cast<double>(memory) : 0.0;
  double level = 0.0;
  if (memory > 0) {
    std::vector<double> first;
    for (size_t i = 0; i < std::min(kWindow, t.size()); ++i) first.push_back(latency(i));
    level = Median(std::move(first));
  }
  // With `low` missing frames, one more, ...; the first sample may be off the level, too.
  std::vector<State> states(2 * kStart + 1, {0.0, level}), next;
  int low = -kStart;
  std::vector<int> lows, from;  // of each sample; of each of its states: missing before it
  std::vector<size_t> begins;   // of each sample, in `from`
  size_t best = 0;
  for (size_t i = 0; i < t.size(); ++i) {
    const double x = latency(i);
    int high = low + static_cast<int>(states.size());
    // Frames that miss before a stamp, but not by this one, may as well miss later.
    if (i > 0) high = std::max(high, static_cast<int>(std::ceil(x - states[best].level)) + 1);
    next.clear();
    begins.push_back(from.size());
    lows.push_back(low);
    size_t source = 0;  // the best state with fewer missing frames
    double least = std::numeric_limits<double>::infinity();
    best = 0;
    for (int m = low; m < high; ++m) {
      const auto k = static_cast<size_t>(m - low);
      const bool exists = k < states.size();
      const bool stays =
          i == 0 || k == 0 || (exists && states[k].cost <= states[source].cost + jump_cost);
      const size_t origin = stays ? k : source;
      State state = states[origin];
      if (!stays) state.cost += jump_cost;
      if (exists && states[k].cost < states[source].cost) source = k;
      const double r = x - m - state.level;
      state.cost += cost(r);
      state.level += gain * std::clamp(r, -1.0, 1.0);
      from.push_back(low + static_cast<int>(origin));
      next.push_back(state);
      if (state.cost >= least) continue;
      least = state.cost;
      best = k;
    }
    size_t begin = 0, end = next.size();
    while (next[begin].cost > least + kBeam) ++begin;
    while (next[end - 1].cost > least + kBeam) --end;
    states.assign(next.begin() + static_cast<ptrdiff_t>(begin),
                  next.begin() + static_cast<ptrdiff_t>(end));
    low += static_cast<int>(begin);
    best -= begin;
  }
  int missing = low + static_cast<int>(best);
  count->frames.resize(t.size());
  for (size_t i = t.size(); i-- > 0;) {
    count->frames[i] = static_cast<int64_t>(i) + missing;
    missing = from[begins[i] + static_cast<size_t>(missing - lows[i])];
  }
  const int64_t first = count->frames.front();
  for (int64_t& frame : count->frames) frame -= first;
  return states[best].cost;
}

/// The middle of `t`, at most `count` of them.
std::vector<double> Excerpt(const std::vector<double>& t, size_t count) {
  if (t.size() <= count) return t;
  const auto begin = t.begin() + static_cast<ptrdiff_t>((t.size() - count) / 2);
  return {begin, begin + static_cast<ptrdiff_t>(count)};
}

/// The period that is counted at the least cost. A false one costs a latency that the level cannot
/// follow, or frames that miss.
Period FindPeriod(const std::vector<double>& t, const Period& start, const Search& search) {
  Period best = start;
  double least = std::numeric_limits<double>::infinity();
  for (double f = search.low; f <= search.high; f += search.step) {
    // The same latency [s] costs the same with every period.
    FrameCount count;
    const double cost =
        Count(t, f * start.seconds, search.memory, JumpCost(start), CostOf(start, f), &count);
    if (cost >= least) continue;
    least = cost;
    best.seconds = f * start.seconds;
  }
  return best;
}

/// Median over windows of the mean distance from a line [s].
double Scatter(const std::vector<double>& t) {
  const double middle = 0.5 * static_cast<double>(kWindow - 1);
  std::vector<double> sizes;
  for (size_t begin = 0; begin + kWindow <= t.size(); begin += kWindow) {
    double mean = 0.0, slope = 0.0, scale = 0.0, size = 0.0;
    for (size_t i = 0; i < kWindow; ++i) {
      const double u = static_cast<double>(i) - middle;
      mean += t[begin + i] / static_cast<double>(kWindow);
      slope += u * t[begin + i];
      scale += u * u;
    }
    for (size_t i = 0; i < kWindow; ++i)
      size += std::abs(t[begin + i] - mean - slope / scale * (static_cast<double>(i) - middle));
    sizes.push_back(size / static_cast<double>(kWindow));
  }
  return Median(std::move(sizes));
}

}  // namespace

size_t FrameCount::Jumps() const {
  size_t jumps = 0;
  for (size_t i = 1; i < frames.size(); ++i) jumps += frames[i] - frames[i - 1] > 1 ? 1 : 0;
  return jumps;
}

Period FindPeriod(const std::vector<double>& t) {
  std::vector<double> means;
  for (size_t i = kWindow; i < t.size(); ++i)
    means.push_back((t[i] - t[i - kWindow]) / static_cast<double>(kWindow));
  Period period{Median(std::move(means)), 0.0};
  if (!(period.seconds > 0.0)) return {};
  period.scatter = Scatter(t) / period.seconds;
  const std::vector<double> excerpt = Excerpt(t, kShortExcerpt);
  return FindPeriod(excerpt, FindPeriod(excerpt, period, kCoarse), kMiddle);
}

Period RefinePeriod(const std::vector<double>& t, const Period& period) {
  return FindPeriod(Excerpt(t, kExcerpt), period, kFine);
}

FrameCount CountFrames(const std::vector<double>& t, const Period& period) {
  FrameCount count;
  Count(t, period.seconds, kMemory, JumpCost(period), CostOf(period, 1.0), &count);
  return count;
}

FrameCount CountAgain(const FrameCount& count,
                      const std::vector<double>& latency,
                      const Period& period) {
  constexpr double kBin = 0.1;                // [periods]
  constexpr size_t kBins = 600, kZero = 200;  // -20 to 40 periods
  const auto bin = [](double r) {
    return static_cast<size_t>(std::clamp(kZero + std::floor(r / kBin), 1.0, kBins - 2.0));
  };
  std::array<double, kBins> histogram{}, cost{};
  for (const double r : latency) histogram[bin(r / period.seconds)] += 1.0;
  const auto n = static_cast<double>(latency.size());
  for (size_t k = 1; k + 1 < kBins; ++k) {
    const double share = (histogram[k - 1] + 2.0 * histogram[k] + histogram[k + 1]) / (4.0 * n);
    cost[k] = -std::log(share + 1e-5);
  }
  std::vector<double> t(latency.size());  // but for what the clock is off the period
  for (size_t i = 0; i < t.size(); ++i)
    t[i] = period.seconds * static_cast<double>(count.frames[i]) + latency[i];
  const double jump_cost = std::log(n / static_cast<double>(1 + count.Jumps()));
  FrameCount again;
  Count(
      t, period.seconds, 0, jump_cost, [&](double r) { return cost[bin(r)]; }, &again);
  return again;
}

}  // namespace imu_pose_calib
