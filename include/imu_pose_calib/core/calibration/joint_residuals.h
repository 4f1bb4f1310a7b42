#pragma once

#include <functional>
#include <memory>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/spline.h"
#include "imu_pose_calib/core/solver/problem.h"
#include "imu_pose_calib/core/trajectory/pose_trajectory.h"

namespace imu_pose_calib {

/// Residuals of the joint solve, doc/math.md Eqs. (9)-(14), with analytic Jacobians: one cost
/// function for all samples of a sensor, three rows in sigma for each. A residual block takes
/// consecutive ones that share all parameters: that keeps the normal equations to a few dense
/// products. Blocks are in this order: `d` and `phi`, kSplineOrder control points (3) each; two
/// knots (3) of what changes slowly; the others; clocks (1), of positions their delay, and, of an
/// IMU whose clock has a walk, two of its knots (1), by which its samples move along the trajectory
/// while they are estimated.

/// How the samples of a block move with one clock parameter, a block of 1:
/// dt = sign factor (parameter - value) [s].
struct ClockMotion {
  enum Factor { kOne, kOwnTime };
  double value;   ///< for which the samples are at their places
  double sign;    ///< -1 or 1
  Factor factor;  ///< 1, or a time of the sample as below
};
using ClockMotions = std::shared_ptr<const std::vector<ClockMotion>>;

/// The samples of a sensor, either kept, for all residuals that share them, or made again whenever
/// they are looked at.
template <typename Sample>
class Samples {
 public:
  Samples(std::vector<Sample> kept)  // NOLINT: they are the samples
      : count_(kept.size()), kept_(std::make_shared<const std::vector<Sample>>(std::move(kept))) {}
  Samples(size_t count, std::function<Sample(size_t)> make)
      : count_(count), make_(std::move(make)) {}
  size_t size() const { return count_; }
  Sample operator[](size_t i) const { return kept_ ? (*kept_)[i] : make_(i); }

 private:
  size_t count_;
  std::shared_ptr<const std::vector<Sample>> kept_;
  std::function<Sample(size_t)> make_;
};

/// Where a sample is while the clocks are where they stood when the problem was made. It moves
/// along the GP to first or second order, and by little: the last pass starts close to the
/// solution. Corrections act to first order, where it was made and by what the IMU was calibrated
/// by then, so that derivatives by what is calibrated are those of the GP: doc/math.md,
/// "Corrections and derivatives".
struct JointSample {
  SplinePlace place;
  double own_time = 0.0;            ///< [s] IMU clock, after the instant at which its shift holds
  double walk_u = 0.0, walk = 0.0;  ///< 0..1 between the knots of that; [s] where it stands
};

/// A measured position less that of the GP in W, or a rotation, R_gp^T R_meas = Exp(error).
struct JointPoseSample : JointSample {
  double error_u;             ///< 0..1 between the knots of the slow errors
  double sigma;               ///< [m] or [rad]
  Eigen::Vector3d error;      ///< [m] in W or [rad] in M
  Eigen::Vector3d rate;       ///< [m/s] of the GP; of rotations, which have no clock, nothing
  Eigen::Vector3d curvature;  ///< second derivative of the GP, [m/s^2] in W or [rad/s^2] in M
  /// Minus a sixth of the third derivative of the GP and a 24th of the fourth, [m] or [rad].
  Eigen::Matrix<double, 3, 2> higher;
};

/// r = (error - t rate - d - s/2 curvature - H (c_R + c_p) - e) / sigma, s: pose_smoothing +
/// position_smoothing less the accel_smoothing of the trajectory, h, H: higher, e: slow error: what
/// splines correct is not averaged over. Blocks: d | knots of e | pose_smoothing (1) |
/// position_smoothing (1) | h (1) | pose_cumulants c_R (2) | position_cumulants c_p (2) | clocks.
std::unique_ptr<SampledCost> CreateJointPositionResidual(Samples<JointPoseSample> samples,
                                                         const ClockMotions& clocks);

/// r = (error - phi - s/2 curvature - H c_R - e) / sigma, s: pose_smoothing. Blocks: phi | knots of
/// e | s (1) | c_R (2).
std::unique_ptr<SampledCost> CreateJointRotationResidual(Samples<JointPoseSample> samples);

/// A sample of the gyroscope, and what accelerometers have, too.
struct JointImuSample : JointSample {
  Eigen::Vector3d omega_M, alpha_M;  ///< [rad/s], [rad/s^2] of the GP
  Eigen::Vector3d value;             ///< gyroscope [rad/s] or accelerometer [m/s^2] in I
  double bias_u;                     ///< 0..1 between the bias knots
  double sigma;                      ///< unit of value
  /// Second derivative of omega_M [rad/s^3] or f_M [m/s^4], components in M.
  Eigen::Vector3d curvature = Eigen::Vector3d::Zero();
  /// By how much the mean of omega_M or f_M over an instant's surroundings of the variance s
  /// exceeds that of a trajectory that is averaged alike, over s/2: doc/math.md, "Filter of the
  /// gyroscope".
  Eigen::Vector3d cone = Eigen::Vector3d::Zero();
};

/// JointImuSample::cone of the gyroscope.
Eigen::Vector3d RateCone(const MarkerRotation<double>& m);
/// That of the accelerometer at p_M [m]; `rate`: derivatives of alpha_M and a_W.
Eigen::Vector3d ForceCone(const MarkerState<double>& m, const MarkerState<double>& rate,
                          const Eigen::Vector3d& g_W, const Eigen::Vector3d& p_M);

/// r = (w - b_g - K_g R_MI^T (omega_M + s/2 omega_M'' + c/2 cone) - K R^T (phi' + omega_M x phi)) /
/// sigma, in I, s: gyro_smoothing less that of the trajectory, c, K and R: as K_g and R_MI are in
/// `calibration` now. Blocks: phi | knots of b_g | calibration: q_MI (4, xyzw) | K_g (6, see
/// GyroMatrix()) | s (1) | c (1) | clocks | walk.
std::unique_ptr<SampledCost> CreateJointGyroResidual(Samples<JointImuSample> samples,
                                                     double const* const* calibration,
                                                     const ClockMotions& clocks,
                                                     bool has_walk = false);

/// A sample of the accelerometer, with derivatives of the GP's motion, along which it moves and
/// over which it averages.
struct JointAccelSample : JointImuSample {
  Eigen::Quaterniond q_WM;                               ///< of the GP
  Eigen::Vector3d a_W;                                   ///< [m/s^2] of the GP
  Eigen::Vector3d alpha_rate = Eigen::Vector3d::Zero();  ///< [rad/s^3] in M
  Eigen::Vector3d jerk_W = Eigen::Vector3d::Zero();      ///< [m/s^3]
  Eigen::Vector3d f_swing = Eigen::Vector3d::Zero();     ///< [m/s^4] R_WM^T (R_WM f_M)''
  /// [m/s^4] -R_WM^T a_W'', which the trajectory has less of when its position is averaged; of the
  /// first IMU, which averages as long, and f_M''.
  Eigen::Vector3d averaged = Eigen::Vector3d::Zero();
};

/// r = (f - b_a - K_a R_MI^T (f_M + s/2 f_M'' + h/2 averaged + c/2 cone -
/// m R_WM^T (R_WM f_M)'') - F) / sigma, in I, s: gyro_smoothing + accel_smoothing less what the
/// trajectory has of either, c and h, m: mount_compliance, with
/// f_M = R_WM^T (a_W / k - g_W) + alpha_M x p + omega_M x (omega_M x p), k: pose_scale. For axis i
/// p is p_MI + R_MA r_i with r_i of AccelPositions() and R_MA: R_MI as it is in `calibration` now.
/// F: what d and phi change K_a R_MI^T f_M by to first order, by `calibration` as it is now.
/// Blocks: d | phi | knots of b_a | calibration: q_MI (4) | K_a (9, see AccelMatrix()) | p_MI (3) |
/// g_W (3) | accel_smoothing, of the first IMU less h (1) | mount_compliance (1) | pose_scale (1) |
/// r (6) | gyro_smoothing less c (1) | c (1) | h (1) | clocks | walk.
std::unique_ptr<SampledCost> CreateJointAccelResidual(Samples<JointAccelSample> samples,
                                                      double const* const* calibration,
                                                      const ClockMotions& clocks,
                                                      bool has_walk = false);

}  // namespace imu_pose_calib
