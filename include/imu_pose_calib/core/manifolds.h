#pragma once

#include <ceres/version.h>

#include <Eigen/Core>

/// The only place that knows that Ceres renamed its parameterizations (2.1 against 1.14).
#if CERES_VERSION_MAJOR > 2 || (CERES_VERSION_MAJOR == 2 && CERES_VERSION_MINOR >= 1)
#define IMU_POSE_CALIB_CERES_HAS_MANIFOLDS 1
#include <ceres/manifold.h>
#include <ceres/sphere_manifold.h>
#else
#define IMU_POSE_CALIB_CERES_HAS_MANIFOLDS 0
#include <ceres/local_parameterization.h>
#endif

namespace imu_pose_calib {

#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
using QuaternionManifold = ceres::EigenQuaternionManifold;
using SphereManifold = ceres::SphereManifold<3>;
#else
using QuaternionManifold = ceres::EigenQuaternionParameterization;
struct SphereManifold : ceres::HomogeneousVectorParameterization {
  SphereManifold() : HomogeneousVectorParameterization(3) {}
};
#endif

/// How a parameter block moves by a step of its degrees of freedom.
enum class BlockKind {
  kVector,
  /// An Eigen quaternion (x, y, z, w) keeps its unit norm. Ceres moves it on the left and by half
  /// the angle: Plus(q, d) turns by 2 d, so a covariance block of q_MI is in M and a quarter of
  /// rad^2.
  kUnitQuaternion,
  kSphere,  ///< a 3-vector keeps its norm; two degrees of freedom remain
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
  else if (kind == BlockKind::kSphere)
    SphereManifold().Plus(before.data(), step, parameters);
  else
    Eigen::Map<Eigen::VectorXd>(parameters, size) += Eigen::Map<const Eigen::VectorXd>(step, size);
}

/// Derivative of a block by a step, which is not a vector's.
inline Eigen::MatrixXd PlusJacobian(BlockKind kind, int size, const double* parameters) {
  Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor> J(size, size - 1);
  const auto find = [&](const auto& manifold) {
#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
    manifold.PlusJacobian(parameters, J.data());
#else
    manifold.ComputeJacobian(parameters, J.data());
#endif
  };
  if (kind == BlockKind::kUnitQuaternion)
    find(QuaternionManifold());
  else
    find(SphereManifold());
  return J;
}

}  // namespace imu_pose_calib
