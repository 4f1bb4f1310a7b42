#pragma once

#include <ceres/cost_function.h>

#include <vector>

#include "imu_pose_calib/core/pose_trajectory.h"
#include "imu_pose_calib/core/spline.h"

namespace imu_pose_calib {

/// Residuals of the joint solve, doc/math.md Eqs. (9)-(14), with analytic Jacobians. A residual
/// block holds consecutive samples that share all parameters, three rows in sigma for each: that
/// keeps the normal equations to a few dense products. `phi` and `d` stand for kSplineOrder control
/// points each, blocks of 3.

/// A pose's position against p_gp(t) + d(t): r = (p_meas - p_gp - d) / sigma, in W.
struct JointPositionSample {
  Eigen::Vector3d p_gp_meas;                       ///< p_meas - p_gp [m] in W
  Eigen::Matrix<double, 1, kSplineOrder> weights;  ///< of the control points
  double sigma;                                    ///< [m]
};
/// Blocks: d.
ceres::CostFunction* CreatePositionResidual(std::vector<JointPositionSample> samples);

/// A pose's rotation against R_gp(t) Exp(phi(t)): r = Log(Exp(phi)^T R_gp^T R_meas) / sigma, in M.
struct JointRotationSample {
  Eigen::Quaterniond q_gp_meas;                    ///< R_gp^T R_meas
  Eigen::Matrix<double, 1, kSplineOrder> weights;  ///< of the control points
  double sigma;                                    ///< [rad]
};
/// Blocks: phi.
ceres::CostFunction* CreateRotationResidual(std::vector<JointRotationSample> samples);

/// An IMU sample in a span of the correction splines. The GP's motion at the sample's time on the
/// pose clock is taken to first order around `t_M`, where the clocks stood when the problem was
/// made: exact at the solution, because the last pass starts there.
struct JointImuSample {
  MarkerState<double> gp;       ///< at t_M
  MarkerState<double> gp_rate;  ///< its time derivative (q_WM: of its coefficients)
  double t_M;                   ///< [s] pose clock
  double t;                     ///< [s] IMU clock
  double t_drift;               ///< [s] t after the instant at which time_shift holds
  Eigen::Vector3d value;        ///< gyroscope [rad/s] or accelerometer [m/s^2] in I
  double bias_u;                ///< 0..1 between the bias knots
  double sigma;                 ///< unit of value
  SplinePlace place;            ///< of t_M
};

/// r = (w - b_g - M_g R_MI^T omega_M(t_M)) / sigma, in I, with
/// t_M = t + time_shift + clock_drift t_drift.
/// Blocks: phi | q_MI (4, xyzw) | M_g (6, see GyroMatrix()) | bias knot_0 (3) | knot_1 (3) |
/// time_shift (1) | clock_drift (1).
ceres::CostFunction* CreateJointGyroResidual(std::vector<JointImuSample> samples);

/// r = (f - b_a - M_a R_MI^T f_M(t_M - accel_delay)) / sigma, in I, with
/// f_M = R_WM^T (a_W - g_W) + alpha_M x p_MI + omega_M x (omega_M x p_MI).
/// Blocks: d | phi | q_MI (4) | p_MI (3) | g_W (3) | M_a (9, see AccelMatrix()) | knot_0 (3) |
/// knot_1 (3) | time_shift (1) | clock_drift (1) | accel_delay (1).
ceres::CostFunction* CreateJointAccelResidual(std::vector<JointImuSample> samples);

}  // namespace imu_pose_calib
