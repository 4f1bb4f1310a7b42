#pragma once

#include <ceres/version.h>

#include <Eigen/Core>

/// The only place that knows that Ceres renamed its parameterizations (2.1 against 1.14).
#if CERES_VERSION_MAJOR > 2 || (CERES_VERSION_MAJOR == 2 && CERES_VERSION_MINOR >= 1)
#define IMU_POSE_CALIB_CERES_HAS_MANIFOLDS 1
#include <ceres/manifold.h>
#else
#define IMU_POSE_CALIB_CERES_HAS_MANIFOLDS 0
#include <ceres/local_parameterization.h>
#endif

namespace imu_pose_calib {

#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
using QuaternionManifold = ceres::EigenQuaternionManifold;
#else
using QuaternionManifold = ceres::EigenQuaternionParameterization;
#endif

/// How a parameter block moves by a step of its degrees of freedom.
enum class BlockKind {
  kVector,
  /// An Eigen quaternion (x, y, z, w) keeps its unit norm. Ceres moves it on the left and by half
  /// the angle: Plus(q, d) turns by 2 d, so a covariance block of q_MI is in M and a quarter of
  /// rad^2.
  kUnitQuaternion,
};

/// Degrees of freedom of a block of `size` parameters.
inline int TangentSize(BlockKind kind, int size) {
  return kind == BlockKind::kVector ? size : size - 1;
}

/// Moves a block by a step.
inline void MoveBlock(BlockKind kind, int size, const double* step, double* parameters) {
  const Eigen::VectorXd before = Eigen::Map<const Eigen::VectorXd>(parameters, size);
  if (kind == BlockKind::kUnitQuaternion)
    QuaternionManifold().Plus(before.data(), step, parameters);
  else
    Eigen::Map<Eigen::VectorXd>(parameters, size) += Eigen::Map<const Eigen::VectorXd>(step, size);
}

/// Derivative of a quaternion (x, y, z, w) by a step.
inline Eigen::Matrix<double, 4, 3, Eigen::RowMajor> PlusJacobian(const double* quaternion) {
  Eigen::Matrix<double, 4, 3, Eigen::RowMajor> J;
#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
  QuaternionManifold().PlusJacobian(quaternion, J.data());
#else
  QuaternionManifold().ComputeJacobian(quaternion, J.data());
#endif
  return J;
}

}  // namespace imu_pose_calib
