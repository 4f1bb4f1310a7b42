#include <Eigen/Core>
#include <algorithm>
#include <cmath>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/core/data/stamp_recovery.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kShortest = 4, kLongest = 25;  // poses from one measurement to the next
/// Of them, in which the beat hardly moves against the poses.
constexpr size_t kBeats = 20;
/// Of third differences over their mean, next to nothing.
constexpr double kNothing = 0.1;
/// Share of the variance of their logarithms that a beat explains.
constexpr double kLeastExplained = 0.3;

/// How well a beat of `period` explains third differences, each block of kBeats for itself.
struct Beat {
  size_t period;
  double share = 0.0;  ///< of the variance of logarithms, as far as it is not by chance
  double F = 0.0;      ///< mean square between places in the beat over that within them

  Beat(size_t beat, const std::vector<double>& norms) : period(beat) {
    const size_t length = kBeats * period, blocks = norms.size() / length;
    double between = 0.0, all = 0.0;
    for (size_t block = 0; block < blocks; ++block) {
      const Eigen::Map<const Eigen::ArrayXXd> own(&norms[block * length],
                                                  static_cast<Eigen::Index>(period), kBeats);
      if (own.mean() == 0.0) continue;
      const Eigen::ArrayXXd x = (own / own.mean() + kNothing).log();
      between += kBeats * (x.rowwise().mean() - x.mean()).square().sum();
      all += (x - x.mean()).square().sum();
    }
    if (all == 0.0) return;
    const double between_dof = static_cast<double>(blocks * (period - 1));
    const double within_dof = static_cast<double>(blocks * period * (kBeats - 1));
    F = between / between_dof / std::max(1e-12 * all, all - between) * within_dof;
    share = 1.0 - (1.0 - between / all) * (between_dof + within_dof) / within_dof;
  }
};

}  // namespace

size_t FindUpdatePeriod(const std::vector<PoseSample>& poses) {
  std::vector<double> norms;  // of third differences [m]: 0 for motion without a jump
  for (size_t i = 3; i < poses.size(); ++i)
    norms.push_back(
        (poses[i].p_WM - poses[i - 3].p_WM - 3.0 * (poses[i - 1].p_WM - poses[i - 2].p_WM)).norm());
  Beat best(1, {});
  for (size_t period = kShortest; period <= kLongest; ++period) {
    const Beat beat(period, norms);
    if (beat.F > best.F) best = beat;
  }
  return best.share > kLeastExplained ? best.period : 1;
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
