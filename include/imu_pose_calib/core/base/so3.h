#pragma once

#include <ceres/rotation.h>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <cmath>

/// The rotation group, once. All functions take any scalar (double, ceres::Jet); values and
/// derivatives are exact at zero.
namespace imu_pose_calib {

/// Hat(a) b = a x b.
template <typename T>
Eigen::Matrix<T, 3, 3> Hat(const Eigen::Matrix<T, 3, 1>& a) {
  Eigen::Matrix<T, 3, 3> A;
  A << T(0), -a.z(), a.y(),  //
      a.z(), T(0), -a.x(),   //
      -a.y(), a.x(), T(0);
  return A;
}

/// Rotation by the vector r [rad] as a unit quaternion.
template <typename T>
Eigen::Quaternion<T> Exp(const Eigen::Matrix<T, 3, 1>& r) {
  T q[4];  // w first
  ceres::AngleAxisToQuaternion(r.data(), q);
  return {q[0], q[1], q[2], q[3]};
}

/// Rotation vector [rad] of the unit quaternion q, norm at most pi. Log(Exp(r)) = r for |r| < pi.
template <typename T>
Eigen::Matrix<T, 3, 1> Log(const Eigen::Quaternion<T>& q) {
  const T coefficients[] = {q.w(), q.x(), q.y(), q.z()};
  Eigen::Matrix<T, 3, 1> r;
  ceres::QuaternionToAngleAxis(coefficients, r.data());
  return r;
}

namespace internal {

/// b = (1 - cos x) / x^2 and c = (x - sin x) / x^3 (j_1 and j_2 of doc/math.md) with their
/// derivatives by s = x^2.
template <typename T>
struct JacobianTerms {
  T b, c, db, dc;

  explicit JacobianTerms(const T& s) {
    using std::cos;
    using std::sin;
    using std::sqrt;
    if (s < T(1e-2)) {
      b = T(1. / 2) - s * (T(1. / 24) - s * (T(1. / 720) - s * T(1. / 40320)));
      c = T(1. / 6) - s * (T(1. / 120) - s * (T(1. / 5040) - s * T(1. / 362880)));
      db = -T(1. / 24) + s * (T(2. / 720) - s * (T(3. / 40320) - s * T(4. / 3628800)));
      dc = -T(1. / 120) + s * (T(2. / 5040) - s * (T(3. / 362880) - s * T(4. / 39916800)));
      return;
    }
    const T x = sqrt(s);
    const T one_minus_cos = T(1) - cos(x);
    const T x_minus_sin = x - sin(x);
    b = one_minus_cos / s;
    c = x_minus_sin / (s * x);
    db = (x * sin(x) / T(2) - one_minus_cos) / (s * s);
    dc = (x * one_minus_cos - T(3) * x_minus_sin) / (T(2) * s * s * x);
  }
};

}  // namespace internal

/// Body rate u of Exp(phi), by the right Jacobian J_r (Exp(phi + d) = Exp(phi) Exp(J_r(phi) d) to
/// first order in d), and its time derivative: u = J_r(phi) phi'; with m = phi x phi',
///   u     = phi' - b m + c phi x m
///   du/dt = J_r(phi) phi'' - b' m + c' phi x m + c phi' x m.
template <typename T>
void CorrectionRate(const Eigen::Matrix<T, 3, 1>& phi, const Eigen::Matrix<T, 3, 1>& phi1,
                    const Eigen::Matrix<T, 3, 1>& phi2, Eigen::Matrix<T, 3, 1>* u,
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
