#include "imu_pose_calib/core/calibration/joint_residuals.h"

#include <Eigen/LU>
#include <initializer_list>
#include <memory>
#include <utility>

#include "imu_pose_calib/core/base/intrinsics.h"
#include "imu_pose_calib/core/base/so3.h"

namespace imu_pose_calib {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

Eigen::Map<Vector3d> AsVector(double* x) { return Eigen::Map<Vector3d>(x); }

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

/// The corrected rotation of the marker at one instant and how it moves with phi, phi' and phi''.
struct CorrectedRotation {
  Eigen::Quaterniond E;  // Exp(phi)
  Vector3d omega, alpha;
  // Only with derivatives:
  Matrix3d J;                       // right Jacobian of phi; d omega / d phi', d alpha / d phi''
  Matrix3d omega_phi;               // d omega / d phi
  Matrix3d alpha_phi, alpha_phi1;   // d alpha / d phi, phi'
  Vector3d omega_rate, alpha_rate;  // by time; of alpha without what alpha_gp changes by

  /// Derivatives that are wanted: none, of omega, of both.
  enum Derivatives { kNone, kOfOmega, kOfBoth };

  /// phi: columns 0..3 are the value and its time derivatives.
  CorrectedRotation(const Vector3d& omega_gp_M, const Vector3d& alpha_gp_M,
                    const Eigen::Matrix<double, 3, 4>& phi, Derivatives wanted)
      : E(Exp<double>(phi.col(0))) {
    Vector3d u, u_dot;
    CorrectionRate<double>(phi.col(0), phi.col(1), phi.col(2), &u, &u_dot);
    const Vector3d omega_E = E.conjugate() * omega_gp_M;  // E^T omega_gp
    const Vector3d alpha_E = E.conjugate() * alpha_gp_M;
    omega = omega_E + u;
    alpha = alpha_E - u.cross(omega_E) + u_dot;
    if (wanted == kNone) return;

    // With phi = w, phi' = x, phi'' = y, and b and c of RightJacobian() and their derivatives by
    // |w|^2: d(J v)/d w, and with it that of u = J x.
    const internal::JacobianTerms<double> j(phi.col(0).squaredNorm());
    const Vector3d w = phi.col(0), x = phi.col(1), y = phi.col(2), p = w.cross(x), r = w.cross(p);
    const Matrix3d W = Hat(w), X = Hat(x), WX = W * X;
    const auto slope = [&](const Vector3d& wv, const Matrix3d& V,
                           const Matrix3d& turned) -> Matrix3d {
      return 2.0 * (j.dc * w.cross(wv) - j.db * wv) * w.transpose() + j.b * V -
             j.c * (Hat(wv) + turned);
    };
    const Matrix3d WW = W * W, u_phi = slope(p, X, WX);
    J = Matrix3d::Identity() - j.b * W + j.c * WW;
    // d(E^T v)/d phi = Hat(E^T v) J
    const Matrix3d omega_E_J = Hat(omega_E) * J;
    omega_phi = omega_E_J + u_phi;
    omega_rate = omega_phi * x + J * y + alpha_E;
    if (wanted == kOfOmega) return;

    // u' = J y + d(J x)/d w x, of which the second is 2 w.x (dc r - db p) + c x x p.
    const double wx = 2.0 * w.dot(x);
    const Vector3d by_w = 2.0 * (wx * (j.ddc * r - j.ddb * p) + j.dc * x.cross(p));
    const Matrix3d Y = Hat(y);
    const Matrix3d udot_phi = slope(w.cross(y), Y, W * Y) + by_w * w.transpose() +
                              2.0 * (j.dc * r - j.db * p) * x.transpose() +
                              wx * (j.db * X - j.dc * (Hat(p) + WX)) - j.c * X * X;
    // The rate of J, and d u / d w again.
    const Matrix3d udot_phi1 = wx * (j.dc * WW - j.db * W) - j.b * X + j.c * (X * W + WX) + u_phi;
    alpha_phi = Hat(alpha_E) * J + Hat(omega_E) * u_phi - Hat(u) * omega_E_J + udot_phi;
    alpha_phi1 = omega_E_J + udot_phi1;
    alpha_rate = alpha_phi * x + alpha_phi1 * y + J * phi.col(3) - u.cross(alpha_E);
  }
};

/// How far beyond its span a sample may move while the clocks are estimated: the cubic goes on, and
/// the next solve finds the right span.
bool IsNearSpan(double u) { return u > -2.0 && u < 3.0; }

/// Three rows of the Jacobians of all blocks, where they are wanted.
struct JacobianRows {
  double** blocks;         ///< null: of none
  Eigen::Index first_row;  ///< of them
};

template <int Columns, typename Matrix>
void SetRows(const JacobianRows& rows, int block, const Matrix& J) {
  if (rows.blocks[block] == nullptr) return;
  constexpr int kOptions = Columns == 1 ? Eigen::ColMajor : Eigen::RowMajor;
  Eigen::Map<Eigen::Matrix<double, 3, Columns, kOptions>>(rows.blocks[block] +
                                                          rows.first_row * Columns) = J;
}

/// Of two knots that act with these factors.
void SetKnotRows(const JacobianRows& rows, int knot, double factor_0, double factor_1) {
  SetRows<3>(rows, knot, factor_0 * Matrix3d::Identity());
  SetRows<3>(rows, knot + 1, factor_1 * Matrix3d::Identity());
}

double Factor(const ClockMotion& clock, const JointSample& s) {
  return clock.sign * (clock.factor == ClockMotion::kOwnTime ? s.own_time : 1.0);
}

/// x less what is linear between two knots.
Vector3d LessKnots(const Vector3d& x, double u, double const* const* knots) {
  const Eigen::Map<const Vector3d> knot_0(knots[0]), knot_1(knots[1]);
  return x - (1.0 - u) * knot_0 - u * knot_1;
}

/// Residuals of samples, evaluated one by one.
template <typename Sample>
class BatchResidual : public SampledCost {
 public:
  /// Sizes of the blocks between splines and clocks.
  BatchResidual(Samples<Sample> samples, int splines, std::initializer_list<int> others,
                const ClockMotions& clocks = std::make_shared<const std::vector<ClockMotion>>(),
                bool has_walk = false)
      : has_walk_(has_walk),
        first_clock_(splines * kSplineOrder + static_cast<int>(others.size())),
        walk_knot_(first_clock_ + static_cast<int>(clocks->size())),
        samples_(std::move(samples)),
        clocks_(clocks) {
    set_num_residuals(3 * static_cast<int>(samples_.size()));
    std::vector<int>* sizes = mutable_parameter_block_sizes();
    sizes->assign(static_cast<size_t>(splines) * kSplineOrder, 3);
    sizes->insert(sizes->end(), others);
    sizes->insert(sizes->end(), clocks_->size() + (has_walk ? 2 : 0), 1);
  }

  bool EvaluatePart(size_t begin, size_t end, double const* const* blocks, double* residual,
                    double** jacobians) const override {
    JacobianRows rows{jacobians, 0};
    for (size_t i = begin; i < end; ++i, residual += 3, rows.first_row += 3) {
      const Sample sample = samples_[i];
      const double dt = FindMove(sample, blocks);
      const double u = sample.place.u + dt / sample.place.spacing;
      if (!IsNearSpan(u)) return false;
      EvaluateSample(sample, dt, CubicWeights(u, sample.place.spacing), blocks, residual, rows);
    }
    return true;
  }

 protected:
  /// Three residuals, and rows of the Jacobians if they are wanted, of a sample that has moved by
  /// `t` [s] along the GP.
  virtual void EvaluateSample(const Sample& sample, double t, const SplineWeights& weights,
                              double const* const* blocks, double* residual,
                              const JacobianRows& jacobians) const = 0;

  /// Columns of the clocks from the derivative of the residual by time.
  void SetClockRows(const Sample& sample, const Vector3d& r_rate,
                    const JacobianRows& jacobians) const {
    int block = first_clock_;
    for (const ClockMotion& clock : *clocks_)
      SetRows<1>(jacobians, block++, Vector3d(Factor(clock, sample) * r_rate));
    if (!has_walk_) return;
    SetRows<1>(jacobians, walk_knot_, Vector3d((1.0 - sample.walk_u) * r_rate));
    SetRows<1>(jacobians, walk_knot_ + 1, Vector3d(sample.walk_u * r_rate));
  }

 private:
  /// How far a sample has moved [s].
  double FindMove(const Sample& sample, double const* const* blocks) const {
    double dt = 0.0;
    int block = first_clock_;
    for (const ClockMotion& clock : *clocks_)
      dt += Factor(clock, sample) * (*blocks[block++] - clock.value);
    if (!has_walk_) return dt;
    const double u = sample.walk_u;
    return dt + (1.0 - u) * *blocks[walk_knot_] + u * *blocks[walk_knot_ + 1] - sample.walk;
  }

  const bool has_walk_;
  const int first_clock_, walk_knot_;
  const Samples<Sample> samples_;
  const ClockMotions clocks_;
};

class JointPositionResidual : public BatchResidual<JointPositionSample> {
 public:
  JointPositionResidual(Samples<JointPositionSample> samples, const ClockMotions& clocks)
      : BatchResidual(std::move(samples), 1, {3, 3, 1, 1, 1, 2, 2}, clocks) {}

 protected:
  void EvaluateSample(const JointPositionSample& s, double t, const SplineWeights& weights,
                      double const* const* blocks, double* residual,
                      const JacobianRows& jacobians) const override {
    const int n = kSplineOrder;
    const Eigen::Matrix<double, 3, 4> d = EvaluateSpline(blocks, weights);
    const double c = 0.5 * (*blocks[n + 2] + *blocks[n + 3] - *blocks[n + 4]);
    const Vector3d curvature = s.curvature + s.spline_share * d.col(2);
    const Vector3d error = s.p_error - t * s.v_W - d.col(0) - c * curvature -
                           s.higher * (Eigen::Map<const Eigen::Vector2d>(blocks[n + 5]) +
                                       Eigen::Map<const Eigen::Vector2d>(blocks[n + 6]));
    AsVector(residual) = LessKnots(error, s.error_u, blocks + n) / s.sigma;
    if (jacobians.blocks == nullptr) return;
    for (int j = 0; j < n; ++j)
      SetRows<3>(
          jacobians, j,
          -(weights(0, j) + c * s.spline_share * weights(2, j)) / s.sigma * Matrix3d::Identity());
    SetKnotRows(jacobians, n, -(1.0 - s.error_u) / s.sigma, -s.error_u / s.sigma);
    for (const int smoothing : {n + 2, n + 3})
      SetRows<1>(jacobians, smoothing, -0.5 / s.sigma * curvature);
    SetRows<1>(jacobians, n + 4, 0.5 / s.sigma * curvature);
    for (const int cumulants : {n + 5, n + 6})
      SetRows<2>(jacobians, cumulants, -s.higher / s.sigma);
    SetClockRows(s, -1.0 / s.sigma * (s.v_W + d.col(1) + c * s.spline_share * d.col(3)), jacobians);
  }
};

class JointRotationResidual : public BatchResidual<JointRotationSample> {
 public:
  explicit JointRotationResidual(Samples<JointRotationSample> samples)
      : BatchResidual(std::move(samples), 1, {3, 3, 1, 2}) {}

 protected:
  void EvaluateSample(const JointRotationSample& s, double, const SplineWeights& weights,
                      double const* const* blocks, double* residual,
                      const JacobianRows& jacobians) const override {
    const int n = kSplineOrder;
    const Eigen::Matrix<double, 3, 4> phi = EvaluateSpline(blocks, weights);
    const Eigen::Quaterniond E_inv = Exp<double>(-phi.col(0));
    const double c = 0.5 * *blocks[n + 2];
    const Vector3d curvature = s.curvature + s.spline_share * phi.col(2);
    const Vector3d lag =
        c * curvature + s.higher * Eigen::Map<const Eigen::Vector2d>(blocks[n + 3]);
    const Eigen::Quaterniond lag_inv = Exp<double>(-lag);
    const Vector3d error = Log(Eigen::Quaterniond(lag_inv * E_inv * s.q_error));
    AsVector(residual) = LessKnots(error, s.error_u, blocks + n) / s.sigma;
    if (jacobians.blocks == nullptr) return;
    // Log(Exp(-delta) Exp(error)) = error - J_l(error)^-1 delta with J_l(x) = J_r(-x); delta is
    // J_r(lag) d lag, and before that J_r(phi) dphi.
    const Matrix3d A = -RightJacobian<double>(-error).inverse() / s.sigma;
    const Matrix3d A_lag = A * RightJacobian<double>(lag);
    const Matrix3d A_phi = A * lag_inv.toRotationMatrix();
    const Matrix3d J = RightJacobian<double>(phi.col(0));
    for (int j = 0; j < n; ++j)
      SetRows<3>(jacobians, j,
                 weights(0, j) * A_phi * J + weights(2, j) * c * s.spline_share * A_lag);
    SetKnotRows(jacobians, n, -(1.0 - s.error_u) / s.sigma, -s.error_u / s.sigma);
    SetRows<1>(jacobians, n + 2, 0.5 * A_lag * curvature);
    SetRows<2>(jacobians, n + 3, A_lag * s.higher);
  }
};

class JointGyroResidual : public BatchResidual<JointImuSample> {
 public:
  JointGyroResidual(Samples<JointImuSample> samples, const ClockMotions& clocks, bool has_walk)
      : BatchResidual(std::move(samples), 1, {3, 3, 4, 6, 1, 1}, clocks, has_walk) {}

 protected:
  void EvaluateSample(const JointImuSample& s, double t, const SplineWeights& weights,
                      double const* const* blocks, double* residual,
                      const JacobianRows& jacobians) const override {
    const int n = kSplineOrder;
    const Eigen::Map<const Eigen::Quaterniond> q_MI(blocks[n + 2]);
    const Matrix3d K_g = GyroMatrix(Eigen::Map<const Vector6d>(blocks[n + 3]));
    const Vector3d omega_gp = s.omega_M + t * s.alpha_M;
    const CorrectedRotation x(
        omega_gp, s.alpha_M, EvaluateSpline(blocks, weights),
        jacobians.blocks != nullptr ? CorrectedRotation::kOfOmega : CorrectedRotation::kNone);
    const Vector3d omega_I = q_MI.conjugate() * (x.omega + 0.5 * *blocks[n + 4] * s.curvature +
                                                 0.5 * *blocks[n + 5] * s.cone);
    AsVector(residual) = (LessKnots(s.value, s.bias_u, blocks + n) - K_g * omega_I) / s.sigma;
    if (jacobians.blocks == nullptr) return;

    // d r / d omega_M
    const Matrix3d A = -K_g * q_MI.conjugate().toRotationMatrix() / s.sigma;
    const Matrix3d r_phi = A * x.omega_phi;
    const Matrix3d r_phi1 = A * x.J;
    for (int j = 0; j < n; ++j)
      SetRows<3>(jacobians, j, weights(0, j) * r_phi + weights(1, j) * r_phi1);
    SetKnotRows(jacobians, n, -(1.0 - s.bias_u) / s.sigma, -s.bias_u / s.sigma);
    SetRows<4>(jacobians, n + 2, -K_g * InverseRotationJacobian(q_MI, omega_I) / s.sigma);
    if (jacobians.blocks[n + 3] != nullptr) {
      Eigen::Matrix<double, 3, 6> r_M = Eigen::Matrix<double, 3, 6>::Zero();
      r_M.block<1, 1>(0, 0) = omega_I.head<1>();
      r_M.block<1, 2>(1, 1) = omega_I.head<2>().transpose();
      r_M.block<1, 3>(2, 3) = omega_I.transpose();
      SetRows<6>(jacobians, n + 3, -r_M / s.sigma);
    }
    SetRows<1>(jacobians, n + 4, 0.5 * A * s.curvature);
    SetRows<1>(jacobians, n + 5, 0.5 * A * s.cone);
    SetClockRows(s, A * x.omega_rate, jacobians);
  }
};

class JointAccelResidual : public BatchResidual<JointAccelSample> {
 public:
  JointAccelResidual(Samples<JointAccelSample> samples, const Matrix3d& R_MA,
                     const ClockMotions& clocks, bool has_walk)
      : BatchResidual(std::move(samples), 2, {3, 3, 4, 9, 3, 3, 1, 1, 1, 6, 1, 1, 1}, clocks,
                      has_walk),
        R_MA_(R_MA) {}

 protected:
  void EvaluateSample(const JointAccelSample& s, double t, const SplineWeights& weights,
                      double const* const* blocks, double* residual,
                      const JacobianRows& jacobians) const override {
    const int n = 2 * kSplineOrder;
    const Eigen::Map<const Eigen::Quaterniond> q_MI(blocks[n + 2]);
    const Matrix3d K_a = AccelMatrix(Eigen::Map<const Vector9d>(blocks[n + 3]));
    const Eigen::Map<const Vector3d> p(blocks[n + 4]), g(blocks[n + 5]);
    const Eigen::Quaterniond q_gp = s.q_WM * Exp<double>(t * (s.omega_M + 0.5 * t * s.alpha_M));
    const Vector3d omega_gp = s.omega_M + t * (s.alpha_M + 0.5 * t * s.alpha_rate);
    const Vector3d alpha_gp = s.alpha_M + t * s.alpha_rate;
    const Eigen::Matrix<double, 3, 4> phi = EvaluateSpline(blocks + kSplineOrder, weights);
    const CorrectedRotation x(
        omega_gp, alpha_gp, phi,
        jacobians.blocks != nullptr ? CorrectedRotation::kOfBoth : CorrectedRotation::kNone);
    const Eigen::Quaterniond q_WM = q_gp * x.E;
    const Eigen::Matrix<double, 3, 4> d = EvaluateSpline(blocks, weights);
    const double scale = *blocks[n + 8];
    const Vector3d a_W = (s.a_W + t * s.jerk_W + d.col(2)) / scale;
    const Vector3d f_body = q_WM.conjugate() * (a_W - g);  // R_WM^T (a_W - g_W)
    const Vector3d f_M = f_body + x.alpha.cross(p) + x.omega.cross(x.omega.cross(p)) +
                         0.5 * (*blocks[n + 6] + *blocks[n + 10]) * s.curvature +
                         0.5 * *blocks[n + 11] * s.cone + 0.5 * *blocks[n + 12] * s.averaged -
                         *blocks[n + 7] * s.f_swing;
    const Matrix3d R_IM = q_MI.conjugate().toRotationMatrix();
    const Matrix3d W = Hat(x.omega);
    const Matrix3d K = Hat(x.alpha) + W * W;  // acceleration by the lever arm
    const Matrix3d arms = R_MA_ * AccelPositions(Eigen::Map<const Vector6d>(blocks[n + 9]));
    const bool have_arms = !arms.isZero(0.0);
    Vector3d f_I = R_IM * f_M;
    if (have_arms) f_I += (R_IM * K).cwiseProduct(arms.transpose()).rowwise().sum();
    AsVector(residual) = (LessKnots(s.value, s.bias_u, blocks + n) - K_a * f_I) / s.sigma;
    if (jacobians.blocks == nullptr) return;

    const Matrix3d r_I = -K_a / s.sigma;  // d r / d f_I
    const Matrix3d A = r_I * R_IM;        // d r / d f_M
    const Matrix3d R_MW = q_WM.conjugate().toRotationMatrix();
    // d (omega x (omega x p)) / d omega
    const auto by_omega = [&](const Vector3d& arm) -> Matrix3d {
      return -Hat<double>(x.omega.cross(arm)) - W * Hat<double>(arm);
    };
    Matrix3d r_omega = A * by_omega(p);
    Matrix3d r_alpha = -A * Hat<double>(p);
    Eigen::Matrix<double, 3, 4> f_q = InverseRotationJacobian(q_MI, R_IM * f_M);
    if (have_arms) {
      for (int axis = 0; axis < 3; ++axis) {
        const Vector3d arm = arms.col(axis);
        r_omega += r_I.col(axis) * (R_IM.row(axis) * by_omega(arm));
        r_alpha -= r_I.col(axis) * (R_IM.row(axis) * Hat<double>(arm));
        f_q.row(axis) = InverseRotationJacobian(q_MI, R_IM * (f_M + K * arm)).row(axis);
      }
    }
    const Matrix3d r_phi = A * Hat(f_body) * x.J + r_omega * x.omega_phi + r_alpha * x.alpha_phi;
    const Matrix3d r_phi1 = r_omega * x.J + r_alpha * x.alpha_phi1;
    const Matrix3d r_phi2 = r_alpha * x.J;
    const Matrix3d r_a = A * R_MW;
    for (int j = 0; j < kSplineOrder; ++j) {
      SetRows<3>(jacobians, j, weights(2, j) / scale * r_a);
      SetRows<3>(jacobians, kSplineOrder + j,
                 weights(0, j) * r_phi + weights(1, j) * r_phi1 + weights(2, j) * r_phi2);
    }
    SetKnotRows(jacobians, n, -(1.0 - s.bias_u) / s.sigma, -s.bias_u / s.sigma);
    SetRows<4>(jacobians, n + 2, r_I * f_q);
    if (jacobians.blocks[n + 3] != nullptr) {
      Eigen::Matrix<double, 3, 9> r_M = Eigen::Matrix<double, 3, 9>::Zero();
      for (int row = 0; row < 3; ++row) r_M.block<1, 3>(row, 3 * row) = f_I.transpose();
      SetRows<9>(jacobians, n + 3, -r_M / s.sigma);
    }
    SetRows<3>(jacobians, n + 4, A * K);
    SetRows<3>(jacobians, n + 5, -r_a);
    for (const int smoothing : {6, 10}) SetRows<1>(jacobians, n + smoothing, 0.5 * A * s.curvature);
    SetRows<1>(jacobians, n + 11, 0.5 * A * s.cone);
    SetRows<1>(jacobians, n + 12, 0.5 * A * s.averaged);
    SetRows<1>(jacobians, n + 7, -A * s.f_swing);
    SetRows<1>(jacobians, n + 8, -1.0 / scale * r_a * a_W);
    const Matrix3d E_inv = Exp<double>(-phi.col(0)).toRotationMatrix();
    const Vector3d r_rate =
        A * (1.0 / scale * R_MW * (s.jerk_W + d.col(3)) - x.omega.cross(f_body)) +
        r_omega * x.omega_rate + r_alpha * (x.alpha_rate + E_inv * s.alpha_rate);
    SetClockRows(s, r_rate, jacobians);
    if (jacobians.blocks[n + 9] != nullptr) {
      // Row: axis; column: component of its place in I.
      const Matrix3d f_r = R_IM * K * R_MA_;
      Eigen::Matrix<double, 3, 6> f_places;
      for (int k = 0; k < 6; ++k)
        f_places.col(k) =
            f_r.cwiseProduct(AccelPositions(Vector6d::Unit(k)).transpose()).rowwise().sum();
      SetRows<6>(jacobians, n + 9, r_I * f_places);
    }
  }

 private:
  const Matrix3d R_MA_;
};

}  // namespace

Vector3d RateCone(const MarkerRotation<double>& m) { return m.alpha_M.cross(m.omega_M); }

Vector3d ForceCone(const MarkerState<double>& m, const MarkerState<double>& rate,
                   const Vector3d& g_W, const Vector3d& p_M) {
  const Vector3d &w = m.omega_M, &alpha = m.alpha_M, turned = w.cross(alpha);
  const Eigen::Quaterniond q_MW = m.q_WM.conjugate();
  const Vector3d f = q_MW * (m.a_W - g_W), jerk = q_MW * rate.a_W;
  return w.cross(w.cross(f) - 2.0 * jerk) - w.cross(rate.alpha_M).cross(p_M) +
         2.0 * alpha.cross(alpha.cross(p_M)) - turned.cross(w.cross(p_M)) -
         w.cross(turned.cross(p_M));
}

std::unique_ptr<SampledCost> CreateJointPositionResidual(Samples<JointPositionSample> samples,
                                                         const ClockMotions& clocks) {
  return std::make_unique<JointPositionResidual>(std::move(samples), clocks);
}

std::unique_ptr<SampledCost> CreateJointRotationResidual(Samples<JointRotationSample> samples) {
  return std::make_unique<JointRotationResidual>(std::move(samples));
}

std::unique_ptr<SampledCost> CreateJointGyroResidual(Samples<JointImuSample> samples,
                                                     const ClockMotions& clocks, bool has_walk) {
  return std::make_unique<JointGyroResidual>(std::move(samples), clocks, has_walk);
}

std::unique_ptr<SampledCost> CreateJointAccelResidual(Samples<JointAccelSample> samples,
                                                      const Eigen::Matrix3d& R_MA,
                                                      const ClockMotions& clocks, bool has_walk) {
  return std::make_unique<JointAccelResidual>(std::move(samples), R_MA, clocks, has_walk);
}

}  // namespace imu_pose_calib
