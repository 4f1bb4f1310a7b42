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
///
/// The trajectory is a function of the accelerometer's clock, tau [s]: the sensor that sees the
/// highest derivatives stays put, and poses and gyroscope move along the trajectory when the clocks
/// are estimated (doc/math.md, S4, "Clock of the trajectory").

/// Where a sample lies on the trajectory while the clocks are where they stood when the problem was
/// made. It moves along the GP to first order (poses: second), and by little: the last pass starts
/// close to the solution.
struct TrajectoryPoint {
  MarkerState<double> gp;  ///< the GP's motion
  SplinePlace place;
};

/// A pose of the marker.
struct JointPoseSample {
  TrajectoryPoint at;
  Eigen::Quaterniond q_WM;
  Eigen::Vector3d p_WM;                         ///< [m]
  double time_shift, clock_drift, accel_delay;  ///< for which it is `at` its place
  double t_drift;  ///< [s] its time, IMU clock, after the instant at which time_shift holds
  double sigma;    ///< [m] of the position or [rad] of the rotation
};

/// r = (p_meas - p_gp(tau) - d(tau) - s/2 (a_gp + d''(tau))) / sigma, in W, s: pose_smoothing.
/// Blocks: d | time_shift (1) | clock_drift (1) | accel_delay (1) | pose_smoothing (1).
ceres::CostFunction* CreateJointPositionResidual(const std::vector<JointPoseSample>& samples);

/// r = Log(Exp(s/2 (alpha_gp + phi''(tau)))^T Exp(phi(tau))^T R_gp(tau)^T R_meas) / sigma, in M.
/// Blocks: phi | time_shift (1) | clock_drift (1) | accel_delay (1) | pose_smoothing (1).
ceres::CostFunction* CreateJointRotationResidual(const std::vector<JointPoseSample>& samples);

/// A sample of the gyroscope or the accelerometer.
struct JointImuSample {
  TrajectoryPoint at;
  Eigen::Vector3d value;  ///< gyroscope [rad/s] or accelerometer [m/s^2] in I
  double bias_u;          ///< 0..1 between the bias knots
  double accel_delay;     ///< [s] for which it is `at` its place; gyroscope only
  double sigma;           ///< unit of value
};

/// r = (w - b_g - M_g R_MI^T omega_M(tau)) / sigma, in I.
/// Blocks: phi | q_MI (4, xyzw) | M_g (6, see GyroMatrix()) | bias knot_0 (3) | knot_1 (3) |
/// accel_delay (1).
ceres::CostFunction* CreateJointGyroResidual(const std::vector<JointImuSample>& samples);

/// r = (f - b_a - M_a R_MI^T f_M(tau)) / sigma, in I, with
/// f_M = R_WM^T (a_W - g_W) + alpha_M x p_MI + omega_M x (omega_M x p_MI).
/// Blocks: d | phi | q_MI (4) | p_MI (3) | g_W (3) | M_a (9, see AccelMatrix()) | knot_0 (3) |
/// knot_1 (3).
ceres::CostFunction* CreateJointAccelResidual(const std::vector<JointImuSample>& samples);

}  // namespace imu_pose_calib
