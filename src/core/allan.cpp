#include "imu_pose_calib/core/allan.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <utility>

#include "imu_pose_calib/core/median.h"

namespace imu_pose_calib {
namespace {

constexpr double kFewestPairs = 10.0;      // that do not overlap
constexpr size_t kMaxPositions = 200'000;  // of the windows: more do not change the median
constexpr double kLeastCovered = 0.75;     // of a window
/// A sample stands for the time until the next one, at most so many periods or so much of a window.
constexpr double kMaxCellPeriods = 2.0, kMaxCellShare = 0.25;

/// Weighted samples of one window.
struct Window {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  double count = 0.0;    ///< sum of the weights
  double squares = 0.0;  ///< sum of their squares
  double covered = 0.0;  ///< [s]

  Eigen::Vector3d Mean() const { return sum / count; }
  /// Of the mean, in units of one sample's.
  double Variance() const { return squares / (count * count); }
};

/// The samples and their sums. Those at the end of a window weigh by the part of their time that
/// is within it, so a mean is continuous in both ends of its window.
class Cells {
 public:
  Cells(const std::vector<double>& t, const std::vector<Eigen::Vector3d>& x, double max_width)
      : t_(t), x_(x), max_width_(max_width), sums_{Eigen::Vector3d::Zero()}, covered_{0.0} {
    for (size_t i = 0; i < t.size(); ++i) {
      sums_.push_back(sums_.back() + x[i]);
      covered_.push_back(covered_.back() + Width(i));
    }
  }

  /// The `tau` [s] before the stamp of sample j.
  Window Before(size_t j, double tau) const {
    const double begin = t_[j] - tau;
    const auto after = std::upper_bound(t_.begin(), t_.begin() + static_cast<ptrdiff_t>(j), begin);
    const auto first = static_cast<size_t>(after - t_.begin());
    Window window = Whole(first, j);
    if (first > 0) AddPart(first - 1, 1.0 - Elapsed(first - 1, begin), &window);
    return window;
  }

  /// The `tau` [s] from the stamp of sample j on.
  Window After(size_t j, double tau) const {
    const double end = t_[j] + tau;
    const auto after = std::upper_bound(t_.begin() + static_cast<ptrdiff_t>(j), t_.end(), end);
    const auto last = static_cast<size_t>(after - t_.begin()) - 1;
    Window window = Whole(j, last);
    AddPart(last, Elapsed(last, end), &window);
    return window;
  }

  /// [s]
  double Width(size_t i) const {
    return i + 1 < t_.size() ? std::min(t_[i + 1] - t_[i], max_width_) : max_width_;
  }

 private:
  /// Share of the time of sample i that is over at t [s].
  double Elapsed(size_t i, double t) const {
    const double width = Width(i);
    return t - t_[i] < width ? (t - t_[i]) / width : 1.0;
  }
  Window Whole(size_t begin, size_t end) const {
    const auto count = static_cast<double>(end - begin);
    return {sums_[end] - sums_[begin], count, count, covered_[end] - covered_[begin]};
  }
  void AddPart(size_t i, double weight, Window* window) const {
    window->sum += weight * x_[i];
    window->count += weight;
    window->squares += weight * weight;
    window->covered += weight * Width(i);
  }

  const std::vector<double>& t_;
  const std::vector<Eigen::Vector3d>& x_;
  const double max_width_;
  std::vector<Eigen::Vector3d> sums_;  ///< of the samples before
  std::vector<double> covered_;        ///< [s] by them
};

double MedianPeriod(const std::vector<double>& t) {
  std::vector<double> periods;
  for (size_t i = 1; i < t.size(); ++i) periods.push_back(t[i] - t[i - 1]);
  return Median(std::move(periods));
}

}  // namespace

double AllanNoise(const std::vector<double>& t, const std::vector<Eigen::Vector3d>& x, double tau) {
  if (t.size() < 2) return 0.0;
  const Cells cells(t, x, std::max(kMaxCellPeriods * MedianPeriod(t), kMaxCellShare * tau));
  const size_t stride = t.size() / kMaxPositions + 1;
  std::vector<double> magnitudes;
  double slid = 0.0;  // [s]
  for (size_t j = 1; j < t.size(); j += stride) {
    const Window a = cells.Before(j, tau), b = cells.After(j, tau);
    if (std::min(a.covered, b.covered) < kLeastCovered * tau) continue;
    const Eigen::Vector3d difference =
        (a.Mean() - b.Mean()) / std::sqrt(a.Variance() + b.Variance());
    for (int k = 0; k < 3; ++k) magnitudes.push_back(std::abs(difference[k]));
    slid += static_cast<double>(stride) * cells.Width(j);
  }
  if (magnitudes.empty() || slid < kFewestPairs * 2.0 * tau) return 0.0;
  return kMadToSigma * Median(std::move(magnitudes));
}

}  // namespace imu_pose_calib
