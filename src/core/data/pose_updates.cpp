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

}  // namespace

size_t FindUpdatePeriod(const std::vector<PoseSample>& poses) {
  std::vector<double> norms;  // of third differences [m]: 0 for motion without a jump
  for (size_t i = 3; i < poses.size(); ++i)
    norms.push_back(
        (poses[i].p_WM - poses[i - 3].p_WM - 3.0 * (poses[i - 1].p_WM - poses[i - 2].p_WM)).norm());
  if (norms.empty()) return 1;
  std::vector<double> sorted = norms;
  std::sort(sorted.begin(), sorted.end());
  const double bound =
      kJump * sorted[static_cast<size_t>(kQuantile * static_cast<double>(sorted.size()))];
  std::vector<size_t> distances;             // between the beginnings of jumps
  std::vector<int> counts(kLongest + 1, 0);  // of these distances
  size_t last = 0;
  for (size_t i = 1; i < norms.size(); ++i) {
    if (norms[i] <= bound || norms[i - 1] > bound) continue;
    if (last > 0) distances.push_back(i - last);
    if (last > 0 && i - last <= kLongest) ++counts[i - last];
    last = i;
  }
  if (distances.size() < kLeastJumps) return 1;
  const auto most = std::max_element(counts.begin() + kShortest, counts.end());
  if (*most == 0) return 1;
  const auto period = static_cast<size_t>(most - counts.begin());
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
