#pragma once

#include <ceres/problem.h>
#include <ceres/version.h>

#include <Eigen/Core>
#include <algorithm>
#include <vector>

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

/// Moves a parameter block by a step in its tangent space.
inline void MoveBlock(const ceres::Problem& problem, const double* step, double* parameters) {
  const int size = problem.ParameterBlockSize(parameters);
  Eigen::VectorXd moved(size);
#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
  const ceres::Manifold* manifold = problem.GetManifold(parameters);
#else
  const ceres::LocalParameterization* manifold = problem.GetParameterization(parameters);
#endif
  if (manifold == nullptr)
    moved = Eigen::Map<const Eigen::VectorXd>(parameters, size) +
            Eigen::Map<const Eigen::VectorXd>(step, size);
  else
    manifold->Plus(parameters, step, moved.data());
  Eigen::Map<Eigen::VectorXd>(parameters, size) = moved;
}

/// Derivative of a parameter block by a step in its tangent space, which has a manifold.
inline Eigen::MatrixXd PlusJacobian(const ceres::Problem& problem, const double* parameters) {
  auto* block = const_cast<double*>(parameters);  // Ceres asks for it
#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
  const int size = problem.ParameterBlockTangentSize(block);
#else
  const int size = problem.ParameterBlockLocalSize(block);
#endif
  Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor> J(
      problem.ParameterBlockSize(block), size);
#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
  problem.GetManifold(block)->PlusJacobian(block, J.data());
#else
  problem.GetParameterization(block)->ComputeJacobian(block, J.data());
#endif
  return J;
}

/// Degrees of freedom of a parameter block.
inline int TangentSize(const ceres::Problem& problem, const double* parameters) {
#if IMU_POSE_CALIB_CERES_HAS_MANIFOLDS
  return problem.ParameterBlockTangentSize(parameters);
#else
  return problem.ParameterBlockLocalSize(parameters);
#endif
}

/// Moves parameter blocks one after the other by a step of all; returns the values before.
inline Eigen::VectorXd MoveBlocks(const ceres::Problem& problem,
                                  const std::vector<double*>& blocks,
                                  const Eigen::VectorXd& step) {
  std::vector<double> before;
  const double* next = step.data();
  for (double* block : blocks) {
    before.insert(before.end(), block, block + problem.ParameterBlockSize(block));
    MoveBlock(problem, next, block);
    next += TangentSize(problem, block);
  }
  return Eigen::Map<Eigen::VectorXd>(before.data(), static_cast<Eigen::Index>(before.size()));
}

/// Puts them back.
inline void RestoreBlocks(const ceres::Problem& problem,
                          const std::vector<double*>& blocks,
                          const Eigen::VectorXd& before) {
  const double* next = before.data();
  for (double* block : blocks) {
    const int size = problem.ParameterBlockSize(block);
    std::copy(next, next + size, block);
    next += size;
  }
}

}  // namespace imu_pose_calib
