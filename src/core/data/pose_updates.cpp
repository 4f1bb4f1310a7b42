#include "imu_pose_calib/core/data/pose_updates.h"

#include <algorithm>
#include <cmath>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/data/stamp_recovery.h"

namespace imu_pose_calib {
namespace {

/// Third differences over a quantile of theirs, of jumps: white noise never does that. A jump shows
/// in three of them.
constexpr double kJump = 10.0, kQuantile = 0.2;
constexpr size_t kLeastJumps = 50;
constexpr size_t kShortest = 5, kLongest = 25;  // poses from one measurement to the next
/// Of the distances between jumps: share that is a multiple of the period, give or take one pose.
constexpr double kLeastRegular = 0.85;

/// Norms of third differences of the position [m]: 0 for motion without a jump.
std::vector<double> ThirdDifferences(const std::vector<PoseSample>& poses) {
  std::vector<double> norms;
  for (size_t i = 3; i < poses.size(); ++i)
    norms.push_back(
        (poses[i].p_WM - poses[i - 3].p_WM - 3.0 * (poses[i - 1].p_WM - poses[i - 2].p_WM)).norm());
  return norms;
}

/// Distances between the beginnings of runs of values above `bound`.
std::vector<size_t> Distances(const std::vector<double>& values, double bound) {
  std::vector<size_t> begins, distances;
  for (size_t i = 0; i < values.size(); ++i)
    if (values[i] > bound && (i == 0 || values[i - 1] <= bound)) begins.push_back(i);
  for (size_t k = 1; k < begins.size(); ++k) distances.push_back(begins[k] - begins[k - 1]);
  return distances;
}

}  // namespace

size_t FindUpdatePeriod(const std::vector<PoseSample>& poses) {
  const std::vector<double> norms = ThirdDifferences(poses);
  if (norms.empty()) return 1;
  std::vector<double> sorted = norms;
  std::sort(sorted.begin(), sorted.end());
  const double usual = sorted[static_cast<size_t>(kQuantile * static_cast<double>(sorted.size()))];
  const std::vector<size_t> distances = Distances(norms, kJump * usual);
  if (distances.size() < kLeastJumps) return 1;
  size_t period = 1;
  ptrdiff_t most = 0;
  for (size_t k = kShortest; k <= kLongest; ++k) {
    const ptrdiff_t count = std::count(distances.begin(), distances.end(), k);
    if (count > most) period = k;
    most = std::max(most, count);
  }
  const auto is_multiple = [period](size_t d) { return d + 1 >= period && (d + 1) % period <= 2; };
  const auto regular = std::count_if(distances.begin(), distances.end(), is_multiple);
  const double share = static_cast<double>(regular) / static_cast<double>(distances.size());
  return share > kLeastRegular ? period : 1;
}

size_t KeepOneOf(size_t period, std::vector<PoseSample>* poses) {
  if (period < 2 || poses->size() < 2) return 0;
  const double step = MedianStep(Stamps(*poses));
  const auto first = static_cast<double>(poses->front().t_ns);
  std::vector<PoseSample> kept;
  int64_t last = -1;
  for (const PoseSample& pose : *poses) {
    const int64_t count = std::llround((static_cast<double>(pose.t_ns) - first) / step);
    const int64_t interval = count / static_cast<int64_t>(period);
    if (interval != last) kept.push_back(pose);
    last = interval;
  }
  poses->swap(kept);
  return kept.size() - poses->size();
}

}  // namespace imu_pose_calib
