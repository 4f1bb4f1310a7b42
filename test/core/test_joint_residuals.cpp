#include <algorithm>
#include <cmath>
#include <vector>

#include "joint_residuals_fixture.h"

namespace imu_pose_calib {
namespace {

TEST_F(JointResiduals, PositionJacobian) {
  ExpectJacobiansMatch(CreateJointPositionResidual(Positions(), Motions(PositionClocks())),
                       PositionBlocks(PositionClocks()));
}

TEST_F(JointResiduals, RotationJacobian) {
  ExpectJacobiansMatch(CreateJointRotationResidual(Rotations()), RotationBlocks());
}

TEST_F(JointResiduals, GyroJacobian) {
  const auto cost = GyroCost(Gyro(With(Imu(), Jerks())), GyroClocks());
  MoveCalibration();
  for (const double shift : {0.0213, 0.021, 0.005}) {  // at, near and beyond the span of the sample
    time_shift_ = shift;
    ExpectJacobiansMatch(cost, GyroBlocks(GyroClocks()));
  }
}

TEST_F(JointResiduals, AccelJacobian) {
  const auto cost = AccelCost(With(Imu(), Jerks()), {});
  ExpectJacobiansMatch(cost, AccelBlocks({}));
  MoveCalibration();
  ExpectJacobiansMatch(cost, AccelBlocks({}));
}

TEST_F(JointResiduals, JacobianOfAnAccelWithClocks) {
  const auto cost = AccelCost(With(Imu(), Jerks()), AccelClocks());
  MoveCalibration();
  ExpectJacobiansMatch(cost, AccelBlocks(AccelClocks()));
}

TEST_F(JointResiduals, JacobianOfAnAccelThatHasMoved) {
  // Columns of the clocks leave out terms of second order in the move, all others are exact.
  const std::vector<double*> blocks = AccelBlocks(AccelClocks());
  const auto cost = AccelCost(With(Imu(), Jerks()), AccelClocks());
  const size_t first_clock = blocks.size() - AccelClocks().size();
  const auto errors = [&](double scale) {
    MoveClocks(scale);
    const Evaluated at = Evaluate(cost, blocks);
    std::vector<double> out;
    for (size_t k = 0; k < blocks.size(); ++k) {
      const Eigen::Index size = at.jacobians[k].cols();
      const bool is_quaternion = blocks[k] == q_MI_.coeffs().data();
      const Eigen::Quaterniond q_MI = q_MI_;
      const Eigen::VectorXd x = is_quaternion
                                    ? Eigen::VectorXd(Eigen::VectorXd::Zero(3))
                                    : Eigen::Map<const Eigen::VectorXd>(blocks[k], size).eval();
      const auto residuals = [&](const Eigen::VectorXd& moved) {
        if (is_quaternion)
          q_MI_ = Exp<double>(Vector3d(2.0 * moved)) * q_MI;  // as Ceres' manifold
        else
          Eigen::Map<Eigen::VectorXd>(blocks[k], size) = moved;
        return Evaluate(cost, blocks).residuals;
      };
      const Eigen::MatrixXd numeric = NumericJacobian(residuals, x, 1e-4);
      residuals(x);
      out.push_back((at.jacobians[k] - numeric).norm() / std::max(1.0, numeric.norm()));
    }
    return out;
  };
  const std::vector<double> still = errors(0.0), half = errors(2e-3), whole = errors(4e-3);
  for (size_t k = 0; k < blocks.size(); ++k) {
    SCOPED_TRACE("block " + std::to_string(k));
    EXPECT_LT(still[k], 1e-6);
    EXPECT_LT(half[k], k < first_clock ? 1e-6 : 1e-3);
    EXPECT_LT(whole[k], k < first_clock ? 1e-6 : 4e-3);
    if (k >= first_clock) {
      EXPECT_LT(half[k], 1.25 / 4.0 * whole[k] + 1e-9);  // of splines: exact
    }
  }
}

TEST_F(JointResiduals, MovedRatesAreThoseFurtherAlongTheTrajectory) {
  const auto create = [&](const auto& samples, const auto&) {
    return GyroCost(Gyro(samples), GyroClocks());
  };
  // Corrections stay; the slope of a motion of first order is constant.
  const auto jacobian_order = [](size_t k) {
    return kSplineOrder <= k && k < kSplineOrder + 4 ? 2 : 1;
  };
  ExpectImuOrder(GyroBlocks(GyroClocks()), &GyroMove, 2, jacobian_order, create);
}

TEST_F(JointResiduals, MovedForcesAreThoseFurtherAlongTheTrajectory) {
  const auto create = [&](const auto& samples, const auto& jerks) {
    return AccelCost(With(samples, jerks), AccelClocks());
  };
  ExpectImuOrder(
      AccelBlocks(AccelClocks()), &AccelMove, 2,
      [](size_t k) { return 2 * kSplineOrder <= k && k < 2 * kSplineOrder + 6 ? 2 : 1; }, create);
}

TEST_F(JointResiduals, VanishWhereTheCorrectedTrajectoryIsMeasured) {
  // Rates and forces by differences of R_gp Exp(phi) and p_gp + d + R p_MI, to first order in d and
  // phi.
  const double t = kSpan + 0.012;
  const TrajectoryPoint at = PointAt(t);
  const std::vector<Vector3d> whole_d = d_, whole_phi = phi_;
  pose_scale_ = 1.0;
  position_smoothing_ = -3e-4;
  struct Norms {
    double gyro, accel, position, rotation;
  };
  const auto norms = [&](double scale) -> Norms {
    for (size_t j = 0; j < phi_.size(); ++j) {
      d_[j] = scale * whole_d[j];
      phi_[j] = scale * whole_phi[j];
    }
    const Eigen::Matrix3d R_WM = RotationAt(t);
    const auto turn = [&](double to) {
      return Log(Eigen::Quaterniond(Eigen::Matrix3d(R_WM.transpose() * RotationAt(to))));
    };
    // Of the place p_M of the marker's frame.
    const auto force_W = [&](const Vector3d& p_M) -> Vector3d {
      const auto position = [&](double to) {
        return Vector3d(true_.At(to).p_WM + Correction(d_, to) + RotationAt(to) * p_M);
      };
      const auto velocity = [&](double to) { return NumericRate(position, to, 1e-3); };
      return NumericRate(velocity, t, 1e-3) - g_W_;
    };
    Vector3d f_I;
    for (int axis = 0; axis < 3; ++axis) {
      const Vector3d p_M = p_MI_ + q_MI_ * AccelPositions(accel_positions_).col(axis);
      f_I[axis] = (q_MI_.conjugate() * (R_WM.transpose() * force_W(p_M)))[axis];
    }
    const Vector3d bias = 0.7 * knot_0_ + 0.3 * knot_1_;
    const Vector3d omega_I = q_MI_.conjugate() * NumericRate(turn, t, 1e-3);
    const Vector3d w = GyroMatrix(gyro_intrinsics_) * omega_I + bias;
    const Vector3d f = AccelMatrix(accel_intrinsics_) * f_I + bias;

    const double c = 0.5 * (pose_smoothing_ + position_smoothing_ - trajectory_accel_smoothing_);
    const Vector3d lag = 0.5 * pose_smoothing_ * at.gp.alpha_M + kHigher * pose_cumulants_;
    const Vector3d p_WM = at.gp.p_WM + Correction(d_, t) + c * at.gp.a_W +
                          kHigher * (pose_cumulants_ + position_cumulants_) + 0.4 * error_0_ +
                          0.6 * error_1_;
    const Vector3d rotation = Correction(phi_, t) + lag + 0.65 * error_0_ + 0.35 * error_1_;
    const auto norm = [](const std::unique_ptr<SampledCost>& cost,
                         const std::vector<double*>& blocks) {
      return Evaluate(cost, blocks).residuals.norm();
    };
    const std::vector<JointAccelSample> rate{Imu(at, w, 0.3, 2.4, 1.0)};
    const std::vector<JointAccelSample> force =
        With(std::vector{Imu(at, f, 0.3, 2.4, 1.0)}, {JerkAt(t)});
    const double without_clocks = norm(AccelCost(force, {}), AccelBlocks({}));
    const double accel = norm(AccelCost(force, AccelClocks()), AccelBlocks(AccelClocks()));
    EXPECT_NEAR(accel, without_clocks, 1e-9 * accel);
    const std::vector<JointPoseSample> positions{Position(at, p_WM, 1.0)};
    const std::vector<JointPoseSample> rotations{Rotation(at, rotation, 1.0)};
    return {norm(GyroCost(Gyro(rate), GyroClocks()), GyroBlocks(GyroClocks())), accel,
            norm(CreateJointPositionResidual(positions, Motions({})), PositionBlocks({})),
            norm(CreateJointRotationResidual(rotations), RotationBlocks())};
  };
  const Norms small = norms(0.08), half = norms(0.04), none = norms(0.0);
  EXPECT_LT(none.gyro, 1e-6);
  EXPECT_LT(none.accel, 1e-4);
  EXPECT_GT(small.gyro, 1e-4);
  EXPECT_GT(small.accel, 1e-2);
  EXPECT_LT(half.gyro, 1.1 / 4.0 * small.gyro);
  EXPECT_LT(half.accel, 1.1 / 4.0 * small.accel);
  EXPECT_LT(small.position, 1e-12);
  EXPECT_LT(small.rotation, 1e-12);
}

/// A motion that turns and swings, by closed forms and, of rotations, differences of fifth order.
struct Swing {
  static constexpr double kStep = 5e-3;  // [s]
  double s = 0.0;                        ///< [s^2] variance of the times that it is the mean of

  template <typename Function>
  static Vector3d Slope(const Function& f, double t) {
    return (8.0 * (f(t + kStep) - f(t - kStep)) - f(t + 2.0 * kStep) + f(t - 2.0 * kStep)) /
           (12.0 * kStep);
  }
  template <typename Function>
  static Vector3d Rate(const Function& q, double t) {
    const Eigen::Quaterniond q_inv = q(t).conjugate();
    return Slope([&](double x) -> Vector3d { return Log(Eigen::Quaterniond(q_inv * q(x))); }, t);
  }
  static Eigen::Quaterniond Turned(double t) {
    return Exp<double>(Vector3d(0.8 * std::sin(3.0 * t), 0.5 * std::cos(4.0 * t + 1.0), 0.6 * t));
  }
  static Vector3d Omega(double t) { return Rate(&Turned, t); }
  static Vector3d Alpha(double t) { return Slope(&Omega, t); }
  Eigen::Quaterniond Rotation(double t) const {
    return s == 0.0 ? Turned(t) : Eigen::Quaterniond(Turned(t) * Exp<double>(0.5 * s * Alpha(t)));
  }
  Vector3d Acceleration(double t) const {
    const Vector3d a(3.0 * std::sin(5.0 * t), 2.0 * std::cos(4.0 * t), std::sin(6.0 * t));
    return a - 0.5 * s * Vector3d(25.0, 16.0, 36.0).cwiseProduct(a);
  }
  MarkerState<double> At(double t) const {
    const auto omega = [&](double x) { return Rate([&](double y) { return Rotation(y); }, x); };
    MarkerState<double> m;
    m.q_WM = Rotation(t);
    m.omega_M = omega(t);
    m.alpha_M = Slope(omega, t);
    m.a_W = Acceleration(t);
    return m;
  }
};

TEST(Cones, AreWhatTheMeansOfASensorExceedThoseOfAMeanMotionBy) {
  const double s = 1e-5, spread = std::sqrt(s);
  const Vector3d g_W(0.0, 0.0, -9.81), p_MI(0.05, -0.3, 0.2);
  const Swing motion, mean{s};
  const auto mean_of = [&](const auto& f, double t) -> Vector3d {
    return 0.5 * (f(t - spread) + f(t + spread));
  };
  const auto force = [&](double t) { return SpecificForce(motion.At(t), g_W, p_MI); };
  for (const double t : {0.3, 1.7, 2.9}) {
    const MarkerState<double> at = motion.At(t);
    MarkerState<double> rate;
    rate.alpha_M = Swing::Slope(&Swing::Alpha, t);
    rate.a_W = Swing::Slope([&](double x) { return motion.Acceleration(x); }, t);
    const Vector3d by_rate = 2.0 / s * (mean_of(&Swing::Omega, t) - mean.At(t).omega_M);
    EXPECT_LT((RateCone(at) - by_rate).norm(), 1e-3 * by_rate.norm());
    const Vector3d by_force = 2.0 / s * (mean_of(force, t) - SpecificForce(mean.At(t), g_W, p_MI));
    EXPECT_LT((ForceCone(at, rate, g_W, p_MI) - by_force).norm(), 1e-3 * by_force.norm());
  }
}

TEST(CubicWeights, SumToOneAndEachRowIsTheSlopeOfTheOneBefore) {
  const double spacing = 0.03, step = 1e-5;
  for (double u = 0.1; u < 1.0; u += 0.2) {
    const SplineWeights at = CubicWeights(u, spacing);
    EXPECT_NEAR(at.row(0).sum(), 1.0, 1e-14);
    const SplineWeights slope =
        (CubicWeights(u + step, spacing) - CubicWeights(u - step, spacing)) /
        (2.0 * step * spacing);
    for (int k = 0; k < 2; ++k)
      EXPECT_LT((slope.row(k) - at.row(k + 1)).norm(), 1e-6 * at.row(k + 1).norm()) << k;
  }
}

TEST(CubicWeights, AreTwiceContinuousAcrossKnots) {
  const SplineWeights left = CubicWeights(1.0, 0.03), right = CubicWeights(0.0, 0.03);
  for (int k = 0; k < 3; ++k) {
    EXPECT_NEAR(left(k, 0), 0.0, 1e-9);
    for (int j = 0; j + 1 < kSplineOrder; ++j) EXPECT_NEAR(left(k, j + 1), right(k, j), 1e-9);
    EXPECT_NEAR(right(k, kSplineOrder - 1), 0.0, 1e-9);
  }
}

}  // namespace
}  // namespace imu_pose_calib
