#pragma once

#include <array>
#include <cmath>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

struct Solution;

/// What became of the samples of one sensor (S0). received = used + the dropped ones.
struct StreamReport {
  size_t received = 0;
  size_t used = 0;
  size_t not_finite = 0;        ///< NaN or infinite value
  size_t zero_quaternion = 0;   ///< poses only
  size_t reversed_stamp = 0;    ///< 1 s from what arrived around it, or hours astray
  size_t duplicate_stamp = 0;   ///< same stamp as another sample
  size_t repeated_value = 0;    ///< exactly the previous value under a new stamp (frozen)
  size_t saturated = 0;         ///< IMU only: at the end of the sensor's range
  size_t outlier = 0;           ///< off its neighbours
  size_t flipped = 0;           ///< poses only: in a run that turns against the gyroscope
  size_t in_short_segment = 0;  ///< poses only: between gaps less than min_segment_s apart
  size_t between_updates = 0;   ///< poses only: tells nothing new, see FindUpdatePeriod()
  double rate_hz = 0.0;         ///< 1 / median period of the samples used
  double duration_s = 0.0;      ///< first to last sample used

  bool stamps_even = true;        ///< as recorded
  bool stamps_recovered = false;  ///< the stamps are those of the source's own clock, estimated
  double stamp_jitter_s = 0.0;    ///< rms of recorded less recovered stamp, about its mean
};

enum class Status {
  kNotRun,
  kOk,          ///< every sigma within its threshold
  kWeak,        ///< usable with care: a sigma beyond its threshold
  kDegenerate,  ///< the data do not determine the calibration; `message` names what is missing
};
inline const char* ToString(Status status) {
  return std::array{"not run", "ok", "weak", "degenerate"}[static_cast<size_t>(status)];
}

/// How well one direction of the calibration is determined.
struct Observability {
  std::string direction;  ///< in words: "p_MI along marker z", "time_shift"
  double std = 0.0;       ///< sigma [m, rad or s]
  std::string unit;       ///< "m", "rad", "s"
  Status status = Status::kNotRun;
};

/// Second half of the log less the first, each taken alone.
struct SplitHalf {
  Eigen::Vector3d translation = Eigen::Vector3d::Zero();  ///< [m] in M
  Eigen::Vector3d rotation = Eigen::Vector3d::Zero();     ///< [rad] about the imu axes
  double time_shift = 0.0;                                ///< [s]
  double sigmas = 0.0;  ///< largest difference of a component in its sigma
};

/// What belongs to one IMU of the rig, whatever the session.
struct ImuCalibration {
  Rigid3 T_MI;  ///< x_M = T_MI x_I
  /// Covariance of (p_MI [m] in M, small rotation [rad] about the imu axes: R_MI Exp(dtheta)).
  Matrix6d covariance = Matrix6d::Zero();
  /// The same as if residuals were independent and sessions agreed.
  Matrix6d model_covariance = Matrix6d::Zero();
  double accel_delay = 0.0;      ///< [s] t_pose = t_accel + time_shift - accel_delay
  double accel_delay_std = 0.0;  ///< [s], 0 when not estimated
  /// [s^2] variance of the time over which the gyroscope averages; 0 when not estimated.
  double gyro_smoothing = 0.0, gyro_smoothing_std = 0.0;
  /// [s^2] by how much the variance of the time over which the accelerometer averages exceeds that
  /// of the gyroscope; 0 when not estimated.
  double accel_smoothing = 0.0, accel_smoothing_std = 0.0;
  /// [s^2] by how far specific force moves the IMU on its mount, [m] per [m/s^2]: the inverse
  /// square of the mount's resonance [rad/s]. T_MI is without load. 0 when not estimated.
  double mount_compliance = 0.0, mount_compliance_std = 0.0;
  /// The same by all that shows it, with its sigma: an accelerometer that averages over less time
  /// than none amplifies fast motion along its own axes, and rests on something soft, too.
  std::pair<double, double> Compliance() const {
    const double amplified = -0.5 * (gyro_smoothing + accel_smoothing);
    if (accel_smoothing_std == 0.0 || amplified <= 0.0)
      return {mount_compliance, mount_compliance_std};
    return {mount_compliance + amplified,
            std::hypot(mount_compliance_std, accel_smoothing_std / 2)};
  }

  /// Scale and misalignment: measured = M true + bias, in I. Identity when not estimated.
  Eigen::Matrix3d gyro_matrix = Eigen::Matrix3d::Identity();
  Eigen::Matrix3d accel_matrix = Eigen::Matrix3d::Identity();
  Eigen::Matrix3d gyro_matrix_std = Eigen::Matrix3d::Zero();
  Eigen::Matrix3d accel_matrix_std = Eigen::Matrix3d::Zero();
  /// [m] in I, column i: where the accelerometer's axis i is, see AccelPositions(). 0 when not
  /// estimated.
  Eigen::Matrix3d accel_positions = Eigen::Matrix3d::Zero();
  Eigen::Matrix3d accel_positions_std = Eigen::Matrix3d::Zero();

  Vector6d Std() const { return covariance.diagonal().cwiseSqrt(); }
};

/// Transform between two IMUs of the rig, from the same estimate: x_first = T x_second.
struct BetweenImus {
  size_t first = 0, second = 0;  ///< places in the rig
  Rigid3 T;
  /// Covariance of (translation [m] in the first IMU, small rotation [rad] about the second's
  /// axes).
  Matrix6d covariance = Matrix6d::Zero();

  Vector6d Std() const { return covariance.diagonal().cwiseSqrt(); }
};

/// t_pose - t_imu over time: linear between knots.
struct ClockOffsets {
  struct Step {
    double t, size;  ///< [s] IMU clock, and by which the offset jumps
  };
  std::vector<double> t;            ///< [s] IMU clock
  std::vector<double> offset, std;  ///< [s]
  std::vector<Step> steps;
  bool wanders = false;  ///< it is not a line
};

/// What belongs to one IMU in one session.
struct ImuSession {
  bool is_present = false;  ///< else nothing below is set

  double time_shift = 0.0;      ///< [s] t_pose = t_imu + time_shift
  double time_shift_std = 0.0;  ///< [s]
  /// t_pose = t_imu + time_shift + clock_drift (t_imu - clock_reference); 0 when not estimated.
  double clock_drift = 0.0, clock_drift_std = 0.0;  ///< [s/s]
  double clock_reference = 0.0;                     ///< [s] IMU clock
  ClockOffsets clock;

  Eigen::Vector3d gyro_bias = Eigen::Vector3d::Zero();   ///< [rad/s] in I, mean over the log
  Eigen::Vector3d accel_bias = Eigen::Vector3d::Zero();  ///< [m/s^2] in I, mean over the log
  Eigen::Vector3d gyro_bias_std = Eigen::Vector3d::Zero();
  Eigen::Vector3d accel_bias_std = Eigen::Vector3d::Zero();

  ImuStd noise;  ///< white noise per sample, as estimated
  ImuStd rms;    ///< of the residuals of the samples used
  StreamReport gyro, accel;
};

/// Errors of the trajectory that a sensor gives: rms of the lengths of translations [m] and of the
/// angles of rotations [rad], as evo defines them.
struct SensorErrors {
  PoseStd absolute;  ///< evo_ape, aligned by T_VW as the session begins and by the scale
  PoseStd relative;  ///< evo_rpe of all pairs a second apart, to half a period
  size_t poses = 0, pairs = 0;
};

/// What belongs to a pose sensor in one session: p_VS = p_VW + scale R_VW (p_WM + R_WM p_MS).
struct PoseSensorSession {
  bool is_present = false;  ///< else nothing below is set

  double time_shift = 0.0, time_shift_std = 0.0;    ///< [s] t_pose = t_sensor + time_shift
  double clock_drift = 0.0, clock_drift_std = 0.0;  ///< [s/s] as ImuSession::clock_drift
  double clock_reference = 0.0;                     ///< [s] sensor clock
  double scale = 1.0, scale_std = 0.0;              ///< of its positions

  PoseStd noise;  ///< white noise per pose, as estimated
  PoseStd rms;    ///< of the residuals of the poses used
  PoseStd drift;  ///< walk of V where the body is [m/sqrt(s)], [rad/sqrt(s)]

  /// T_VW at each pose, read from a file where pieces begin; a jump begins the next piece.
  struct WorldKnot {
    double t;  ///< [s] pose clock
    Rigid3 T_VW;
    bool begins_piece;
  };
  std::vector<WorldKnot> world;
  /// Measured less predicted pose.
  struct Residual {
    double t;                                 ///< [s] pose clock
    Eigen::Vector3d position;                 ///< [m] in V
    Eigen::Vector3d rotation;                 ///< [rad] in S
    double position_weight, rotation_weight;  ///< robust (0..1]
    int64_t stamp_ns = 0;                     ///< sensor clock
  };
  std::vector<Residual> residuals;
  SensorErrors errors;
  StreamReport poses;
};

/// A further source of poses on the rig.
struct PoseSensorCalibration {
  Rigid3 T_MS;  ///< x_M = T_MS x_S
  /// Covariance of (p_MS [m] in M, small rotation [rad] about the sensor's axes).
  Matrix6d covariance = Matrix6d::Zero();
  std::vector<PoseSensorSession> sessions;
  std::vector<Observability> observability;  ///< the least certain direction first
  Status status = Status::kNotRun;
  std::string message;  ///< one sentence: the verdict and its reason

  Vector6d Std() const { return covariance.diagonal().cwiseSqrt(); }
};

/// What a session says alone, of the first IMU that it has.
struct OwnEstimate {
  size_t imu = 0;  ///< place of that IMU in the rig
  Rigid3 T_MI;
  Vector6d std = Vector6d::Zero();  ///< as ImuCalibration::Std()
  double accel_delay = 0.0, accel_delay_std = 0.0;
  double time_shift = 0.0, time_shift_std = 0.0;
};

/// A session's own estimate of the rig against that of all others; set when there are others.
struct Agreement {
  double chi2 = 0.0;
  int dof = 0;
  /// Largest difference of a component, in words and in its sigma: "translation z".
  std::string worst;
  double difference = 0.0;  ///< of that component, own less the others'
  std::string unit;         ///< "m", "rad" or "s"
  double sigmas = 0.0;
};

/// What belongs to one session: one recording with a world frame, a marker clock and IMU clocks of
/// its own.
struct SessionCalibration {
  Eigen::Vector3d g_W = Eigen::Vector3d::Zero();      ///< [m/s^2], points down
  Eigen::Vector3d g_W_std = Eigen::Vector3d::Zero();  ///< [m/s^2]
  std::vector<ImuSession> imus = std::vector<ImuSession>(1);

  PoseStd noise;        ///< white noise per pose, as estimated
  PoseStd rms;          ///< of the residuals of the poses used
  PoseStd slow_errors;  ///< of what the poses err by for seconds; 0 when not estimated
  /// GP length scales used [s].
  double position_lengthscale_s = 0.0;
  double rotation_lengthscale_s = 0.0;
  /// Knot spacing of the joint solve's splines [s]; 0 when not used.
  double knot_spacing_s = 0.0;

  StreamReport poses;
  size_t segments = 0;  ///< runs of poses without a gap
  size_t gaps = 0;      ///< pose gaps longer than max_gap_s
  size_t jumps = 0;     ///< cuts where a pose cannot follow from the one before it

  OwnEstimate own;
  Agreement agreement;
};

/// Result of Calibrate(). Only kOk and kWeak are results.
struct Calibration {
  Status status = Status::kNotRun;
  /// One sentence for people: the verdict and its reason.
  std::string message = "Calibrate() was not called";
  Method method = Method::kJoint;
  ImuModel imu_model = ImuModel::kCalibrated;

  std::vector<ImuCalibration> imus = std::vector<ImuCalibration>(1);  ///< none: of a rig without
  std::vector<BetweenImus> between_imus;  ///< from the first IMU to each other
  std::vector<PoseSensorCalibration> pose_sensors;
  std::vector<SessionCalibration> sessions = std::vector<SessionCalibration>(1);
  /// [s^2] by how much the variance of the time over which a pose's rotation is averaged exceeds
  /// that of the first IMU's gyroscope; 0 when not estimated.
  double pose_smoothing = 0.0, pose_smoothing_std = 0.0;
  /// [s^2] by how much that of its position exceeds that of its rotation; 0 when not estimated.
  double position_smoothing = 0.0, position_smoothing_std = 0.0;
  /// [s^3, s^4] third and fourth cumulant of the time over which a pose's rotation is averaged, the
  /// third positive when a little of it is long ago; 0 when not estimated.
  Eigen::Vector2d pose_cumulants = Eigen::Vector2d::Zero(),
                  pose_cumulants_std = Eigen::Vector2d::Zero();
  /// [s^3, s^4] by how much those of its position exceed that.
  Eigen::Vector2d position_cumulants = Eigen::Vector2d::Zero(),
                  position_cumulants_std = Eigen::Vector2d::Zero();
  /// [s] by how much its position is later than its rotation; 0 when not estimated.
  double position_delay = 0.0, position_delay_std = 0.0;
  /// Positions of the poses are those of a body this many times as large; sigma 0: not estimated.
  double pose_scale = 1.0, pose_scale_std = 0.0;

  /// Spectrum of the calibration, the least certain direction first.
  std::vector<Observability> observability;
  SplitHalf split_half;
  /// Directions of the calibration that the motion does not determine, in words; empty when all
  /// are determined.
  std::vector<std::string> unobservable;
  std::vector<std::string> warnings;

  /// What the solve knows beyond this: trajectories, residuals, covariances (core/solution.h). Null
  /// when it was not reached.
  std::shared_ptr<const Solution> solution;

  /// The numbers may be used: status kOk or kWeak.
  bool IsUsable() const { return status == Status::kOk || status == Status::kWeak; }
};

}  // namespace imu_pose_calib
