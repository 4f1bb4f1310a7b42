#include "imu_pose_calib/core/calibration/joint_residuals.h"

#include <Eigen/LU>
#include <initializer_list>
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
  Matrix3d J;                      // right Jacobian of phi; d omega / d phi', d alpha / d phi''
  Matrix3d omega_phi;              // d omega / d phi
  Matrix3d alpha_phi, alpha_phi1;  // d alpha / d phi, phi'
  // Change with time of the splines, and of the GP's motion, of alpha but for its own change.
  Vector3d u, omega_spline, alpha_spline, omega_gp, alpha_gp;

  /// Derivatives that are wanted: none, of omega, of both.
  enum Derivatives { kNone, kOfOmega, kOfBoth };

  /// phi: columns 0..3 are the value and its time derivatives.
  CorrectedRotation(const Vector3d& omega_gp_M, const Vector3d& alpha_gp_M,
                    const Eigen::Matrix<double, 3, 4>& phi, Derivatives wanted)
      : E(Exp<double>(phi.col(0))) {
    Vector3d u_dot;
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
    omega_spline = omega_phi * x + J * y;
    omega_gp = alpha_E;
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
    alpha_spline = alpha_phi * x + alpha_phi1 * y + J * phi.col(3);
    alpha_gp = -u.cross(alpha_E);
  }
};

/// How far beyond its span a sample may move while the clocks are estimated: the cubic goes on, and
/// the next solve finds the right span.
bool IsNearSpan(double u) { return u > -2.0 && u < 3.0; }

/// Three rows of the Jacobians of all blocks, where they are wanted.
struct JacobianRows {
  double** blocks;         ///< null: of none
  Eigen::Index first_row;  ///< of them
  int stride;              ///< see SampledCost
};

template <int Columns, typename Matrix>
void SetRows(const JacobianRows& rows, int block, const Matrix& J) {
  if (rows.blocks[block] == nullptr) return;
  const Eigen::Index stride = rows.stride > 0 ? rows.stride : Columns;
  double* const own = rows.blocks[block] + rows.first_row * stride;
  if constexpr (Columns == 1) {
    Eigen::Map<Vector3d, 0, Eigen::InnerStride<>>(own, Eigen::InnerStride<>(stride)) = J;
  } else {
    using Rows = Eigen::Matrix<double, 3, Columns, Eigen::RowMajor>;
    Eigen::Map<Rows, 0, Eigen::OuterStride<>>(own, Eigen::OuterStride<>(stride)) = J;
  }
}

double Factor(const ClockMotion& clock, double own_time, double reference_time) {
  switch (clock.factor) {
    case ClockMotion::kOwnTime:
      return own_time;
    case ClockMotion::kReferenceTime:
      return reference_time;
    case ClockMotion::kOne:
      break;
  }
  return 1.0;
}
double Factor(const ClockMotion& clock, const JointPoseSample& s) {
  return Factor(clock, 0.0, s.reference_time);
}
double Factor(const ClockMotion& clock, const JointImuSample& s) {
  return Factor(clock, s.own_time, s.reference_time);
}

double WalkShare(const JointPoseSample&) { return 0.0; }
double WalkShare(const JointImuSample& s) { return s.walk_u; }
double WalkValue(const JointPoseSample&) { return 0.0; }
double WalkValue(const JointImuSample& s) { return s.walk; }

/// How far a sample has moved [s].
struct Move {
  double on_gp = 0.0, on_spline = 0.0;
};

/// Residuals of samples, evaluated one by one. Blocks of the clocks come last.
template <typename Sample>
class BatchResidual : public SampledCost {
 public:
  BatchResidual(Samples<Sample> samples, std::initializer_list<int> other_blocks, int splines,
                const ClockMotions& clocks, bool has_walk = false)
      : has_walk_(has_walk),
        first_clock_(static_cast<size_t>(splines) * kSplineOrder + other_blocks.size()),
        samples_(std::move(samples)),
        clocks_(clocks) {
    set_num_residuals(3 * static_cast<int>(samples_.size()));
    std::vector<int>* sizes = mutable_parameter_block_sizes();
    sizes->assign(static_cast<size_t>(splines) * kSplineOrder, 3);
    sizes->insert(sizes->end(), other_blocks);
    sizes->insert(sizes->end(), clocks_->size() + (has_walk ? 2 : 0), 1);
  }

  bool EvaluatePart(size_t begin, size_t end, double const* const* blocks, double* residual,
                    double** jacobians, int stride) const override {
    JacobianRows rows{jacobians, 0, stride};
    for (size_t i = begin; i < end; ++i, residual += 3, rows.first_row += 3)
      if (!EvaluateSample(samples_[i], blocks, residual, rows)) return false;
    return true;
  }

 protected:
  /// Three residuals and rows of the Jacobians.
  virtual bool EvaluateSample(const Sample& sample, double const* const* blocks, double* residual,
                              const JacobianRows& jacobians) const = 0;

  Move FindMove(const Sample& sample, double const* const* blocks) const {
    Move dt;
    for (size_t k = 0; k < clocks_->size(); ++k) {
      const ClockMotion& clock = (*clocks_)[k];
      const double step = Factor(clock, sample) * (*blocks[first_clock_ + k] - clock.value);
      dt.on_gp += clock.on_gp * step;
      dt.on_spline += clock.on_spline * step;
    }
    if (has_walk_) {
      // Along both: the splines follow the line of a clock alone.
      const size_t knot = first_clock_ + clocks_->size();
      const double u = WalkShare(sample);
      const double step = (1.0 - u) * *blocks[knot] + u * *blocks[knot + 1] - WalkValue(sample);
      dt.on_gp += step;
      dt.on_spline += step;
    }
    return dt;
  }

  /// Columns of the clocks from the derivatives of the residual along GP and splines.
  void SetClockRows(const Sample& sample, const Vector3d& r_gp, const Vector3d& r_spline,
                    const JacobianRows& jacobians) const {
    for (size_t k = 0; k < clocks_->size(); ++k) {
      const ClockMotion& clock = (*clocks_)[k];
      SetRows<1>(
          jacobians, static_cast<int>(first_clock_ + k),
          Vector3d(Factor(clock, sample) * (clock.on_gp * r_gp + clock.on_spline * r_spline)));
    }
    if (!has_walk_) return;
    const int knot = static_cast<int>(first_clock_ + clocks_->size());
    const double u = WalkShare(sample);
    SetRows<1>(jacobians, knot, Vector3d((1.0 - u) * (r_gp + r_spline)));
    SetRows<1>(jacobians, knot + 1, Vector3d(u * (r_gp + r_spline)));
  }

 private:
  const bool has_walk_;
  const size_t first_clock_;
  const Samples<Sample> samples_;
  const ClockMotions clocks_;
};

class JointPositionResidual : public BatchResidual<JointPoseSample> {
 public:
  JointPositionResidual(Samples<JointPoseSample> samples, const ClockMotions& clocks)
      : BatchResidual(std::move(samples), {1, 1}, 1, clocks) {}

 protected:
  bool EvaluateSample(const JointPoseSample& s, double const* const* blocks, double* residual,
                      const JacobianRows& jacobians) const override {
    const double u = s.place.u + FindMove(s, blocks).on_spline / s.place.spacing;
    if (!IsNearSpan(u)) return false;
    const SplineWeights weights = CubicWeights(u, s.place.spacing);
    const Eigen::Matrix<double, 3, 4> d = EvaluateSpline(blocks, weights);
    const double c = 0.5 * (*blocks[kSplineOrder] + *blocks[kSplineOrder + 1]);
    const Vector3d a_W = s.a_W + d.col(2);
    AsVector(residual) = (s.p_error - d.col(0) - c * a_W) / s.position_sigma;
    if (jacobians.blocks == nullptr) return true;
    for (int j = 0; j < kSplineOrder; ++j)
      SetRows<3>(jacobians, j,
                 -(weights(0, j) + c * weights(2, j)) / s.position_sigma * Matrix3d::Identity());
    SetClockRows(s, Vector3d::Zero(), -(d.col(1) + c * d.col(3)) / s.position_sigma, jacobians);
    for (const int smoothing : {kSplineOrder, kSplineOrder + 1})
      SetRows<1>(jacobians, smoothing, -0.5 / s.position_sigma * a_W);
    return true;
  }
};

class JointRotationResidual : public BatchResidual<JointPoseSample> {
 public:
  JointRotationResidual(Samples<JointPoseSample> samples, const ClockMotions& clocks)
      : BatchResidual(std::move(samples), {1, 3, 3}, 1, clocks) {}

 protected:
  bool EvaluateSample(const JointPoseSample& s, double const* const* blocks, double* residual,
                      const JacobianRows& jacobians) const override {
    const double u = s.place.u + FindMove(s, blocks).on_spline / s.place.spacing;
    if (!IsNearSpan(u)) return false;
    const SplineWeights weights = CubicWeights(u, s.place.spacing);
    const Eigen::Matrix<double, 3, 4> phi = EvaluateSpline(blocks, weights);
    const Eigen::Quaterniond E_inv = Exp<double>(-phi.col(0));
    const double c = 0.5 * *blocks[kSplineOrder];
    const Vector3d alpha = s.alpha_M + phi.col(2);
    const Eigen::Quaterniond lag_inv = Exp<double>(-c * alpha);
    const Vector3d error = Log(Eigen::Quaterniond(lag_inv * E_inv * s.q_error));
    const Eigen::Map<const Vector3d> knot_0(blocks[kSplineOrder + 1]),
        knot_1(blocks[kSplineOrder + 2]);
    AsVector(residual) =
        (error - (1.0 - s.error_u) * knot_0 - s.error_u * knot_1) / s.rotation_sigma;
    if (jacobians.blocks == nullptr) return true;
    // Log(Exp(-delta) Exp(error)) = error - J_l(error)^-1 delta with J_l(x) = J_r(-x); delta is
    // J_r(c alpha) d(c alpha), and before that J_r(phi) dphi.
    const Matrix3d A = -RightJacobian<double>(-error).inverse() / s.rotation_sigma;
    const Matrix3d A_lag = A * RightJacobian<double>(c * alpha);
    const Matrix3d A_phi = A * lag_inv.toRotationMatrix();
    const Matrix3d J = RightJacobian<double>(phi.col(0));
    for (int j = 0; j < kSplineOrder; ++j)
      SetRows<3>(jacobians, j, weights(0, j) * A_phi * J + weights(2, j) * c * A_lag);
    SetRows<1>(jacobians, kSplineOrder, 0.5 * A_lag * alpha);
    const Matrix3d by_error = -Matrix3d::Identity() / s.rotation_sigma;
    SetRows<3>(jacobians, kSplineOrder + 1, (1.0 - s.error_u) * by_error);
    SetRows<3>(jacobians, kSplineOrder + 2, s.error_u * by_error);
    const Vector3d r_spline = A_phi * J * phi.col(1) + c * A_lag * phi.col(3);
    SetClockRows(s, Vector3d::Zero(), r_spline, jacobians);
    return true;
  }
};

class JointGyroResidual : public BatchResidual<JointImuSample> {
 public:
  JointGyroResidual(Samples<JointImuSample> samples, const ClockMotions& clocks, bool has_walk)
      : BatchResidual(std::move(samples), {4, 6, 3, 3}, 1, clocks, has_walk) {}

 protected:
  bool EvaluateSample(const JointImuSample& s, double const* const* blocks, double* residual,
                      const JacobianRows& jacobians) const override {
    const int n = kSplineOrder;
    const Eigen::Map<const Eigen::Quaterniond> q_MI(blocks[n]);
    const Matrix3d K_g = GyroMatrix(Eigen::Map<const Vector6d>(blocks[n + 1]));
    const Eigen::Map<const Vector3d> knot_0(blocks[n + 2]), knot_1(blocks[n + 3]);
    const Move dt = FindMove(s, blocks);
    const double u = s.place.u + dt.on_spline / s.place.spacing;
    if (!IsNearSpan(u)) return false;
    const SplineWeights weights = CubicWeights(u, s.place.spacing);
    const Vector3d omega_gp = s.omega_M + dt.on_gp * s.alpha_M;
    const CorrectedRotation x(
        omega_gp, s.alpha_M, EvaluateSpline(blocks, weights),
        jacobians.blocks != nullptr ? CorrectedRotation::kOfOmega : CorrectedRotation::kNone);
    const Vector3d omega_I = q_MI.conjugate() * x.omega;
    AsVector(residual) =
        (s.value - (1.0 - s.bias_u) * knot_0 - s.bias_u * knot_1 - K_g * omega_I) / s.sigma;
    if (jacobians.blocks == nullptr) return true;

    // d r / d omega_M
    const Matrix3d A = -K_g * q_MI.conjugate().toRotationMatrix() / s.sigma;
    const Matrix3d r_phi = A * x.omega_phi;
    const Matrix3d r_phi1 = A * x.J;
    for (int j = 0; j < n; ++j)
      SetRows<3>(jacobians, j, weights(0, j) * r_phi + weights(1, j) * r_phi1);
    SetRows<4>(jacobians, n, -K_g * InverseRotationJacobian(q_MI, omega_I) / s.sigma);
    if (jacobians.blocks[n + 1] != nullptr) {
      Eigen::Matrix<double, 3, 6> r_M = Eigen::Matrix<double, 3, 6>::Zero();
      r_M.block<1, 1>(0, 0) = omega_I.head<1>();
      r_M.block<1, 2>(1, 1) = omega_I.head<2>().transpose();
      r_M.block<1, 3>(2, 3) = omega_I.transpose();
      SetRows<6>(jacobians, n + 1, -r_M / s.sigma);
    }
    SetRows<3>(jacobians, n + 2, -(1.0 - s.bias_u) / s.sigma * Matrix3d::Identity());
    SetRows<3>(jacobians, n + 3, -s.bias_u / s.sigma * Matrix3d::Identity());
    SetClockRows(s, A * x.omega_gp, A * x.omega_spline, jacobians);
    return true;
  }
};

class JointAccelResidual : public BatchResidual<JointAccelSample> {
 public:
  JointAccelResidual(Samples<JointAccelSample> samples, const Matrix3d& R_MA,
                     const ClockMotions& clocks, bool has_walk)
      : BatchResidual(std::move(samples), {4, 3, 3, 9, 3, 3, 1, 1, 6}, 2, clocks, has_walk),
        R_MA_(R_MA) {}

 protected:
  bool EvaluateSample(const JointAccelSample& s, double const* const* blocks, double* residual,
                      const JacobianRows& jacobians) const override {
    const int n = 2 * kSplineOrder;
    const Eigen::Map<const Eigen::Quaterniond> q_MI(blocks[n]);
    const Eigen::Map<const Vector3d> p(blocks[n + 1]), g(blocks[n + 2]);
    const Matrix3d K_a = AccelMatrix(Eigen::Map<const Vector9d>(blocks[n + 3]));
    const Eigen::Map<const Vector3d> knot_0(blocks[n + 4]), knot_1(blocks[n + 5]);
    const Move dt = FindMove(s, blocks);
    const double u = s.place.u + dt.on_spline / s.place.spacing;
    if (!IsNearSpan(u)) return false;
    const SplineWeights weights = CubicWeights(u, s.place.spacing);
    const MarkerJerk& jerk = s.jerk;
    const double t = dt.on_gp;
    const Eigen::Quaterniond q_gp = s.q_WM * Exp<double>(t * (s.omega_M + 0.5 * t * s.alpha_M));
    const Vector3d omega_gp = s.omega_M + t * (s.alpha_M + 0.5 * t * jerk.alpha_rate);
    const Vector3d alpha_gp = s.alpha_M + t * jerk.alpha_rate;
    const Eigen::Matrix<double, 3, 4> phi = EvaluateSpline(blocks + kSplineOrder, weights);
    const CorrectedRotation x(
        omega_gp, alpha_gp, phi,
        jacobians.blocks != nullptr ? CorrectedRotation::kOfBoth : CorrectedRotation::kNone);
    const Eigen::Quaterniond q_WM = q_gp * x.E;
    const Eigen::Matrix<double, 3, 4> d = EvaluateSpline(blocks, weights);
    const double scale = *blocks[n + 7];
    const Vector3d a_W = (s.a_W + t * jerk.jerk_W + d.col(2)) / scale;
    const Vector3d f_body = q_WM.conjugate() * (a_W - g);  // R_WM^T (a_W - g_W)
    const Vector3d f_M = f_body + x.alpha.cross(p) + x.omega.cross(x.omega.cross(p)) +
                         0.5 * *blocks[n + 6] * jerk.f_curvature;
    const Matrix3d R_IM = q_MI.conjugate().toRotationMatrix();
    const Matrix3d W = Hat(x.omega);
    const Matrix3d K = Hat(x.alpha) + W * W;  // acceleration by the lever arm
    const Matrix3d arms = R_MA_ * AccelPositions(Eigen::Map<const Vector6d>(blocks[n + 8]));
    const bool have_arms = !arms.isZero(0.0);
    Vector3d f_I = R_IM * f_M;
    if (have_arms) f_I += (R_IM * K).cwiseProduct(arms.transpose()).rowwise().sum();
    AsVector(residual) =
        (s.value - (1.0 - s.bias_u) * knot_0 - s.bias_u * knot_1 - K_a * f_I) / s.sigma;
    if (jacobians.blocks == nullptr) return true;

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
    SetRows<4>(jacobians, n, r_I * f_q);
    SetRows<3>(jacobians, n + 1, A * K);
    SetRows<3>(jacobians, n + 2, -r_a);
    if (jacobians.blocks[n + 3] != nullptr) {
      Eigen::Matrix<double, 3, 9> r_M = Eigen::Matrix<double, 3, 9>::Zero();
      for (int row = 0; row < 3; ++row) r_M.block<1, 3>(row, 3 * row) = f_I.transpose();
      SetRows<9>(jacobians, n + 3, -r_M / s.sigma);
    }
    SetRows<3>(jacobians, n + 4, -(1.0 - s.bias_u) / s.sigma * Matrix3d::Identity());
    SetRows<3>(jacobians, n + 5, -s.bias_u / s.sigma * Matrix3d::Identity());
    SetRows<1>(jacobians, n + 6, 0.5 * A * jerk.f_curvature);
    SetRows<1>(jacobians, n + 7, -1.0 / scale * r_a * a_W);
    const Matrix3d E_inv = Exp<double>(-phi.col(0)).toRotationMatrix();
    const Vector3d r_gp = A * (1.0 / scale * R_MW * jerk.jerk_W - (x.omega - x.u).cross(f_body)) +
                          r_omega * x.omega_gp + r_alpha * (x.alpha_gp + E_inv * jerk.alpha_rate);
    const Vector3d r_spline = A * (1.0 / scale * R_MW * d.col(3) - x.u.cross(f_body)) +
                              r_omega * x.omega_spline + r_alpha * x.alpha_spline;
    SetClockRows(s, r_gp, r_spline, jacobians);
    if (jacobians.blocks[n + 8] != nullptr) {
      // Row: axis; column: component of its place in I.
      const Matrix3d f_r = R_IM * K * R_MA_;
      Eigen::Matrix<double, 3, 6> f_places;
      for (int k = 0; k < 6; ++k)
        f_places.col(k) =
            f_r.cwiseProduct(AccelPositions(Vector6d::Unit(k)).transpose()).rowwise().sum();
      SetRows<6>(jacobians, n + 8, r_I * f_places);
    }
    return true;
  }

 private:
  const Matrix3d R_MA_;
};

}  // namespace

std::unique_ptr<SampledCost> CreateJointPositionResidual(Samples<JointPoseSample> samples,
                                                         const ClockMotions& clocks) {
  return std::make_unique<JointPositionResidual>(std::move(samples), clocks);
}

std::unique_ptr<SampledCost> CreateJointRotationResidual(Samples<JointPoseSample> samples,
                                                         const ClockMotions& clocks) {
  return std::make_unique<JointRotationResidual>(std::move(samples), clocks);
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
