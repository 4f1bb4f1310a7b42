#include <Eigen/Core>
#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/data/stamp_recovery.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kWindow = 50;   // samples whose mean step is looked at
constexpr double kBeam = 500.0;  // counts that cost so much more than the best are given up
constexpr size_t kMemory = 500;  // [samples] of the level while frames are counted
constexpr int kLongest = 8;      // latency [periods] beyond which it costs no more

/// What missing frames cost, in periods of latency: more where the stamps scatter more.
constexpr double kMinJumpCost = 2.0, kJumpScatters = 6.0;

/// [s] between the knots of a clock; after a pause as long, another one begins.
constexpr double kKnotSpacing = 10.0;
constexpr double kRateStep = 1e-5;  // sigma of the change of the rate at a knot
constexpr double kHuber = 1.5;      // sigma
constexpr int kRounds = 15;

constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr size_t kExcerpt = 20000;  // [samples] on which the period is sought

/// Numbers of the frames of samples that arrived in this order; the first is 0, each at least one
/// more than the one before. The latency of sample i, at t_i [s], is t_i - period frames_i.
struct FrameCount {
  std::vector<int64_t> frames;
  double cost = 0.0;

  /// Samples before which frames are missing.
  size_t Jumps() const {
    size_t jumps = 0;
    for (size_t i = 1; i < frames.size(); ++i) jumps += frames[i] - frames[i - 1] > 1 ? 1 : 0;
    return jumps;
  }
};

/// Period of a source [s] and the mean distance of its stamps from a line through a few of them, in
/// periods.
struct Period {
  double seconds = 0.0;
  double scatter = 0.0;
};

/// Of samples up to one: what counting a number of missing frames costs at the least.
struct State {
  double cost = kInfinity, level = 0.0;
  int from = 0;  ///< missing frames by the sample before
};

/// The states of one sample, by missing frames: `first` and those that follow.
struct States {
  int first;
  std::vector<State> by_missing;

  State& operator[](int missing) { return by_missing[static_cast<size_t>(missing - first)]; }
  int Best() const {
    const auto is_less = [](const State& a, const State& b) { return a.cost < b.cost; };
    const auto best = std::min_element(by_missing.begin(), by_missing.end(), is_less);
    return first + static_cast<int>(best - by_missing.begin());
  }
};

/// The frames n_i of stamps t_i that minimise
///   sum_i cost(t_i / period - n_i - level_i) + jump_cost (number of n_i > n_(i-1) + 1)
/// by a Viterbi search over the number of missing frames, of at least kWindow stamps. The level
/// follows the latency with a memory of so many samples, or stays at 0 when that is 0. Without
/// frames, at infinite cost, when it is more than `most`.
template <typename Cost>
FrameCount FindFrames(const std::vector<double>& t, double period, size_t memory, double jump_cost,
                      const Cost& cost, double most = kInfinity) {
  std::vector<double> latency;
  for (size_t i = 0; i < t.size(); ++i) latency.push_back(t[i] / period - static_cast<double>(i));
  const std::vector<double> first(latency.begin(), latency.begin() + kWindow);
  const double level = memory > 0 ? Median(first) : 0.0;
  const double gain = memory > 0 ? 1.0 / static_cast<double>(memory) : 0.0;
  std::vector<States> all;  // of each sample, but first those before any
  all.push_back({-kLongest, std::vector<State>(2 * kLongest + 1, {0.0, level})});
  for (size_t i = 0; i < t.size(); ++i) {
    States& last = all.back();
    const int best = last.Best();
    // A jump is due when it brings the sample nearer to the level, else it may as well come later.
    const int last_end = last.first + static_cast<int>(last.by_missing.size());
    const int end =
        std::max(last_end, 1 + static_cast<int>(std::ceil(latency[i] - last[best].level)));
    States next{last.first, std::vector<State>(static_cast<size_t>(end - last.first))};
    double below = kInfinity;
    for (int m = last.first, source = m; m < end; ++m) {
      const bool exists = m < last_end;
      const bool stays = exists && last[m].cost <= last[source].cost + jump_cost;
      State state = last[stays ? m : source];
      state.from = stays ? m : source;  // the best one with fewer missing frames
      if (exists && last[m].cost < last[source].cost) source = m;
      const double r = latency[i] - m - state.level;
      state.cost += cost(r) + (stays ? 0.0 : jump_cost);
      state.level += gain * std::clamp(r, -1.0, 1.0);
      // Another with fewer missing frames can still jump here.
      if (state.cost >= below + jump_cost) continue;
      below = std::min(below, state.cost);
      next[m] = state;
    }
    if (below > most) return {{}, kInfinity};
    const auto is_near = [&](const State& state) { return state.cost <= below + kBeam; };
    auto& states = next.by_missing;
    while (!is_near(states.back())) states.pop_back();  // of samples that waited longer
    const auto first_near = std::find_if(states.begin(), states.end(), is_near);
    next.first += static_cast<int>(first_near - states.begin());
    states.erase(states.begin(), first_near);
    all.push_back(std::move(next));
  }
  int missing = all.back().Best();
  FrameCount count{std::vector<int64_t>(t.size()), all.back()[missing].cost};
  for (size_t i = t.size(); i-- > 0;) {
    count.frames[i] = static_cast<int64_t>(i) + missing;
    missing = all[i + 1][missing].from;
  }
  const int64_t start = count.frames.front();
  for (int64_t& frame : count.frames) frame -= start;
  return count;
}

/// Counts frames while the distribution of latencies is unknown, at `factor` times the period that
/// is assumed: the same latency [s] costs the same with all of them. A frame is taken for missing
/// where the stamps stay later for good.
FrameCount CountFrames(const std::vector<double>& t, const Period& period, double factor = 1.0,
                       size_t memory = kMemory, double most = kInfinity) {
  const double reach = kLongest / factor;
  const double jump_cost = std::max(kMinJumpCost, kJumpScatters * period.scatter);
  return FindFrames(
      t, factor * period.seconds, memory, jump_cost,
      [=](double r) { return factor * std::min(std::abs(r), reach); }, most);
}

/// Median over windows of the mean distance from a line [s].
double Scatter(const std::vector<double>& t) {
  using Window = Eigen::Array<double, kWindow, 1>;
  const Window u = Window::LinSpaced(-0.5 * (kWindow - 1.0), 0.5 * (kWindow - 1.0));
  std::vector<double> sizes;
  for (size_t begin = 0; begin + kWindow <= t.size(); begin += kWindow) {
    const Window y = Eigen::Map<const Window>(t.data() + begin);
    sizes.push_back((y - y.mean() - (u * y).sum() / u.square().sum() * u).abs().mean());
  }
  return Median(std::move(sizes));
}

/// The period of at least 100 stamps [s]; 0 when they hardly advance but for pauses. That which is
/// counted at the least cost: a false one costs a latency that the level cannot follow, or frames
/// that miss. The finer the steps of the search, the longer is the memory of the level.
Period FindPeriod(const std::vector<double>& t) {
  std::vector<double> means;
  for (size_t i = kWindow; i < t.size(); ++i)
    means.push_back((t[i] - t[i - kWindow]) / static_cast<double>(kWindow));
  Period period{Median(std::move(means)), 0.0};
  const double mean = (t.back() - t.front()) / static_cast<double>(t.size());
  if (!(period.seconds > kBunch * mean)) return {};
  period.scatter = Scatter(t) / period.seconds;
  const size_t size = std::min(t.size(), kExcerpt);
  const auto begin = t.begin() + static_cast<ptrdiff_t>((t.size() - size) / 2);
  const std::vector<double> excerpt(begin, begin + static_cast<ptrdiff_t>(size));
  double low = 0.75, high = 1.02;
  for (size_t memory = kMemory / 9; memory <= kMemory; memory *= 3) {
    const double step = 0.15 / static_cast<double>(memory);
    double best = 1.0, least = CountFrames(excerpt, period, best, memory).cost;
    for (double factor = low; factor <= high; factor += step) {
      const double cost = CountFrames(excerpt, period, factor, memory, least).cost;
      if (cost < least) best = factor;
      least = std::min(least, cost);
    }
    period.seconds *= best;
    low = 1.0 - 10.0 * step;
    high = 1.0 + 10.0 * step;
  }
  return period;
}

/// Counts them again by the distribution of the latencies [s] that the first count left about a
/// clock: stamps that were cut, or by time of arrival, have a sharp edge.
FrameCount CountAgain(const FrameCount& count, const std::vector<double>& latency,
                      const Period& period) {
  constexpr double kBin = 0.1;                // [periods]
  constexpr size_t kBins = 600, kZero = 200;  // -20 to 40
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
  return FindFrames(t, period.seconds, 0, std::log(n / static_cast<double>(1 + count.Jumps())),
                    [&](double r) { return cost[bin(r)]; });
}

/// Latency [s] of the stamps t [s] about a clock whose offset from period * frame is linear between
/// knots: of their mean, robust. Changes of the rate are few.
std::vector<double> FitClock(const std::vector<double>& t, const FrameCount& count, double period) {
  const auto samples = static_cast<Eigen::Index>(t.size());
  const auto n = static_cast<double>(count.frames.back());
  const auto intervals = static_cast<int>(std::max(1.0, std::round(n * period / kKnotSpacing)));
  const double spacing = n / intervals;  // in frames
  const double bend_sigma = kRateStep * spacing * period;
  // A c = y: the stamps, then bends of 0.
  Eigen::VectorXd y = Eigen::VectorXd::Zero(samples + intervals - 1);
  std::vector<Eigen::Triplet<double>> elements;
  for (Eigen::Index i = 0; i < samples; ++i) {
    const auto frame = static_cast<double>(count.frames[static_cast<size_t>(i)]);
    const int knot = std::min(static_cast<int>(frame / spacing), intervals - 1);
    const double part = frame / spacing - knot;
    elements.emplace_back(i, knot, 1.0 - part);
    elements.emplace_back(i, knot + 1, part);
    y[i] = t[static_cast<size_t>(i)] - period * frame;
  }
  for (int knot = 0; knot + 1 < intervals; ++knot) {
    elements.emplace_back(samples + knot, knot, 1.0);
    elements.emplace_back(samples + knot, knot + 1, -2.0);
    elements.emplace_back(samples + knot, knot + 2, 1.0);
  }
  Eigen::SparseMatrix<double> A(y.size(), intervals + 1);
  A.setFromTriplets(elements.begin(), elements.end());
  std::vector<double> latency(y.data(), y.data() + samples);
  Eigen::VectorXd r = y.array() - Median(latency);
  r.tail(intervals - 1).setZero();
  for (int round = 0; round < kRounds; ++round) {
    const double sigma = std::max(RobustSigma(latency), 1e-4 * period);
    const auto weight = [&](Eigen::Index i) {
      const double size = std::abs(r[i]), own = i < samples ? sigma : bend_sigma;
      return std::min(1.0, kHuber * own / (size + 1e-12)) * std::pow(sigma / own, 2);
    };
    const Eigen::VectorXd w = Eigen::VectorXd::NullaryExpr(y.size(), weight);
    const Eigen::SparseMatrix<double> weighted = w.asDiagonal() * A, H = A.transpose() * weighted;
    const Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>> ldlt(H);
    r = y - A * ldlt.solve(weighted.transpose() * y);
    std::copy_n(r.data(), samples, latency.begin());
  }
  return latency;
}

/// Whether the missing frames are there: so few that a period is many sigma of the mean latency
/// between, and the stamps later by their periods all at once. An irregular source is followed by
/// frames that are not.
bool AreJumpsCredible(const FrameCount& count, const std::vector<double>& latency, double period) {
  constexpr size_t kNear = 5;  // samples on either side
  const auto jumps = static_cast<double>(count.Jumps()), n = static_cast<double>(latency.size());
  const double sigma = RobustSigma(latency) / period;
  if (jumps * std::pow(kSureSigmas * sigma, 2) > n) return false;
  double rise = 0.0;
  for (size_t i = kNear; i + kNear <= latency.size(); ++i)
    for (size_t k = 0; k < kNear && count.frames[i] - count.frames[i - 1] > 1; ++k)
      rise += (latency[i + k] - latency[i - 1 - k]) / (period * static_cast<double>(kNear));
  return rise >= -0.5 * kSureSigmas * sigma * std::sqrt(jumps);
}

/// Replaces the stamps t [s] by those of an even clock; false when there is none.
bool RecoverRun(const Period& period, std::vector<double>* t) {
  if (t->size() < 2 * kWindow) return false;
  FrameCount count = CountFrames(*t, period);
  std::vector<double> latency = FitClock(*t, count, period.seconds);
  count = CountAgain(count, latency, period);
  latency = FitClock(*t, count, period.seconds);
  if (!AreJumpsCredible(count, latency, period.seconds)) return false;
  for (size_t i = 0; i < t->size(); ++i) (*t)[i] -= latency[i];
  return true;
}

/// Runs of stamps [s] without a pause.
std::vector<std::vector<double>> SplitAtPauses(const std::vector<int64_t>& t_ns) {
  std::vector<std::vector<double>> runs;
  for (size_t i = 0; i < t_ns.size(); ++i) {
    if (i == 0 || 1e-9 * static_cast<double>(t_ns[i] - t_ns[i - 1]) > kKnotSpacing)
      runs.emplace_back();
    runs.back().push_back(1e-9 * static_cast<double>(t_ns[i] - t_ns.front()));
  }
  return runs;
}

}  // namespace

std::optional<std::vector<int64_t>> RecoverClock(const std::vector<int64_t>& recorded_ns) {
  std::vector<std::vector<double>> runs = SplitAtPauses(recorded_ns);
  const auto longest = std::max_element(
      runs.begin(), runs.end(), [](const auto& a, const auto& b) { return a.size() < b.size(); });
  if (longest == runs.end() || longest->size() < 2 * kWindow) return std::nullopt;
  const Period period = FindPeriod(*longest);
  if (period.seconds == 0.0) return std::nullopt;
  size_t recovered = 0;
  std::vector<int64_t> stamps;
  for (std::vector<double>& run : runs) {
    if (RecoverRun(period, &run)) recovered += run.size();
    for (const double t : run) stamps.push_back(recorded_ns.front() + std::llround(1e9 * t));
  }
  if (static_cast<double>(recovered) < (1.0 - kExceptions) * static_cast<double>(stamps.size()))
    return std::nullopt;
  return stamps;
}

}  // namespace imu_pose_calib
