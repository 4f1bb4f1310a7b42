#pragma once

#include <optional>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/core/start/clock_walk.h"
#include "imu_pose_calib/core/trajectory/pose_trajectory.h"

namespace imu_pose_calib {

/// What the solve starts from for one IMU. Times are relative to the epochs of the
/// session and the IMU: t_pose = t_imu + time_shift with t_pose after
/// ConditionedData::pose_epoch_ns and t_imu after ConditionedImu::epoch_ns.
struct Start {
  double time_shift = 0.0;   ///< [s]
  double clock_drift = 0.0;  ///< [s/s] unless it is not estimated or not sure
  ClockWalk walk;            ///< beyond these; about the middle of the gyroscope's log
  double accel_delay = 0.0;  ///< [s]
  Eigen::Quaterniond q_MI = Eigen::Quaterniond::Identity();
  Eigen::Vector3d p_MI = Eigen::Vector3d::Zero();        ///< [m]
  Eigen::Vector3d g_W = Eigen::Vector3d::Zero();         ///< [m/s^2]
  Eigen::Vector3d gyro_bias = Eigen::Vector3d::Zero();   ///< [rad/s] in I
  Eigen::Vector3d accel_bias = Eigen::Vector3d::Zero();  ///< [m/s^2] in I
};

/// Drops the segments on which the marker turns against the gyroscope, as with swapped labels that
/// turn the marker's frame on its body; they leave `trajectory` and data->poses and are counted.
/// The rotation R_MI of the first IMU on which the longest part of the log agrees decides.
/// Throws DataError when no such part prevails.
void RemoveFlippedSegments(const CalibrationOptions& options, PoseTrajectory* trajectory,
                           ConditionedData* data);

/// p_MI, g_W and accel_bias by linear least squares on the accelerometer, given start->q_MI and
/// start->time_shift; start->accel_delay is searched on +-0.1 s when `estimate_delay`.
/// Throws DataError when the gravity found is not between half and twice `gravity_magnitude`, or
/// when the positions are in another unit than the accelerometer.
void FitLeverArm(const PoseTrajectory& trajectory, const std::vector<TimedSample>& accel,
                 double gravity_magnitude, bool estimate_delay, int threads, Start* start);

/// Stage S2: closed-form start of one IMU; initial values of the options take precedence.
/// Throws DataError when the rates of poses and gyroscope do not match at any time shift, or match
/// better when the poses are inverted.
Start Initialise(const CalibrationOptions& options, const PoseTrajectory& trajectory,
                 const ConditionedData& data, size_t imu);

// --- What it is made of ---

/// Time shifts at which |omega_M| and |gyro| correlate best, the best first, at most `count`.
/// Every overlap of at least `min_overlap_s` is searched, or those within 1 s of `guess`.
std::vector<double> FindTimeShifts(const PoseTrajectory& trajectory,
                                   const std::vector<TimedPose>& poses,
                                   const std::vector<TimedSample>& gyro, double min_overlap_s,
                                   const std::optional<double>& guess, int count, int threads = 1);

/// log likelihood ratio of a correlation over n bins: long and close overlaps win.
double Evidence(double correlation, double n);

/// Every so many of `size` samples are enough for a closed-form fit.
size_t Stride(size_t size);

/// The rates of marker and gyroscope at one instant.
struct RatePair {
  double t;  ///< [s] pose clock
  Eigen::Vector3d omega_M, gyro_I;
};

/// The gyro samples that fall on the trajectory. `inverted`: the rates of the world seen from the
/// marker.
std::vector<RatePair> PairRates(const PoseTrajectory& trajectory,
                                const std::vector<TimedSample>& gyro, double time_shift,
                                bool inverted = false);

/// Rotation, gyro bias and fit of the rates at a given time shift.
struct RateAlignment {
  Eigen::Quaterniond q_MI = Eigen::Quaterniond::Identity();
  Eigen::Vector3d gyro_bias = Eigen::Vector3d::Zero();  ///< [rad/s] in I
  double scale = 0.0;      ///< rms of the gyro's rates over the marker's: 1 when both are rad/s
  double explained = 0.0;  ///< share of the gyro's variance that the marker's rates explain
  size_t count = 0;        ///< gyro samples that fall on the trajectory

  /// Of the gyroscope [rad/s].
  Eigen::Vector3d Residual(const RatePair& pair) const;
};

/// SVD solution of Wahba's problem on mean-free rates, omega_M = R_MI (gyro - bias).
RateAlignment AlignRates(const std::vector<RatePair>& pairs);
RateAlignment AlignRates(const PoseTrajectory& trajectory, const std::vector<TimedSample>& gyro,
                         double time_shift);

}  // namespace imu_pose_calib
