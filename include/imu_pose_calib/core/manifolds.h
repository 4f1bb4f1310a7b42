#pragma once

#include <ceres/problem.h>
#include <ceres/version.h>

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

/// Keeps an Eigen quaternion (x, y, z, w) of unit norm. Ceres moves it on the left and by half the
/// angle: Plus(q, d) turns by 2 d, so a covariance block of q_MI is in M and a quarter of rad^2.
inline void SetUnitQuaternion(double* xyzw, ceres::Problem* problem) {
#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
  problem->SetManifold(xyzw, new ceres::EigenQuaternionManifold);
#else
  problem->SetParameterization(xyzw, new ceres::EigenQuaternionParameterization);
#endif
}

/// Keeps the norm of a 3-vector; two degrees of freedom remain.
inline void SetSphere(double* vector3, ceres::Problem* problem) {
#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
  problem->SetManifold(vector3, new ceres::SphereManifold<3>);
#else
  problem->SetParameterization(vector3, new ceres::HomogeneousVectorParameterization(3));
#endif
}

/// Degrees of freedom of a parameter block.
inline int TangentSize(const ceres::Problem& problem, const double* parameters) {
#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
  return problem.ParameterBlockTangentSize(parameters);
#else
  return problem.ParameterBlockLocalSize(parameters);
#endif
}

}  // namespace imu_pose_calib
