#include <Eigen/Core>
#include <algorithm>
#include <cmath>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/core/data/stamp_recovery.h"

namespace imu_pose_calib {
namespace {

/// Poses whose beat is looked at together: it may move against the poses in more.
constexpr int kBlock = 512;
constexpr int kShortest = 4, kLongest = 25;  // poses of a beat
/// Of third differences over their mean, next to nothing.
constexpr double kNothing = 0.1;
/// By which harmonics of a beat are stronger than all else.
constexpr double kLeastContrast = 12.0;
constexpr double kKnown = 0.1;  // [1/block] to which a rate is known

/// Power of the logarithms of third differences at 0, 1, ... kBlock / 2 periods a block.
Eigen::ArrayXd FindSpectrum(const std::vector<PoseSample>& poses) {
  std::vector<double> norms;  // [m]: 0 for motion without a jump
  for (size_t i = 3; i < poses.size(); ++i)
    norms.push_back(
        (poses[i].p_WM - poses[i - 3].p_WM - 3.0 * (poses[i - 1].p_WM - poses[i - 2].p_WM)).norm());
  const auto blocks = static_cast<Eigen::Index>(norms.size()) / kBlock;
  Eigen::MatrixXd x = Eigen::Map<const Eigen::MatrixXd>(norms.data(), kBlock, blocks);
  for (Eigen::Index b = 0; b < blocks; ++b) {
    auto block = x.col(b);
    const double mean = block.mean();
    if (mean == 0.0 || !std::isfinite(mean))
      block.setZero();
    else
      block = (block.array() / mean + kNothing).log();
    block.array() -= block.mean();
  }
  const Eigen::VectorXd place = Eigen::VectorXd::LinSpaced(kBlock, 0.0, 1.0 - 1.0 / kBlock);
  const Eigen::ArrayXXd angles =
      2.0 * M_PI * kBlock * place.head(kBlock / 2 + 1) * place.transpose();
  return ((angles.cos().matrix() * x).array().square() +
          (angles.sin().matrix() * x).array().square())
      .rowwise()
      .sum();
}

/// Harmonics of a beat against all else that is no slower than the slowest beat.
struct Beat {
  double contrast = 0.0;       ///< ratio of their mean powers
  Eigen::Index strongest = 0;  ///< of the harmonics [1/block]

  Beat(const Eigen::ArrayXd& power, Eigen::Index fundamental) {
    double own = 0.0, count = 0.0;
    for (Eigen::Index k = fundamental; k + 1 < power.size(); k += fundamental) {
      own += power.segment(k - 1, 3).sum();  // it may lie between two
      count += 3.0;
      if (strongest == 0 || power[k] > power[strongest]) strongest = k;
    }
    const auto all = power.tail(power.size() - kBlock / kLongest);
    if (own == 0.0) return;
    contrast = own / count / std::max(1e-12 * own, all.sum() - own) *
               (static_cast<double>(all.size()) - count);
  }
};

}  // namespace

double FindUpdatePeriod(const std::vector<PoseSample>& poses) {
  const Eigen::ArrayXd power = FindSpectrum(poses);
  Beat best(power, kBlock / kShortest);
  for (Eigen::Index k = kBlock / kLongest + 1; k < kBlock / kShortest; ++k) {
    const Beat beat(power, k);
    if (beat.contrast > best.contrast) best = beat;
  }
  if (best.contrast < kLeastContrast) return 1.0;
  // A beat of several measurements is whole where that of one is not.
  const Eigen::Array3d peak = power.segment(best.strongest - 1, 3).sqrt();
  const double between =
      peak[2] > peak[0] ? peak[2] / (peak[1] + peak[2]) : -peak[0] / (peak[1] + peak[0]);
  const double rate = static_cast<double>(best.strongest) + between;
  const double whole = std::round(kBlock / rate);
  return std::abs(kBlock / whole - rate) < kKnown ? whole : kBlock / rate;
}

size_t KeepOneOf(double period, std::vector<PoseSample>* poses) {
  if (period <= 1.0 || poses->size() < 2) return 0;
  const double step = MedianStep(Stamps(*poses));
  const auto first = static_cast<double>(poses->front().t_ns);
  std::vector<PoseSample> kept;
  int64_t last = -1;
  for (const PoseSample& pose : *poses) {
    const double count = std::round((static_cast<double>(pose.t_ns) - first) / step);
    const auto interval = static_cast<int64_t>(count / period);
    if (interval != last) kept.push_back(pose);
    last = interval;
  }
  poses->swap(kept);
  return kept.size() - poses->size();
}

}  // namespace imu_pose_calib
