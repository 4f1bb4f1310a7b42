#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

namespace imu_pose_calib {

/// The middle value, the upper one of two. `values` must not be empty.
template <typename T>
T Median(std::vector<T> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

/// Sigma of a Gaussian over the median of its magnitudes.
constexpr double kMadToSigma = 1.4826;

}  // namespace imu_pose_calib
