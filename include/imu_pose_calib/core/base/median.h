#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <utility>
#include <vector>

namespace imu_pose_calib {

/// The middle value, the upper one of two. `values` must not be empty.
template <typename T>
T Median(std::vector<T> values) {
  const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

/// Median of the differences of neighbours; there must be two values.
template <typename T>
double MedianStep(const std::vector<T>& values) {
  std::vector<double> steps;
  for (size_t i = 1; i < values.size(); ++i)
    steps.push_back(static_cast<double>(values[i] - values[i - 1]));
  return Median(std::move(steps));
}

/// Sigma of a Gaussian over the median of its magnitudes.
constexpr double kMadToSigma = 1.4826;

/// Sigma of values about zero that outliers do not move.
inline double RobustSigma(std::vector<double> values) {
  for (double& value : values) value = std::abs(value);
  return kMadToSigma * Median(std::move(values));
}

}  // namespace imu_pose_calib
