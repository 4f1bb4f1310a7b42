#pragma once

#include <ceres/cost_function.h>

#include <memory>

#include "imu_pose_calib/core/trajectory/pose_trajectory.h"

namespace imu_pose_calib {

/// One gyroscope sample against the trajectory, doc/math.md Eq. (1).
///   r = (w - b_g - R_MI^T omega_M(t + time_shift)) / sigma,  b_g = (1 - u) knot_0 + u knot_1
/// Blocks: q_MI (4, xyzw) | knot_0 (3, rad/s) | knot_1 (3) | time_shift (1, s).
/// Residual: 3, unitless, in I. Fails when t + time_shift is outside of the trajectory.
struct GyroResidual {
  const PoseTrajectory* trajectory;
  double t;           ///< [s] IMU clock
  Eigen::Vector3d w;  ///< [rad/s] in I
  double u;           ///< 0..1 between the knots
  double sigma;       ///< [rad/s] of sample and trajectory together

  template <typename T>
  bool operator()(const T* q_MI, const T* knot_0, const T* knot_1, const T* time_shift,
                  T* residual) const {
    using Vector3 = Eigen::Matrix<T, 3, 1>;
    MarkerState<T> state;
    if (!trajectory->Evaluate(T(t) + *time_shift, &state)) return false;
    const Eigen::Map<const Eigen::Quaternion<T>> R_MI(q_MI);
    const Vector3 b =
        T(1.0 - u) * Eigen::Map<const Vector3>(knot_0) + T(u) * Eigen::Map<const Vector3>(knot_1);
    Eigen::Map<Vector3> r(residual);
    r = (w.cast<T>() - b - R_MI.conjugate() * state.omega_M) / T(sigma);
    return true;
  }

  std::unique_ptr<ceres::CostFunction> Create() const;
};

/// One accelerometer sample against the trajectory, doc/math.md Eq. (2), at
/// t_M = t + time_shift - accel_delay:
///   r = (f - b_a - R_MI^T (R_WM^T (a_W - g_W) + alpha_M x p_MI + omega_M x (omega_M x p_MI))) /
///   sigma
/// with b_a = (1 - u) knot_0 + u knot_1.
/// Blocks: q_MI (4, xyzw) | p_MI (3, m) | g_W (3, m/s^2) | knot_0 (3, m/s^2) | knot_1 (3) |
/// time_shift (1, s) | accel_delay (1, s).
/// Residual: 3, unitless, in I. Fails when t_M is outside of the trajectory.
struct AccelResidual {
  const PoseTrajectory* trajectory;
  double t;           ///< [s] IMU clock
  Eigen::Vector3d f;  ///< [m/s^2] in I
  double u;           ///< 0..1 between the knots
  double sigma;       ///< [m/s^2] of sample and trajectory together

  template <typename T>
  bool operator()(const T* q_MI, const T* p_MI, const T* g_W, const T* knot_0, const T* knot_1,
                  const T* time_shift, const T* accel_delay, T* residual) const {
    using Vector3 = Eigen::Matrix<T, 3, 1>;
    MarkerState<T> state;
    if (!trajectory->Evaluate(T(t) + *time_shift - *accel_delay, &state)) return false;
    const Eigen::Map<const Eigen::Quaternion<T>> R_MI(q_MI);
    const Vector3 p = Eigen::Map<const Vector3>(p_MI);
    const Vector3 g = Eigen::Map<const Vector3>(g_W);
    const Vector3 b =
        T(1.0 - u) * Eigen::Map<const Vector3>(knot_0) + T(u) * Eigen::Map<const Vector3>(knot_1);
    Eigen::Map<Vector3> r(residual);
    r = (f.cast<T>() - b - R_MI.conjugate() * SpecificForce(state, g, p)) / T(sigma);
    return true;
  }

  std::unique_ptr<ceres::CostFunction> Create() const;
};

/// Magnitude of gravity that is known beforehand: r = (|g_W| - magnitude) / sigma, both [m/s^2].
/// Block: g_W (3). Residual: 1.
struct GravityPrior {
  double magnitude, sigma;

  template <typename T>
  bool operator()(const T* g_W, T* residual) const {
    *residual = (Eigen::Map<const Eigen::Matrix<T, 3, 1>>(g_W).norm() - T(magnitude)) / T(sigma);
    return true;
  }

  std::unique_ptr<ceres::CostFunction> Create() const;
};

/// Between two knots: r = (knot_1 - kept knot_0) / sigma. Brownian motion: all is kept, sigma =
/// walk sqrt(time between the knots); an Ornstein-Uhlenbeck process keeps a share of knot_0.
/// Blocks: knot_0 (kSize) | knot_1 (kSize). Residual: kSize.
template <int kSize>
struct WalkResidual {
  double sigma;  ///< of what is new, in the unit of the knots
  double kept = 1.0;

  template <typename T>
  bool operator()(const T* knot_0, const T* knot_1, T* residual) const {
    for (int i = 0; i < kSize; ++i) residual[i] = (knot_1[i] - T(kept) * knot_0[i]) / T(sigma);
    return true;
  }

  std::unique_ptr<ceres::CostFunction> Create() const;
};

/// Third difference of control points of a spline: by how much its acceleration changes in a span,
/// times the squared spacing, r = (point_3 - 3 point_2 + 3 point_1 - point_0) / sigma. Blocks: the
/// points (3). Residual: 3.
struct JerkResidual {
  double sigma;  ///< in the unit of the points

  template <typename T>
  bool operator()(const T* point_0, const T* point_1, const T* point_2, const T* point_3,
                  T* residual) const {
    for (int i = 0; i < 3; ++i)
      residual[i] = (point_3[i] - point_0[i] - T(3.0) * (point_2[i] - point_1[i])) / T(sigma);
    return true;
  }

  std::unique_ptr<ceres::CostFunction> Create() const;
};

}  // namespace imu_pose_calib
