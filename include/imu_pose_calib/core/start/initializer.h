#pragma once

#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/data/conditioned_data.h"
#include "imu_pose_calib/core/start/clock_walk.h"
#include "imu_pose_calib/core/trajectory/pose_trajectory.h"

namespace imu_pose_calib {

/// What the solve starts from for one IMU. Times of its clock, which does not drift, are relative
/// to the epochs of the session and the IMU, ConditionedData::pose_epoch_ns and
/// ConditionedImu::epoch_ns; the time shift holds in the middle of the gyroscope's log.
struct Start : Clock {
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

/// p_MI, g_W and accel_bias by linear least squares on the accelerometer, given start->q_MI,
/// start->time_shift and start->walk; start->accel_delay is searched on +-0.1 s when
/// `estimate_delay`. Throws DataError when the gravity found is not between half and twice
/// `gravity_magnitude`, or when the positions are in another unit than the accelerometer.
void FitLeverArm(const PoseTrajectory& trajectory, const std::vector<TimedSample>& accel,
                 double gravity_magnitude, bool estimate_delay, int threads, Start* start);

/// Stage S2: closed-form start of one IMU; initial values of the options take precedence.
/// Throws DataError when the rates of poses and gyroscope do not match at any time shift, or match
/// better when the poses are inverted.
Start Initialise(const CalibrationOptions& options, const PoseTrajectory& trajectory,
                 const ConditionedData& data, size_t imu);

}  // namespace imu_pose_calib
