#include "imu_pose_calib/core/joint_residuals.h"

#include <ceres/jet.h>

#include <Eigen/LU>

#include "imu_pose_calib/core/so3.h"

namespace imu_pose_calib {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

Eigen::Map<Vector3d> AsVector(double* x) { return Eigen::Map<Vector3d>(x); }

/// Ceres' row-major Jacobian of a 3-vector by a block of `Columns` parameters.
template <int Columns>
Eigen::Map<Eigen::Matrix<double, 3, Columns, Eigen::RowMajor>> AsBlock(double* x) {
  return Eigen::Map<Eigen::Matrix<double, 3, Columns, Eigen::RowMajor>>(x);
}

/// Value and derivatives 1..3 (columns) of a spline from its control points.
Eigen::Matrix<double, 3, 4> EvaluateSpline(double const* const* points,
                                           const SplineWeights& weights) {
  Eigen::Matrix<double, 3, 4> x = Eigen::Matrix<double, 3, 4>::Zero();
  for (int j = 0; j < kSplineOrder; ++j)
    x += Eigen::Map<const Vector3d>(points[j]) * weights.col(j).transpose();
  return x;
}

/// d(q^* v)/d(xyzw) for q turned on the left by twice the step, as Ceres' quaternion manifold does:
/// the tangent Jacobian 2 R^T Hat(v) times the pseudo-inverse of the manifold's Plus Jacobian.
Eigen::Matrix<double, 3, 4> InverseRotationJacobian(const Eigen::Quaterniond& q,
                                                    const Vector3d& turned_v) {
  Eigen::Matrix<double, 3, 4> G;      // rows: steps; columns: xyzw
  G << q.w(), -q.z(), q.y(), -q.x(),  //
      q.z(), q.w(), -q.x(), -q.y(),   //
      -q.y(), q.x(), q.w(), -q.z();
  // R^T Hat(v) = Hat(R^T v) R^T
  return 2.0 * Hat(turned_v) * q.conjugate().toRotationMatrix() * G;
}

Eigen::Matrix<double, 3, 4> NoCorrection() { return Eigen::Matrix<double, 3, 4>::Zero(); }

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

/// The corrected motion of the marker at one instant and how it moves with phi, phi', phi'' and t.
struct JointState {
  Eigen::Quaterniond q_WM;
  Vector3d omega, alpha, a_W;
  // Only with Jacobians:
  Matrix3d J;                                  // right Jacobian of phi
  Matrix3d omega_phi, omega_phi1;              // d omega / d phi, phi'
  Matrix3d alpha_phi, alpha_phi1, alpha_phi2;  // d alpha / d phi, phi', phi''
  Vector3d turn, omega_t, alpha_t, a_t;        // body rate of q_WM, time derivatives

  /// phi, d: columns 0..3 are the value and its time derivatives. `time` [s, IMU clock] shifted to
  /// the pose clock.
  JointState(const JointImuSample& sample,
             double time,
             const Eigen::Matrix<double, 3, 4>& phi,
             const Eigen::Matrix<double, 3, 4>& d,
             bool with_jacobians) {
    const double dt = time - sample.t_M;
    const MarkerState<double>& gp = sample.gp;
    const MarkerState<double>& rate = sample.gp_rate;
    const Eigen::Quaterniond q_gp = gp.q_WM * Exp<double>(dt * gp.omega_M);
    const Vector3d omega_gp = gp.omega_M + dt * rate.omega_M;
    const Vector3d alpha_gp = gp.alpha_M + dt * rate.alpha_M;
    const Eigen::Quaterniond E = Exp<double>(phi.col(0));
    q_WM = q_gp * E;

    Vector3d u, u_dot;
    Matrix3d u_phi, udot_phi, udot_phi1, udot_phi2;
    if (with_jacobians) {
      using Jet = ceres::Jet<double, 9>;  // by (phi, phi', phi'')
      Eigen::Matrix<Jet, 3, 1> x[3], u_jet, udot_jet;
      for (int k = 0; k < 3; ++k)
        for (int i = 0; i < 3; ++i) x[k][i] = Jet(phi(i, k), 3 * k + i);
      CorrectionRate(x[0], x[1], x[2], &u_jet, &udot_jet);
      for (int i = 0; i < 3; ++i) {
        u[i] = u_jet[i].a;
        u_phi.row(i) = u_jet[i].v.head<3>();
        J.row(i) = u_jet[i].v.segment<3>(3);
        u_dot[i] = udot_jet[i].a;
        udot_phi.row(i) = udot_jet[i].v.head<3>();
        udot_phi1.row(i) = udot_jet[i].v.segment<3>(3);
        udot_phi2.row(i) = udot_jet[i].v.tail<3>();
      }
    } else {
      CorrectionRate<double>(phi.col(0), phi.col(1), phi.col(2), &u, &u_dot);
    }

    const Vector3d omega_E = E.conjugate() * omega_gp;  // E^T omega_gp
    const Vector3d alpha_E = E.conjugate() * alpha_gp;
    omega = omega_E + u;
    alpha = alpha_E - u.cross(omega_E) + u_dot;
    a_W = gp.a_W + dt * rate.a_W + d.col(2);
    if (!with_jacobians) return;

    // d(E^T v)/d phi = Hat(E^T v) J
    const Matrix3d omega_E_phi = Hat(omega_E) * J;
    omega_phi = omega_E_phi + u_phi;
    omega_phi1 = J;
    alpha_phi = Hat(alpha_E) * J + Hat(omega_E) * u_phi - Hat(u) * omega_E_phi + udot_phi;
    alpha_phi1 = Hat(omega_E) * J + udot_phi1;
    alpha_phi2 = udot_phi2;
    const Vector3d omega_E_t = E.conjugate() * rate.omega_M;
    turn = E.conjugate() * gp.omega_M + u;
    omega_t = omega_phi * phi.col(1) + omega_phi1 * phi.col(2) + omega_E_t;
    alpha_t = alpha_phi * phi.col(1) + alpha_phi1 * phi.col(2) + alpha_phi2 * phi.col(3) +
              E.conjugate() * rate.alpha_M - u.cross(omega_E_t);
    a_t = rate.a_W + d.col(3);
  }
};

class PositionResidual : public ceres::CostFunction {
 public:
  PositionResidual(const Vector3d& measured, const SplineWeights& weights, double sigma)
      : measured_(measured), weights_(weights.row(0)), sigma_(sigma) {
    set_num_residuals(3);
    mutable_parameter_block_sizes()->assign(kSplineOrder, 3);
  }

  bool Evaluate(double const* const* points, double* residual, double** jacobians) const override {
    Eigen::Map<Vector3d> r(residual);
    r = measured_;
    for (int j = 0; j < kSplineOrder; ++j) r -= weights_[j] * Eigen::Map<const Vector3d>(points[j]);
    r /= sigma_;
    for (int j = 0; jacobians != nullptr && j < kSplineOrder; ++j)
      if (jacobians[j] != nullptr)
        AsBlock<3>(jacobians[j]) = -weights_[j] / sigma_ * Matrix3d::Identity();
    return true;
  }

 private:
  const Vector3d measured_;
  const Eigen::Matrix<double, 1, kSplineOrder> weights_;
  const double sigma_;
};

class RotationResidual : public ceres::CostFunction {
 public:
  RotationResidual(const Eigen::Quaterniond& measured, const SplineWeights& weights, double sigma)
      : measured_(measured), weights_(weights), sigma_(sigma) {
    set_num_residuals(3);
    mutable_parameter_block_sizes()->assign(kSplineOrder, 3);
  }

  bool Evaluate(double const* const* points, double* residual, double** jacobians) const override {
    const Vector3d phi = EvaluateSpline(points, weights_).col(0);
    const Vector3d error = Log(Eigen::Quaterniond(Exp<double>(-phi) * measured_));
    AsVector(residual) = error / sigma_;
    if (jacobians == nullptr) return true;
    // Log(Exp(-J_r(phi) delta) Exp(error)) = error - J_l(error)^-1 J_r(phi) delta, J_l(x) = J_r(-x)
    const Matrix3d d_error = -RightJacobian<double>(-error).inverse() * RightJacobian(phi) / sigma_;
    for (int j = 0; j < kSplineOrder; ++j)
      if (jacobians[j] != nullptr) AsBlock<3>(jacobians[j]) = weights_(0, j) * d_error;
    return true;
  }

 private:
  const Eigen::Quaterniond measured_;
  const SplineWeights weights_;
  const double sigma_;
};

/// How far beyond its span an instant may move while the time shift is estimated: the cubic goes
/// on, and the next solve finds the right span.
bool IsNearSpan(double u) { return u > -2.0 && u < 3.0; }

class JointGyroResidual : public ceres::CostFunction {
 public:
  explicit JointGyroResidual(const JointImuSample& sample) : s_(sample) {
    set_num_residuals(3);
    mutable_parameter_block_sizes()->assign(kSplineOrder, 3);
    mutable_parameter_block_sizes()->insert(mutable_parameter_block_sizes()->end(), {4, 3, 3, 1});
  }

  bool Evaluate(double const* const* blocks, double* residual, double** jacobians) const override {
    const int n = kSplineOrder;
    const Eigen::Map<const Eigen::Quaterniond> q_MI(blocks[n]);
    const Eigen::Map<const Vector3d> knot_0(blocks[n + 1]), knot_1(blocks[n + 2]);
    const double t = s_.t + *blocks[n + 3];
    const double u = s_.place.u + (t - s_.t_M) / s_.place.spacing;
    if (!IsNearSpan(u)) return false;
    const SplineWeights weights = CubicWeights(u, s_.place.spacing);
    const JointState state(
        s_, t, EvaluateSpline(blocks, weights), NoCorrection(), jacobians != nullptr);
    const Vector3d omega_I = q_MI.conjugate() * state.omega;
    AsVector(residual) =
        (s_.value - (1.0 - s_.bias_u) * knot_0 - s_.bias_u * knot_1 - omega_I) / s_.sigma;
    if (jacobians == nullptr) return true;

    const Matrix3d A = -q_MI.conjugate().toRotationMatrix() / s_.sigma;  // d r / d omega_M
    const Matrix3d r_phi = A * state.omega_phi;
    const Matrix3d r_phi1 = A * state.omega_phi1;
    for (int j = 0; j < n; ++j)
      if (jacobians[j] != nullptr)
        AsBlock<3>(jacobians[j]) = weights(0, j) * r_phi + weights(1, j) * r_phi1;
    if (jacobians[n] != nullptr)
      AsBlock<4>(jacobians[n]) = -InverseRotationJacobian(q_MI, omega_I) / s_.sigma;
    if (jacobians[n + 1] != nullptr)
      AsBlock<3>(jacobians[n + 1]) = -(1.0 - s_.bias_u) / s_.sigma * Matrix3d::Identity();
    if (jacobians[n + 2] != nullptr)
      AsBlock<3>(jacobians[n + 2]) = -s_.bias_u / s_.sigma * Matrix3d::Identity();
    if (jacobians[n + 3] != nullptr) AsVector(jacobians[n + 3]) = A * state.omega_t;
    return true;
  }

 private:
  const JointImuSample s_;
};

class JointAccelResidual : public ceres::CostFunction {
 public:
  explicit JointAccelResidual(const JointImuSample& sample) : s_(sample) {
    set_num_residuals(3);
    mutable_parameter_block_sizes()->assign(2 * kSplineOrder, 3);
    mutable_parameter_block_sizes()->insert(mutable_parameter_block_sizes()->end(),
                                            {4, 3, 3, 3, 3, 1, 1});
  }

  bool Evaluate(double const* const* blocks, double* residual, double** jacobians) const override {
    const int n = 2 * kSplineOrder;
    const Eigen::Map<const Eigen::Quaterniond> q_MI(blocks[n]);
    const Eigen::Map<const Vector3d> p(blocks[n + 1]), g(blocks[n + 2]);
    const Eigen::Map<const Vector3d> knot_0(blocks[n + 3]), knot_1(blocks[n + 4]);
    const double t = s_.t + *blocks[n + 5] - *blocks[n + 6];
    const double u = s_.place.u + (t - s_.t_M) / s_.place.spacing;
    if (!IsNearSpan(u)) return false;
    const SplineWeights weights = CubicWeights(u, s_.place.spacing);
    const JointState x(s_,
                       t,
                       EvaluateSpline(blocks + kSplineOrder, weights),
                       EvaluateSpline(blocks, weights),
                       jacobians != nullptr);
    const Vector3d f_body = x.q_WM.conjugate() * (x.a_W - g);  // R_WM^T (a_W - g_W)
    const Vector3d f_M = f_body + x.alpha.cross(p) + x.omega.cross(x.omega.cross(p));
    const Vector3d f_I = q_MI.conjugate() * f_M;
    AsVector(residual) =
        (s_.value - (1.0 - s_.bias_u) * knot_0 - s_.bias_u * knot_1 - f_I) / s_.sigma;
    if (jacobians == nullptr) return true;

    const Matrix3d A = -q_MI.conjugate().toRotationMatrix() / s_.sigma;  // d r / d f_M
    const Matrix3d R_MW = x.q_WM.conjugate().toRotationMatrix();
    const Matrix3d W = Hat(x.omega);
    // d (omega x (omega x p)) / d omega
    const Matrix3d f_omega = -Hat<double>(x.omega.cross(p)) - W * Hat<double>(p);
    const Matrix3d f_alpha = -Hat<double>(p);
    const Matrix3d r_phi = A * (Hat(f_body) * x.J + f_omega * x.omega_phi + f_alpha * x.alpha_phi);
    const Matrix3d r_phi1 = A * (f_omega * x.omega_phi1 + f_alpha * x.alpha_phi1);
    const Matrix3d r_phi2 = A * f_alpha * x.alpha_phi2;
    const Matrix3d r_d2 = A * R_MW;
    for (int j = 0; j < kSplineOrder; ++j) {
      if (jacobians[j] != nullptr) AsBlock<3>(jacobians[j]) = weights(2, j) * r_d2;
      if (jacobians[kSplineOrder + j] != nullptr)
        AsBlock<3>(jacobians[kSplineOrder + j]) =
            weights(0, j) * r_phi + weights(1, j) * r_phi1 + weights(2, j) * r_phi2;
    }
    if (jacobians[n] != nullptr)
      AsBlock<4>(jacobians[n]) = -InverseRotationJacobian(q_MI, f_I) / s_.sigma;
    if (jacobians[n + 1] != nullptr) AsBlock<3>(jacobians[n + 1]) = A * (Hat(x.alpha) + W * W);
    if (jacobians[n + 2] != nullptr) AsBlock<3>(jacobians[n + 2]) = -A * R_MW;
    if (jacobians[n + 3] != nullptr)
      AsBlock<3>(jacobians[n + 3]) = -(1.0 - s_.bias_u) / s_.sigma * Matrix3d::Identity();
    if (jacobians[n + 4] != nullptr)
      AsBlock<3>(jacobians[n + 4]) = -s_.bias_u / s_.sigma * Matrix3d::Identity();
    const Vector3d r_t =
        A * (R_MW * x.a_t - x.turn.cross(f_body) + f_omega * x.omega_t + f_alpha * x.alpha_t);
    if (jacobians[n + 5] != nullptr) AsVector(jacobians[n + 5]) = r_t;
    if (jacobians[n + 6] != nullptr) AsVector(jacobians[n + 6]) = -r_t;
    return true;
  }

 private:
  const JointImuSample s_;
};

}  // namespace

ceres::CostFunction* CreatePositionResidual(const Eigen::Vector3d& p_meas_minus_gp_W,
                                            const SplineWeights& weights,
                                            double sigma) {
  return new PositionResidual(p_meas_minus_gp_W, weights, sigma);
}

ceres::CostFunction* CreateRotationResidual(const Eigen::Quaterniond& q_gp_meas,
                                            const SplineWeights& weights,
                                            double sigma) {
  return new RotationResidual(q_gp_meas, weights, sigma);
}

ceres::CostFunction* CreateJointGyroResidual(const JointImuSample& sample) {
  return new JointGyroResidual(sample);
}

ceres::CostFunction* CreateJointAccelResidual(const JointImuSample& sample) {
  return new JointAccelResidual(sample);
}

}  // namespace imu_pose_calib
