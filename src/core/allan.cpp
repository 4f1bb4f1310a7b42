#include "imu_pose_calib/core/allan.h"

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "imu_pose_calib/core/median.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kFewestPairs = 10;

/// Samples within one tau.
struct Bin {
  int64_t number;
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  double count = 0.0;
};

}  // namespace

double AllanNoise(const std::vector<double>& t, const std::vector<Eigen::Vector3d>& x, double tau) {
  std::vector<Bin> bins;
  double fullest = 0.0;
  for (size_t i = 0; i < t.size(); ++i) {
    const auto number = static_cast<int64_t>(std::floor(t[i] / tau));
    if (bins.empty() || bins.back().number != number) bins.push_back({number});
    bins.back().sum += x[i];
    bins.back().count += 1.0;
    fullest = std::max(fullest, bins.back().count);
  }
  std::vector<double> magnitudes;
  for (size_t k = 0; k + 1 < bins.size(); ++k) {
    const Bin &a = bins[k], &b = bins[k + 1];
    if (a.number % 2 != 0 || b.number != a.number + 1) continue;
    if (std::min(a.count, b.count) < 0.5 * fullest) continue;
    const Eigen::Vector3d difference =
        (a.sum / a.count - b.sum / b.count) / std::sqrt(1.0 / a.count + 1.0 / b.count);
    for (const double value : difference) magnitudes.push_back(std::abs(value));
  }
  return magnitudes.size() < 3 * kFewestPairs ? 0.0 : kMadToSigma * Median(magnitudes);
}

}  // namespace imu_pose_calib
