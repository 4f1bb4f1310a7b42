#pragma once

#include <Eigen/Core>
#include <array>

namespace imu_pose_calib {

/// Order of the correction splines: cubic pieces, so that acceleration is continuous.
constexpr int kSplineOrder = 4;

/// Where an instant lies on a uniform spline: the first of the kSplineOrder control points that act
/// on it and the fraction `u` of its span.
struct SplinePlace {
  size_t first = 0;
  double u = 0.0;
  double spacing = 0.0;  ///< [s] length of the span
};

/// Weights of the kSplineOrder control points that act on one instant of a uniform B-spline:
/// row k holds the weights of the k-th time derivative, k = 0..2.
using SplineWeights = Eigen::Matrix<double, 3, kSplineOrder>;

/// Weights at the fraction u of a span of length `spacing` [s]. u in [0, 1] inside of the span;
/// beyond, the span's polynomials go on.
inline SplineWeights CubicWeights(double u, double spacing) {
  const double v = 1.0 - u;
  SplineWeights w;
  w.row(0) << v * v * v / 6.0, (3.0 * u * u * u - 6.0 * u * u + 4.0) / 6.0,
      (3.0 * v * v * v - 6.0 * v * v + 4.0) / 6.0, u * u * u / 6.0;
  w.row(1) << -0.5 * v * v, 1.5 * u * u - 2.0 * u, 2.0 * v - 1.5 * v * v, 0.5 * u * u;
  w.row(2) << v, 3.0 * u - 2.0, 3.0 * v - 2.0, u;
  w.row(1) /= spacing;
  w.row(2) /= spacing * spacing;
  return w;
}

/// Value, first and second derivative (columns) of a spline from its control points.
template <typename T>
Eigen::Matrix<T, 3, 3> EvaluateSpline(T const* const* points, const SplineWeights& weights) {
  Eigen::Matrix<T, 3, kSplineOrder> P;
  for (int j = 0; j < kSplineOrder; ++j)
    P.col(j) = Eigen::Map<const Eigen::Matrix<T, 3, 1>>(points[j]);
  return P * weights.transpose().template cast<T>();
}

}  // namespace imu_pose_calib
