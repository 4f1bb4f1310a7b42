#pragma once

#include "imu_pose_calib/core/so3.h"
#include "imu_pose_calib/core/spline.h"

namespace imu_pose_calib {

/// How the splines of the joint solve correct the trajectory of S1, doc/math.md Eqs. (9), (10).

/// Value and derivatives 1..3 (columns) of a spline from its control points.
template <typename T>
Eigen::Matrix<T, 3, 4> EvaluateSpline(T const* const* points, const SplineWeights& weights) {
  Eigen::Matrix<T, 3, kSplineOrder> P;
  for (int j = 0; j < kSplineOrder; ++j)
    P.col(j) = Eigen::Map<const Eigen::Matrix<T, 3, 1>>(points[j]);
  return P * weights.transpose().template cast<T>();
}

/// u = J_r(phi) phi' and its time derivative, as cross products: with m = phi x phi',
///   u     = phi' - b m + c phi x m
///   du/dt = J_r(phi) phi'' - b' m + c' phi x m + c phi' x m.
template <typename T>
void CorrectionRate(const Eigen::Matrix<T, 3, 1>& phi,
                    const Eigen::Matrix<T, 3, 1>& phi1,
                    const Eigen::Matrix<T, 3, 1>& phi2,
                    Eigen::Matrix<T, 3, 1>* u,
                    Eigen::Matrix<T, 3, 1>* u_dot) {
  using Vector3 = Eigen::Matrix<T, 3, 1>;
  const internal::JacobianTerms<T> j(phi.squaredNorm());
  const T s_dot = T(2) * phi.dot(phi1);
  const Vector3 m = phi.cross(phi1);
  const Vector3 n = phi.cross(phi2);
  const Vector3 phi_m = phi.cross(m);
  *u = phi1 - j.b * m + j.c * phi_m;
  *u_dot = phi2 - j.b * n + j.c * phi.cross(n) - s_dot * j.db * m + s_dot * j.dc * phi_m +
           j.c * phi1.cross(m);
}

}  // namespace imu_pose_calib
