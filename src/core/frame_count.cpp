#include "imu_pose_calib/core/frame_count.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>

#include "imu_pose_calib/core/median.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kWindow = 50;       // samples, whose median step is at least
constexpr double kMinMedian = 0.25;  // of the mean one
constexpr int kStart = 10;           // frames by which the first sample may be off the level
constexpr double kBeam = 500.0;      // counts that cost so much more than the best are given up
constexpr size_t kMemory = 500;      // [samples] of the level while frames are counted
constexpr double kLongest = 8.0;     // latency [periods] beyond which it costs no more; or
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
  double factor, reach;

  double operator()(double r) const { return factor * std::min(std::abs(r), reach); }
};

/// Cost by the distribution that latencies [periods] were found to have.
struct FoundCost {
  static constexpr double kBin = 0.1;
  static constexpr size_t kBins = 600, kZero = 200;  // -20 to 40
  static size_t Bin(double r) {
    return static_cast<size_t>(std::clamp(kZero + std::floor(r / kBin), 1.0, kBins - 2.0));
  }
  double reach = kBin * (kBins - kZero);
  std::array<double, kBins> table{};

  double operator()(double r) const { return table[Bin(r)]; }
};

LatencyCost CostOf(const Period& period, double factor) {
  return {factor, std::max(kLongest, kLongestScatters * period.scatter) / factor};
}

double JumpCost(const Period& period) {
  return std::max(kMinJumpCost, kJumpScatters * period.scatter);
}

/// The frames n_i of stamps t_i that minimise
///   sum_i cost(t_i / period - n_i - level_i) + jump_cost (number of n_i > n_(i-1) + 1)
/// by dynamic programming over the number of missing frames; returns the sum. The level follows the
/// latency with a memory of so many samples, or stays at 0 when that is 0. Latencies beyond the
/// reach of the cost [periods] cost the same.
template <typename Cost>
double Count(const std::vector<double>& t,
             double period,
             size_t memory,
             double jump_cost,
             const Cost& cost,
             FrameCount* count) {
  struct State {
    int missing;
    double cost, level;
    int from;  // its place among the states of the sample before
  };
  const auto latency = [&](size_t i) { return t[i] / period - static_cast<double>(i); };
  const double gain = memory > 0 ? 1.0 / static_cast<double>(memory) : 0.0;
  double level = 0.0;
  if (memory > 0) {
    std::vector<double> first;
    for (size_t i = 0; i < std::min(kWindow, t.size()); ++i) first.push_back(latency(i));
    level = Median(std::move(first));
  }
  std::vector<State> states, next;  // by missing frames
  for (int m = -kStart; m <= kStart; ++m) states.push_back({m, 0.0, level, 0});
  std::vector<std::pair<int, int>> path;  // (missing, from) of the states of all samples
  std::vector<size_t> begins;             // of each sample
  size_t best = kStart;
  for (size_t i = 0; i < t.size(); ++i) {
    const double x = latency(i);
    // A jump is due when it brings the sample nearer to the level, else it may as well come later.
    const double due = x - states[best].level;
    int fresh = std::max(states.front().missing + 1,
                         static_cast<int>(std::floor(std::max(due - cost.reach, -1e9))));
    const int high = i > 0 ? static_cast<int>(std::ceil(due)) + 1 : fresh;
    next.clear();
    size_t source = 0;  // the best state with fewer missing frames
    double below = std::numeric_limits<double>::infinity(), least = below;
    for (size_t k = 0; k < states.size() || fresh < high;) {
      const bool exists = k < states.size() && (fresh >= high || states[k].missing <= fresh);
      const int m = exists ? states[k].missing : fresh;
      fresh = std::max(fresh, m + 1);
      const bool stays =
          exists && (i == 0 || k == 0 || states[k].cost <= states[source].cost + jump_cost);
      State state = states[stays ? k : source];
      state.missing = m;
      state.from = static_cast<int>(stays ? k : source);
      if (!stays) state.cost += jump_cost;
      if (exists && states[k].cost < states[source].cost) source = k;
      if (exists) ++k;
      const double r = x - m - state.level;
      state.cost += cost(r);
      state.level += gain * std::clamp(r, -1.0, 1.0);
      // Another with fewer missing frames can still jump here.
      if (i > 0 && state.cost >= below + jump_cost) continue;
      below = std::min(below, state.cost);
      next.push_back(state);
    }
    for (const State& state : next) least = std::min(least, state.cost);
    states.clear();
    begins.push_back(path.size());
    for (const State& state : next) {
      if (state.cost > least + kBeam) continue;
      if (state.cost == least) best = states.size();
      states.push_back(state);
      path.emplace_back(state.missing, state.from);
    }
  }
  const double sum = states[best].cost;
  count->frames.resize(t.size());
  for (size_t i = t.size(); i-- > 0;) {
    const auto& [missing, from] = path[begins[i] + best];
    count->frames[i] = static_cast<int64_t>(i) + missing;
    best = static_cast<size_t>(from);
  }
  const int64_t first = count->frames.front();
  for (int64_t& frame : count->frames) frame -= first;
  return sum;
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
  const double mean = (t.back() - t.front()) / static_cast<double>(t.size());
  if (!(period.seconds > kMinMedian * mean)) return {};
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
  FoundCost cost;
  for (const double r : latency) cost.table[FoundCost::Bin(r / period.seconds)] += 1.0;
  const std::array<double, FoundCost::kBins> histogram = cost.table;
  const auto n = static_cast<double>(latency.size());
  for (size_t k = 1; k + 1 < histogram.size(); ++k) {
    const double share = (histogram[k - 1] + 2.0 * histogram[k] + histogram[k + 1]) / (4.0 * n);
    cost.table[k] = -std::log(share + 1e-5);
  }
  std::vector<double> t(latency.size());  // but for what the clock is off the period
  for (size_t i = 0; i < t.size(); ++i)
    t[i] = period.seconds * static_cast<double>(count.frames[i]) + latency[i];
  const double jump_cost = std::log(n / static_cast<double>(1 + count.Jumps()));
  FrameCount again;
  Count(t, period.seconds, 0, jump_cost, cost, &again);
  return again;
}

}  // namespace imu_pose_calib
