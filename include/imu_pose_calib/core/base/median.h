#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <type_traits>
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

/// Medians of the components of the vectors of(begin), ..., of(end - 1), of which there must be
/// one.
template <typename VectorOf>
auto MedianOfEach(size_t begin, size_t end, const VectorOf& of) {
  std::decay_t<decltype(of(begin))> median;
  for (int axis = 0; axis < static_cast<int>(median.size()); ++axis) {
    std::vector<double> values;
    for (size_t i = begin; i < end; ++i) values.push_back(of(i)[axis]);
    median[axis] = Median(std::move(values));
  }
  return median;
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
