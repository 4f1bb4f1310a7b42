#include "imu_pose_calib/core/start/rate_alignment.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <complex>
#include <unsupported/Eigen/FFT>
#include <utility>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/parallel.h"
#include "imu_pose_calib/core/base/peak.h"
#include "imu_pose_calib/core/base/text.h"

namespace imu_pose_calib {
namespace {

constexpr double kGuessWindow = 1.0;       // [s] searched around a given time shift
constexpr double kMinPeakDistance = 0.15;  // [s] between correlation peaks
constexpr size_t kMaxSamples = 4000;       // per closed-form fit: more does not change a start

/// A signal in bins of kRateBin; bins without a sample have weight 0.
struct Signal {
  Eigen::ArrayXd value, weight;

  explicit Signal(size_t bins)
      : value(Eigen::ArrayXd::Zero(static_cast<Eigen::Index>(bins))), weight(value) {}
  void Add(size_t bin, double x) {
    value[static_cast<Eigen::Index>(bin)] += x;
    weight[static_cast<Eigen::Index>(bin)] += 1.0;
  }
  size_t size() const { return static_cast<size_t>(value.size()); }
};

/// Pearson correlation of two masked signals at every lag, by FFT.
class MaskedCorrelation {
 public:
  MaskedCorrelation(const Signal& x, const Signal& y, int threads) {
    size_t size = 1;
    while (size < x.size() + y.size()) size *= 2;
    std::array<std::vector<std::complex<double>>, 3> X, Y;  // of weights, values, their squares
    InParallel(threads, 6, [&](size_t k) {
      const Signal& signal = k % 2 == 0 ? x : y;
      const Eigen::ArrayXd power = signal.weight * signal.value.pow(static_cast<int>(k / 2));
      std::vector<double> padded(power.data(), power.data() + power.size());
      padded.resize(size, 0.0);
      Eigen::FFT<double>().fwd((k % 2 == 0 ? X : Y)[k / 2], padded);
    });
    struct {
      std::vector<double>* of;
      size_t x, y;
    } const sums[] = {{&n_, 0, 0}, {&x_, 1, 0},  {&xx_, 2, 0},
                      {&y_, 0, 1}, {&yy_, 0, 2}, {&xy_, 1, 1}};
    InParallel(threads, 6, [&](size_t k) {
      std::vector<std::complex<double>> Z = X[sums[k].x];
      for (size_t i = 0; i < size; ++i) Z[i] *= std::conj(Y[sums[k].y][i]);
      Eigen::FFT<double>().inv(*sums[k].of, Z);
    });
  }

  /// Common bins when y is moved by `lag` bins.
  double Count(ptrdiff_t lag) const { return std::round(n_[Wrap(lag)]); }

  double At(ptrdiff_t lag) const {
    const size_t i = Wrap(lag);
    const double n = n_[i];
    const double vx = xx_[i] - x_[i] * x_[i] / n;
    const double vy = yy_[i] - y_[i] * y_[i] / n;
    if (vx <= 1e-9 * xx_[i] || vy <= 1e-9 * yy_[i]) return 0.0;
    return (xy_[i] - x_[i] * y_[i] / n) / std::sqrt(vx * vy);
  }

 private:
  size_t Wrap(ptrdiff_t lag) const { return static_cast<size_t>(lag) % n_.size(); }

  std::vector<double> n_, x_, xx_, y_, yy_, xy_;
};

/// log likelihood ratio of a correlation over n bins: long and close overlaps win.
double Evidence(double correlation, double n) {
  const double r = std::clamp(correlation, 0.0, 0.9999);
  return -0.5 * n * std::log(1.0 - r * r);
}

}  // namespace

size_t Stride(size_t size) { return std::max<size_t>(1, size / kMaxSamples); }

std::vector<RatePair> PairRates(const PoseTrajectory& trajectory,
                                const std::vector<TimedSample>& gyro, size_t stride,
                                const std::function<double(double t)>& pose_time) {
  std::vector<RatePair> pairs;
  for (size_t i = 0; i < gyro.size(); i += stride) {
    RatePair pair{&gyro[i], pose_time(gyro[i].t), {}};
    if (trajectory.EvaluateRotation(pair.t, &pair.marker)) pairs.push_back(pair);
  }
  return pairs;
}

RateAlignment AlignRates(const std::vector<RatePair>& pairs) {
  RateAlignment alignment;
  alignment.count = pairs.size();
  if (pairs.size() < 10) return alignment;
  Eigen::Matrix3Xd marker(3, pairs.size()), gyro(3, pairs.size());
  for (size_t i = 0; i < pairs.size(); ++i) {
    marker.col(static_cast<Eigen::Index>(i)) = pairs[i].marker.omega_M;
    gyro.col(static_cast<Eigen::Index>(i)) = pairs[i].gyro->value;
  }
  const Eigen::Isometry3d T_MI(Eigen::umeyama(gyro, marker, false));
  alignment.q_MI = Eigen::Quaterniond(T_MI.linear());
  alignment.gyro_bias = T_MI.inverse().translation();
  marker.colwise() -= marker.rowwise().mean().eval();
  gyro.colwise() -= gyro.rowwise().mean().eval();
  const double sum_M = marker.squaredNorm(), sum_I = gyro.squaredNorm();
  alignment.scale = std::sqrt(sum_I / std::max(sum_M, 1e-12));
  // |gyro - R^T omega|^2 with the gyro scaled to the marker's size: 1 - correlation^2.
  const double correlation =
      marker.cwiseProduct(T_MI.linear() * gyro).sum() / std::sqrt(std::max(sum_M * sum_I, 1e-24));
  alignment.explained = correlation * std::abs(correlation);
  return alignment;
}

std::vector<double> FindTimeShifts(const PoseTrajectory& trajectory,
                                   const std::vector<TimedSample>& gyro, double min_overlap_s,
                                   const std::optional<double>& guess, int count, int threads) {
  const auto bins = [](double duration) { return static_cast<size_t>(duration / kRateBin) + 1; };
  Signal marker(bins(trajectory.End()));
  InPortions(threads, marker.size(), [&](size_t i) {
    MarkerRotation<double> rotation;
    if (trajectory.EvaluateRotation((static_cast<double>(i) + 0.5) * kRateBin, &rotation))
      marker.Add(i, rotation.omega_M.norm());
  });
  const double gyro_begin = gyro.front().t;
  Signal imu(bins(gyro.back().t - gyro_begin));
  double early = 0.0;  // of the samples before the middles of their bins, in the mean
  std::vector<double> stamps;
  for (const TimedSample& s : gyro) {
    const auto bin = static_cast<size_t>((s.t - gyro_begin) / kRateBin);
    imu.Add(bin, s.value.norm());
    early += (static_cast<double>(bin) + 0.5) * kRateBin - (s.t - gyro_begin);
    stamps.push_back(s.t);
  }
  early /= static_cast<double>(gyro.size());
  const double per_bin = std::max(kRateBin, MedianStep(stamps));  // [s] that one with samples has
  imu.value /= imu.weight.max(1.0);  // the mean of the samples in a bin
  imu.weight = imu.weight.min(1.0);

  const MaskedCorrelation correlation(marker, imu, threads);
  const auto shift = [&](double lag) { return lag * kRateBin + early - gyro_begin; };
  const auto score = [&](ptrdiff_t lag) {
    if (correlation.Count(lag) * per_bin < min_overlap_s) return 0.0;
    if (guess && std::abs(shift(static_cast<double>(lag)) - *guess) > kGuessWindow) return 0.0;
    return Evidence(correlation.At(lag), correlation.Count(lag));
  };

  std::vector<std::pair<double, ptrdiff_t>> peaks;
  const auto end = static_cast<ptrdiff_t>(marker.size());
  for (ptrdiff_t lag = 1 - static_cast<ptrdiff_t>(imu.size()); lag < end; ++lag) {
    const double s = score(lag);
    if (s > 0.0 && s >= score(lag - 1) && s > score(lag + 1)) peaks.emplace_back(s, lag);
  }
  std::sort(peaks.rbegin(), peaks.rend());

  std::vector<double> shifts;
  for (const auto& [evidence, lag] : peaks) {
    if (static_cast<int>(shifts.size()) == count) break;
    const double offset =
        PeakOffset(correlation.At(lag - 1), correlation.At(lag), correlation.At(lag + 1));
    const double candidate = shift(static_cast<double>(lag) + offset);
    const auto is_near = [&](double s) { return std::abs(s - candidate) < kMinPeakDistance; };
    if (std::none_of(shifts.begin(), shifts.end(), is_near)) shifts.push_back(candidate);
  }
  return shifts;
}

RateAlignment AlignRates(const PoseTrajectory& trajectory, const std::vector<TimedSample>& gyro,
                         const std::vector<double>& time_shifts, bool inverted, int threads) {
  std::vector<RateAlignment> all(time_shifts.size());
  InParallel(threads, all.size(), [&](size_t k) {
    auto pairs = PairRates(trajectory, gyro, Stride(gyro.size()),
                           [&](double t) { return t + time_shifts[k]; });
    for (RatePair& pair : pairs)
      if (inverted) pair.marker.omega_M = -(pair.marker.q_WM * pair.marker.omega_M);
    all[k] = AlignRates(pairs);
    all[k].time_shift = time_shifts[k];
  });
  const auto evidence = [](const RateAlignment& a) {
    return Evidence(std::sqrt(std::max(0.0, a.explained)), static_cast<double>(a.count));
  };
  const auto best = std::max_element(
      all.begin(), all.end(),
      [&](const RateAlignment& a, const RateAlignment& b) { return evidence(a) < evidence(b); });
  return best == all.end() ? RateAlignment() : *best;
}

RateAlignment MatchRates(const PoseTrajectory& trajectory, const std::vector<TimedSample>& gyro,
                         const std::vector<double>& time_shifts, const RatesInWords& words,
                         int threads) {
  RateAlignment best = AlignRates(trajectory, gyro, time_shifts, false, threads);
  const double inverted = AlignRates(trajectory, gyro, time_shifts, true, threads).explained;
  const auto percent = [](double share) { return Number(100.0 * std::max(0.0, share), "%.3g"); };
  // Quaternions whose w comes first, read as if it came last, turn like inverted ones: up to fixed
  // rotations of W and M the two are the same.
  if (1.0 - inverted <= kFlipped * (1.0 - best.explained))
    Throw<OptionNeeded>(
        "the turn rates of ", words.both, " agree only when the poses are inverted (explains ",
        percent(inverted), " % of ", words.whose, " variance, as given ", percent(best.explained),
        " %): if they are the world seen from the body, set ", words.invert, ": ",
        words.is_inverted ? "false" : "true",
        "; if the source writes quaternions as w, x, y, z, let it write x, y, z, w");
  if (best.explained < kMinExplained)
    Throw<DataError>("the turn rates of ", words.both, " agree at no time shift (best explains ",
                     percent(best.explained), " % of ", words.whose,
                     " variance, bound: ", percent(kMinExplained),
                     " %): do both recordings overlap, and are both of the same rigid body?");
  return best;
}

}  // namespace imu_pose_calib
