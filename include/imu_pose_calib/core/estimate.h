#pragma once

#include <utility>
#include <vector>

#include "imu_pose_calib/core/conditioning.h"
#include "imu_pose_calib/core/initializer.h"

namespace imu_pose_calib {

/// A bias that changes linearly between knots.
struct BiasKnots {
  std::vector<double> t;                ///< [s] IMU clock, increasing, at least two
  std::vector<Eigen::Vector3d> values;  ///< in I

  /// Knots every `interval_s` over the samples, or one at every sample when 0.
  BiasKnots(const std::vector<TimedSample>& samples,
            double interval_s,
            const Eigen::Vector3d& initial);

  /// Index of the knot before t (not the last one) and the fraction of the way to the next.
  std::pair<size_t, double> Locate(double t) const;
  Eigen::Vector3d Mean() const;
};

/// State of the solve; times as in Start.
struct Estimate {
  double time_shift, accel_delay;
  double clock_drift = 0.0;      ///< [s/s] growth of the time shift
  double clock_reference = 0.0;  ///< [s] IMU clock: instant at which time_shift holds
  double pose_smoothing = 0.0;   ///< [s^2] see Calibration
  Eigen::Quaterniond q_MI;
  Eigen::Vector3d p_MI, g_W;
  Vector6d gyro_intrinsics = Vector6d::Zero();   ///< of GyroMatrix()
  Vector9d accel_intrinsics = Vector9d::Zero();  ///< of AccelMatrix()
  BiasKnots gyro_bias, accel_bias;

  Estimate(const Start& start, const ConditionedData& data, double bias_knot_interval_s);

  /// Pose clock at t [s, IMU clock]. The accelerometer's samples describe t = stamp - accel_delay.
  double PoseTime(double t) const { return t + time_shift + clock_drift * (t - clock_reference); }
  /// The other way.
  double ImuTime(double t_M) const {
    return (t_M - time_shift + clock_drift * clock_reference) / (1.0 + clock_drift);
  }
};

}  // namespace imu_pose_calib
