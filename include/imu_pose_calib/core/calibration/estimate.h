#pragma once

#include <array>
#include <memory>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/core/start/preparation.h"
#include "imu_pose_calib/core/trajectory/pose_trajectory.h"

namespace imu_pose_calib {

/// A bias of a sensor that changes linearly between knots.
struct BiasKnots {
  std::vector<double> t;                ///< [s] clock of the sensor, increasing, at least two
  std::vector<Eigen::Vector3d> values;  ///< in I, of poses in M

  BiasKnots() = default;
  /// Knots every `interval_s` over the samples, or one at every sample when 0.
  BiasKnots(const std::vector<TimedSample>& samples, double interval_s,
            const Eigen::Vector3d& initial);
  /// Zeros at knots about `interval_s` apart.
  BiasKnots(double begin, double end, double interval_s);

  /// Index of the knot before t (not the last one) and the fraction of the way to the next.
  std::pair<size_t, double> Locate(double t) const;
  Eigen::Vector3d At(double t) const;
  Eigen::Vector3d Mean() const;
};

/// What poses err by for seconds, positions [m] in W or rotations [rad] in M, doc/math.md, S4,
/// "Slow errors": an Ornstein-Uhlenbeck process of each axis.
struct SlowErrors {
  static constexpr double kTime = 1.0;  ///< [s] in which an error falls to 1/e
  BiasKnots knots;
  double std = 0.0;  ///< at an instant

  SlowErrors() = default;
  /// None, of poses in that time [s], at knots so far apart [s], with a sigma to start from.
  SlowErrors(double begin, double end, double interval_s, double start);

  /// Share of an error at knot k that is left at the next one.
  double Kept(size_t k) const;
  /// Two-sided power spectral density over the variance [1/Hz] at (2 pi frequency)^2.
  double Density(double omega2) const;
};

/// An IMU of the rig.
struct ImuEstimate {
  Eigen::Quaterniond q_MI = Eigen::Quaterniond::Identity();
  Eigen::Vector3d p_MI = Eigen::Vector3d::Zero();  ///< [m]
  double accel_delay = 0.0;                        ///< [s]
  double gyro_smoothing = 0.0;                     ///< [s^2] less that of the first IMU's gyroscope
  double accel_smoothing = 0.0;                    ///< [s^2] of all but the first, whose is above
  double mount_compliance = 0.0;                   ///< [s^2] see ImuCalibration
  Vector6d gyro_intrinsics = Vector6d::Zero();     ///< of GyroMatrix()
  Vector9d accel_intrinsics = Vector9d::Zero();    ///< of AccelMatrix()
  Vector6d accel_positions = Vector6d::Zero();     ///< [m] of AccelPositions()
};

/// An IMU in a session; times as in Start.
struct ImuSessionEstimate : Clock {
  bool is_present = false;
  BiasKnots gyro_bias, accel_bias;
};

struct SessionEstimate {
  Eigen::Vector3d g_W = Eigen::Vector3d::Zero();  ///< [m/s^2]
  std::vector<ImuSessionEstimate> imus;           ///< in the order of the rig
  SlowErrors position_errors, rotation_errors;

  /// No slow errors yet, of poses in that time [s].
  void BeginSlowErrors(double begin, double end);
  /// Both, position first.
  std::array<SlowErrors*, 2> AllErrors() { return {&position_errors, &rotation_errors}; }
  std::array<const SlowErrors*, 2> AllErrors() const {
    return {&position_errors, &rotation_errors};
  }
  size_t FirstImu() const;
};

/// exp(-|A x - b|^2 / 2) of some x.
struct GaussianFactor {
  Eigen::MatrixXd A;
  Eigen::VectorXd b;
};

/// State of the solve but for the trajectories: the rig, and its sessions.
struct Estimate {
  // Of the source of the poses, see Calibration:
  double pose_smoothing = 0.0, position_smoothing = 0.0;  ///< [s^2]
  Eigen::Vector2d pose_cumulants = Eigen::Vector2d::Zero(),
                  position_cumulants = Eigen::Vector2d::Zero();  ///< [s^3, s^4]
  double position_delay = 0.0;                                   ///< [s]
  double pose_scale = 1.0;
  /// Of the first IMU's gyroscope [s^2] and, beyond that, of its accelerometer; and of the
  /// trajectory: its rotation is averaged as the one averages, its position as the other.
  double gyro_smoothing = 0.0, accel_smoothing = 0.0;
  std::vector<ImuEstimate> imus;
  std::vector<SessionEstimate> sessions;
  GaussianFactor peaks;  ///< stands for priors with peaks, see MatchPeaks()

  /// What is estimated of an IMU's sensors: of gyroscopes but the first, less that one's.
  double& GyroSmoothing(size_t imu) { return imu == 0 ? gyro_smoothing : imus[imu].gyro_smoothing; }
  double& AccelSmoothing(size_t imu) {
    return imu == 0 ? accel_smoothing : imus[imu].accel_smoothing;
  }

  Estimate() = default;
  /// One session where S2 leaves it.
  Estimate(const PreparedSession& session, double bias_knot_interval_s);
};

/// Parameters of a calibration, those of the IMUs and clocks first.
enum class ParameterKind {
  kTranslation,        ///< p_MI [m] in M
  kRotation,           ///< [rad] about the imu axes, R_MI Exp(dtheta)
  kTimeShift,          ///< [s] of an IMU in a session
  kAccelDelay,         ///< [s]
  kClockDrift,         ///< [s/s] of an IMU in a session
  kPoseSmoothing,      ///< [s^2]
  kPositionSmoothing,  ///< [s^2]
  kPoseCumulants,      ///< [s^3, s^4]
  kPositionCumulants,  ///< [s^3, s^4]
  kPositionDelay,      ///< [s]
  kPoseScale,          ///< [1]
  kGyroSmoothing,      ///< [s^2] of the first IMU's; of others, less that
  kAccelSmoothing,     ///< [s^2]
  kMountCompliance,    ///< [s^2]
  kGyroIntrinsics,     ///< 6, of GyroMatrix()
  kAccelIntrinsics,    ///< 9, of AccelMatrix()
  kAccelPositions,     ///< 6 [m], of AccelPositions()
  kGravity,            ///< [m/s^2] of a session
  kGyroBias,           ///< [rad/s] of an IMU in a session, mean
  kAccelBias,          ///< [m/s^2] of an IMU in a session, mean
};

/// One parameter and where it stands in the estimate; `imu` and `session` as far as they apply.
struct Parameter {
  ParameterKind kind;
  size_t imu, session;
  int size;      ///< degrees of freedom
  double* data;  ///< in the estimate; a mean: null
};

/// Of the source of the poses, which IMUs and sessions share.
bool IsOfPoses(ParameterKind kind);

/// Of an IMU in one session alone.
bool IsOfSession(ParameterKind kind);

/// What is calibrated: all but gravity and biases, of every IMU that is present, in a fixed order.
std::vector<Parameter> CalibrationParameters(Estimate* estimate);

/// Whether the options want it estimated.
bool IsEstimated(const CalibrationOptions& options, ParameterKind kind);

}  // namespace imu_pose_calib
