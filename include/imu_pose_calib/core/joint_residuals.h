#pragma once

#include <ceres/cost_function.h>

#include "imu_pose_calib/core/pose_trajectory.h"
#include "imu_pose_calib/core/spline.h"

namespace imu_pose_calib {

/// Residuals of the joint solve, doc/math.md Eqs. (9)-(14), with analytic Jacobians. All residuals
/// are 3-vectors in sigma. `phi` and `d` stand for kSplineOrder control points each, blocks of 3.

/// A pose's position against p_gp(t) + d(t): r = (p_meas - p_gp - d) / sigma, in W. Blocks: d.
ceres::CostFunction* CreatePositionResidual(const Eigen::Vector3d& p_meas_minus_gp_W,
                                            const SplineWeights& weights,
                                            double sigma);

/// A pose's rotation against R_gp(t) Exp(phi(t)): r = Log(Exp(phi)^T R_gp^T R_meas) / sigma, in M.
/// Blocks: phi.
ceres::CostFunction* CreateRotationResidual(const Eigen::Quaterniond& q_gp_meas,
                                            const SplineWeights& weights,
                                            double sigma);

/// An IMU sample in a span of the correction splines. The GP's motion at t + time_shift is taken to
/// first order around `t_M`, where the time shift stood when the problem was made: exact at the
/// solution, because the last pass starts there.
struct JointImuSample {
  MarkerState<double> gp;       ///< at t_M
  MarkerState<double> gp_rate;  ///< its time derivative (q_WM: of its coefficients)
  double t_M;                   ///< [s] pose clock
  double t;                     ///< [s] IMU clock
  Eigen::Vector3d value;        ///< gyroscope [rad/s] or accelerometer [m/s^2] in I
  double bias_u;                ///< 0..1 between the bias knots
  double sigma;                 ///< unit of value
  SplinePlace place;            ///< of t_M
};

/// r = (w - b_g - R_MI^T omega_M(t + time_shift)) / sigma, in I.
/// Blocks: phi | q_MI (4, xyzw) | bias knot_0 (3) | knot_1 (3) | time_shift (1).
ceres::CostFunction* CreateJointGyroResidual(const JointImuSample& sample);

/// r = (f - b_a - R_MI^T f_M(t + time_shift - accel_delay)) / sigma, in I, with
/// f_M = R_WM^T (a_W - g_W) + alpha_M x p_MI + omega_M x (omega_M x p_MI).
/// Blocks: d | phi | q_MI (4) | p_MI (3) | g_W (3) | knot_0 (3) | knot_1 (3) | time_shift (1) |
/// accel_delay (1).
ceres::CostFunction* CreateJointAccelResidual(const JointImuSample& sample);

}  // namespace imu_pose_calib
