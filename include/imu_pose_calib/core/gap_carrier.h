#pragma once

#include <vector>

#include "imu_pose_calib/core/trajectory.h"

namespace imu_pose_calib {

/// A sensor as recorded at t [s, IMU clock], linear between samples; nothing where some are
/// missing.
std::optional<Eigen::Vector3d> RecordedAt(const std::vector<TimedSample>& samples,
                                          double rate_hz,
                                          double t);

/// State of an IMU that was integrated from its own samples.
struct CarriedState {
  double t;  ///< [s] pose clock
  Eigen::Quaterniond q_WI;
  Eigen::Vector3d p_WI;     ///< [m]
  Eigen::Vector3d v_W;      ///< [m/s]
  Eigen::Vector3d omega_I;  ///< [rad/s]
  /// Of the rotation [rad, about the axes of I: R_WI Exp(dtheta)], p_WI and v_W.
  Eigen::Matrix<double, 9, 9> covariance;
};

/// The motion of an IMU from `begin` to `end` [s, pose clock], between two runs of a joint solve's
/// trajectory: integrated from the state in which the first run ends, and adjusted to meet the one
/// in which the second begins, each by its covariance (doc/trajectory.md). States at both ends and
/// at the samples of the gyroscope in between; none when the IMU has a gap, too, or when the two
/// runs are further apart than their sigmas and the IMU's noise explain.
std::vector<CarriedState> CarryAcrossGap(const Solution& solution,
                                         const SessionTrajectory& trajectory,
                                         size_t session,
                                         size_t imu,
                                         double begin,
                                         double end);

/// Between two states that follow each other.
CarriedState Interpolate(const CarriedState& a, const CarriedState& b, double t);

}  // namespace imu_pose_calib
