#include "imu_pose_calib/core/calibration/joint_residuals.h"

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
/// the tangent Jacobian 2 R^T Hat(v) times the pseudo-inverse of the manifold's Plus Jacobian. Row
/// i may be that of a v of its own: `turned_hat` has the rows of Hat(q^* v).
Eigen::Matrix<double, 3, 4> InverseRotationJacobian(const Eigen::Quaterniond& q,
                                                    const Matrix3d& turned_hat) {
  Eigen::Matrix<double, 3, 4> G;      // rows: steps; columns: xyzw
  G << q.w(), -q.z(), q.y(), -q.x(),  //
      q.z(), q.w(), -q.x(), -q.y(),   //
      -q.y(), q.x(), q.w(), -q.z();
  // R^T Hat(v) = Hat(R^T v) R^T
  return 2.0 * turned_hat * q.conjugate().toRotationMatrix() * G;
}

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
  BatchResidual(Samples<Sample> samples, int splines, const std::vector<int>& others,
                const ClockMotions& clocks, bool has_walk = false)
      : has_walk_(has_walk),
        first_clock_(splines * kSplineOrder + static_cast<int>(others.size())),
        walk_knot_(first_clock_ + static_cast<int>(clocks->size())),
        samples_(std::move(samples)),
        clocks_(clocks) {
    set_num_residuals(3 * static_cast<int>(samples_.size()));
    std::vector<int>* sizes = mutable_parameter_block_sizes();
    sizes->assign(static_cast<size_t>(splines) * kSplineOrder, 3);
    sizes->insert(sizes->end(), others.begin(), others.end());
    sizes->insert(sizes->end(), clocks_->size() + (has_walk ? 2 : 0), 1);
  }

  void EvaluatePart(size_t begin, size_t end, double const* const* blocks, double* residual,
                    double** jacobians) const override {
    JacobianRows rows{jacobians, 0};
    for (size_t i = begin; i < end; ++i, residual += 3, rows.first_row += 3) {
      const Sample sample = samples_[i];
      EvaluateSample(sample, FindMove(sample, blocks),
                     CubicWeights(sample.place.u, sample.place.spacing), blocks, residual, rows);
    }
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

/// Of positions or rotations.
class JointPoseResidual : public BatchResidual<JointPoseSample> {
 public:
  /// `signs`: of the smoothings; `cumulants`: how many are added.
  JointPoseResidual(Samples<JointPoseSample> samples, const std::vector<double>& signs,
                    size_t cumulants, const ClockMotions& clocks)
      : BatchResidual(std::move(samples), 1, Others(signs.size(), cumulants), clocks),
        signs_(signs),
        cumulants_(cumulants) {}

 protected:
  void EvaluateSample(const JointPoseSample& s, double t, const SplineWeights& weights,
                      double const* const* blocks, double* residual,
                      const JacobianRows& jacobians) const override {
    const int n = kSplineOrder;
    const Matrix3d x = EvaluateSpline(blocks, weights);
    int block = n + 2;
    double c = 0.0;
    for (const double sign : signs_) c += 0.5 * sign * *blocks[block++];
    Vector3d error = s.error - t * s.rate - x.col(0) - c * s.curvature;
    for (size_t k = 0; k < cumulants_; ++k)
      error -= s.higher * Eigen::Map<const Eigen::Vector2d>(blocks[block++]);
    AsVector(residual) = LessKnots(error, s.error_u, blocks + n) / s.sigma;
    if (jacobians.blocks == nullptr) return;
    for (int j = 0; j < n; ++j)
      SetRows<3>(jacobians, j, -weights(0, j) / s.sigma * Matrix3d::Identity());
    SetKnotRows(jacobians, n, -(1.0 - s.error_u) / s.sigma, -s.error_u / s.sigma);
    block = n + 2;
    for (const double sign : signs_)
      SetRows<1>(jacobians, block++, Vector3d(-0.5 * sign / s.sigma * s.curvature));
    for (size_t k = 0; k < cumulants_; ++k) SetRows<2>(jacobians, block++, -s.higher / s.sigma);
    SetClockRows(s, -s.rate / s.sigma, jacobians);
  }

 private:
  /// Two knots, smoothings and cumulants.
  static std::vector<int> Others(size_t smoothings, size_t cumulants) {
    std::vector<int> sizes{3, 3};
    sizes.insert(sizes.end(), smoothings, 1);
    sizes.insert(sizes.end(), cumulants, 2);
    return sizes;
  }

  const std::vector<double> signs_;
  const size_t cumulants_;
};

/// What the gyroscope is calibrated by, in the order of its blocks.
struct GyroCalibration {
  Eigen::Quaterniond q_MI;
  Matrix3d K;

  explicit GyroCalibration(double const* const* blocks)
      : q_MI(Eigen::Map<const Eigen::Quaterniond>(blocks[0])),
        K(GyroMatrix(Eigen::Map<const Vector6d>(blocks[1]))) {}
  /// d K_g R_MI^T omega / d omega
  Matrix3d ByRate() const { return K * q_MI.conjugate().toRotationMatrix(); }
};

class JointGyroResidual : public BatchResidual<JointImuSample> {
 public:
  JointGyroResidual(Samples<JointImuSample> samples, double const* const* calibration,
                    const ClockMotions& clocks, bool has_walk)
      : BatchResidual(std::move(samples), 1, {3, 3, 4, 6, 1, 1}, clocks, has_walk),
        by_correction_(GyroCalibration(calibration).ByRate()) {}

 protected:
  void EvaluateSample(const JointImuSample& s, double t, const SplineWeights& weights,
                      double const* const* blocks, double* residual,
                      const JacobianRows& jacobians) const override {
    const int n = kSplineOrder;
    const GyroCalibration imu(blocks + n + 2);
    const Vector3d omega_M = s.omega_M + t * s.alpha_M + 0.5 * *blocks[n + 4] * s.curvature +
                             0.5 * *blocks[n + 5] * s.cone;
    const Vector3d omega_I = imu.q_MI.conjugate() * omega_M;
    const Matrix3d phi = EvaluateSpline(blocks, weights);
    const Vector3d corrected = by_correction_ * (s.omega_M.cross(phi.col(0)) + phi.col(1));
    AsVector(residual) =
        (LessKnots(s.value, s.bias_u, blocks + n) - imu.K * omega_I - corrected) / s.sigma;
    if (jacobians.blocks == nullptr) return;

    const Matrix3d r_phi1 = -by_correction_ / s.sigma;
    const Matrix3d r_phi = r_phi1 * Hat(s.omega_M);
    for (int j = 0; j < n; ++j)
      SetRows<3>(jacobians, j, weights(0, j) * r_phi + weights(1, j) * r_phi1);
    SetKnotRows(jacobians, n, -(1.0 - s.bias_u) / s.sigma, -s.bias_u / s.sigma);
    SetRows<4>(jacobians, n + 2,
               -imu.K * InverseRotationJacobian(imu.q_MI, Hat(omega_I)) / s.sigma);
    if (jacobians.blocks[n + 3] != nullptr) {
      Eigen::Matrix<double, 3, 6> r_M = Eigen::Matrix<double, 3, 6>::Zero();
      r_M.block<1, 1>(0, 0) = omega_I.head<1>();
      r_M.block<1, 2>(1, 1) = omega_I.head<2>().transpose();
      r_M.block<1, 3>(2, 3) = omega_I.transpose();
      SetRows<6>(jacobians, n + 3, -r_M / s.sigma);
    }
    const Matrix3d A = -imu.ByRate() / s.sigma;
    SetRows<1>(jacobians, n + 4, 0.5 * A * s.curvature);
    SetRows<1>(jacobians, n + 5, 0.5 * A * s.cone);
    SetClockRows(s, A * s.alpha_M, jacobians);
  }

 private:
  const Matrix3d by_correction_;
};

/// What the accelerometer is calibrated by, in the order of its blocks.
struct AccelCalibration {
  Eigen::Quaterniond q_MI;
  Matrix3d R_IM, K;
  Vector3d p, g;
  double scale;
  Matrix3d places;  // of its axes: p and what is about it, in M

  AccelCalibration(double const* const* blocks, const Matrix3d& R_MA)
      : q_MI(Eigen::Map<const Eigen::Quaterniond>(blocks[0])),
        R_IM(q_MI.conjugate().toRotationMatrix()),
        K(AccelMatrix(Eigen::Map<const Vector9d>(blocks[1]))),
        p(Eigen::Map<const Vector3d>(blocks[2])),
        g(Eigen::Map<const Vector3d>(blocks[3])),
        scale(*blocks[6]),
        places((R_MA * AccelPositions(Eigen::Map<const Vector6d>(blocks[7]))).colwise() + p) {}

  /// d f / d omega and d f / d alpha, of f = K f_I.
  void ByRotation(const Vector3d& omega, Matrix3d* by_omega, Matrix3d* by_alpha) const {
    for (int axis = 0; axis < 3; ++axis) {
      const Vector3d e = R_IM.row(axis), at = places.col(axis);
      by_omega->row(axis) = -e.cross(omega.cross(at)) - e.cross(omega).cross(at);
      by_alpha->row(axis) = -e.cross(at);
    }
    *by_omega = K * *by_omega;
    *by_alpha = K * *by_alpha;
  }
};

class JointAccelResidual : public BatchResidual<JointAccelSample> {
 public:
  JointAccelResidual(Samples<JointAccelSample> samples, double const* const* calibration,
                     const ClockMotions& clocks, bool has_walk)
      : BatchResidual(std::move(samples), 2, {3, 3, 4, 9, 3, 3, 1, 1, 1, 6, 1, 1, 1}, clocks,
                      has_walk),
        R_MA_(Eigen::Map<const Eigen::Quaterniond>(calibration[0]).toRotationMatrix()),
        made_with_(calibration, R_MA_) {}

 protected:
  void EvaluateSample(const JointAccelSample& s, double t, const SplineWeights& weights,
                      double const* const* blocks, double* residual,
                      const JacobianRows& jacobians) const override {
    const int n = 2 * kSplineOrder;
    const AccelCalibration imu(blocks + n + 2, R_MA_);
    const Eigen::Quaterniond q_MW =
        (s.q_WM * Exp<double>(t * (s.omega_M + 0.5 * t * s.alpha_M))).conjugate();
    const Vector3d omega = s.omega_M + t * (s.alpha_M + 0.5 * t * s.alpha_rate);
    const Vector3d alpha = s.alpha_M + t * s.alpha_rate;
    const Vector3d a_W = (s.a_W + t * s.jerk_W) / imu.scale;
    const Vector3d f_body = q_MW * (a_W - imu.g);  // R_WM^T (a_W - g_W)
    const Vector3d f_M = f_body + 0.5 * (*blocks[n + 6] + *blocks[n + 10]) * s.curvature +
                         0.5 * *blocks[n + 11] * s.cone + 0.5 * *blocks[n + 12] * s.averaged -
                         *blocks[n + 7] * s.f_swing;
    const Matrix3d W = Hat(omega), lever = Hat(alpha) + W * W;
    const Matrix3d f_axes =
        imu.R_IM * ((lever * imu.places).colwise() + f_M);  // in I, at each axis
    const Vector3d f_I = f_axes.diagonal();
    const Corrections corrections(made_with_, s);
    AsVector(residual) = (LessKnots(s.value, s.bias_u, blocks + n) - imu.K * f_I -
                          corrections.Force(EvaluateSpline(blocks, weights).col(2),
                                            EvaluateSpline(blocks + kSplineOrder, weights))) /
                         s.sigma;
    if (jacobians.blocks == nullptr) return;

    for (int j = 0; j < kSplineOrder; ++j) {
      SetRows<3>(jacobians, j, -weights(2, j) / s.sigma * corrections.by_d2);
      SetRows<3>(jacobians, kSplineOrder + j,
                 -1.0 / s.sigma *
                     (weights(0, j) * corrections.by_phi + weights(1, j) * corrections.by_phi1 +
                      weights(2, j) * corrections.by_phi2));
    }
    SetKnotRows(jacobians, n, -(1.0 - s.bias_u) / s.sigma, -s.bias_u / s.sigma);
    const Matrix3d r_I = -imu.K / s.sigma;  // d r / d f_I
    const Matrix3d A = r_I * imu.R_IM;      // d r / d f_M
    const Matrix3d R_MW = q_MW.toRotationMatrix();
    Matrix3d turned_hat;
    for (int axis = 0; axis < 3; ++axis)
      turned_hat.row(axis) = Hat<double>(f_axes.col(axis)).row(axis);
    SetRows<4>(jacobians, n + 2, r_I * InverseRotationJacobian(imu.q_MI, turned_hat));
    if (jacobians.blocks[n + 3] != nullptr) {
      Eigen::Matrix<double, 3, 9> r_M = Eigen::Matrix<double, 3, 9>::Zero();
      for (int row = 0; row < 3; ++row) r_M.block<1, 3>(row, 3 * row) = f_I.transpose();
      SetRows<9>(jacobians, n + 3, -r_M / s.sigma);
    }
    SetRows<3>(jacobians, n + 4, A * lever);
    SetRows<3>(jacobians, n + 5, -A * R_MW);
    for (const int smoothing : {6, 10}) SetRows<1>(jacobians, n + smoothing, 0.5 * A * s.curvature);
    SetRows<1>(jacobians, n + 11, 0.5 * A * s.cone);
    SetRows<1>(jacobians, n + 12, 0.5 * A * s.averaged);
    SetRows<1>(jacobians, n + 7, -A * s.f_swing);
    SetRows<1>(jacobians, n + 8, -1.0 / imu.scale * A * R_MW * a_W);
    if (jacobians.blocks[n + 9] != nullptr) {
      // Row: axis; column: component of its place in I.
      const Matrix3d f_r = imu.R_IM * lever * R_MA_;
      Eigen::Matrix<double, 3, 6> f_places;
      for (int k = 0; k < 6; ++k)
        f_places.col(k) =
            f_r.cwiseProduct(AccelPositions(Vector6d::Unit(k)).transpose()).rowwise().sum();
      SetRows<6>(jacobians, n + 9, r_I * f_places);
    }
    Matrix3d by_omega, by_alpha;
    imu.ByRotation(omega, &by_omega, &by_alpha);
    SetClockRows(s,
                 A * (R_MW * s.jerk_W / imu.scale - omega.cross(f_body)) -
                     (by_omega * alpha + by_alpha * s.alpha_rate) / s.sigma,
                 jacobians);
  }

 private:
  /// d f / d d'' and d f / d phi, phi', phi'' where the sample is.
  struct Corrections {
    Matrix3d by_d2, by_phi, by_phi1, by_phi2;

    Corrections(const AccelCalibration& imu, const JointAccelSample& s) {
      const Eigen::Quaterniond q_MW = s.q_WM.conjugate();
      const Matrix3d by_force = imu.K * imu.R_IM, W = Hat(s.omega_M);
      Matrix3d by_omega;
      imu.ByRotation(s.omega_M, &by_omega, &by_phi2);
      by_d2 = by_force * q_MW.toRotationMatrix() / imu.scale;
      by_phi1 = by_omega + by_phi2 * W;
      by_phi = by_force * Hat<double>(q_MW * (s.a_W / imu.scale - imu.g)) + by_omega * W +
               by_phi2 * Hat(s.alpha_M);
    }
    Vector3d Force(const Vector3d& d2, const Matrix3d& phi) const {
      return by_d2 * d2 + by_phi * phi.col(0) + by_phi1 * phi.col(1) + by_phi2 * phi.col(2);
    }
  };

  const Matrix3d R_MA_;
  const AccelCalibration made_with_;
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

std::unique_ptr<SampledCost> CreateJointPositionResidual(Samples<JointPoseSample> samples,
                                                         const ClockMotions& clocks) {
  return std::make_unique<JointPoseResidual>(std::move(samples), std::vector{1.0, 1.0, -1.0}, 2,
                                             clocks);
}

std::unique_ptr<SampledCost> CreateJointRotationResidual(Samples<JointPoseSample> samples) {
  return std::make_unique<JointPoseResidual>(std::move(samples), std::vector{1.0}, 1,
                                             std::make_shared<const std::vector<ClockMotion>>());
}

std::unique_ptr<SampledCost> CreateJointGyroResidual(Samples<JointImuSample> samples,
                                                     double const* const* calibration,
                                                     const ClockMotions& clocks, bool has_walk) {
  return std::make_unique<JointGyroResidual>(std::move(samples), calibration, clocks, has_walk);
}

std::unique_ptr<SampledCost> CreateJointAccelResidual(Samples<JointAccelSample> samples,
                                                      double const* const* calibration,
                                                      const ClockMotions& clocks, bool has_walk) {
  return std::make_unique<JointAccelResidual>(std::move(samples), calibration, clocks, has_walk);
}

}  // namespace imu_pose_calib
