#pragma once

#include <memory>
#include <vector>

#include "imu_pose_calib/core/calibration/correction_splines.h"
#include "imu_pose_calib/core/calibration/estimate.h"

namespace imu_pose_calib {

/// The session with nothing beyond `cutoff` [Hz] in its trajectory, its poses and the samples of
/// its IMUs, all smoothed alike; what is taken from a sample is its `rest`. doc/math.md, S4, "One
/// band".
PreparedSession LimitBand(const PreparedSession& session, double cutoff, int threads);

/// Instants [s, pose clock] at which the samples of an IMU are compared: one between two knots,
/// those of the gyroscope in the middle and those of the accelerometer at the knots, where the turn
/// rate and the acceleration of what swings from knot to knot are largest. Where a trajectory
/// cannot follow samples, that passes for what the calibration is told by; where samples do not see
/// a part of the trajectory, it is anything. doc/math.md, S4, "One band".
struct ImuInstants {
  std::vector<double> gyro, accel;
};
/// Of each IMU: those at which it has samples by its clock as it stands.
std::vector<ImuInstants> FindInstants(const PreparedSession& limited, const SessionEstimate& clocks,
                                      const CorrectionSplines& splines);

/// What LimitBand() returned with one pose in each `spacing_s` of those that are as noisy, which
/// stands for the others.
PreparedSession Thinned(const PreparedSession& limited, double spacing_s);

/// Sets the samples of IMUs in `thinned` to those at the instants, where the clocks of the estimate
/// stand now.
void Resample(const PreparedSession& limited, const std::vector<ImuInstants>& instants,
              const Estimate& estimate, size_t session, double spacing_s, int threads,
              PreparedSession* thinned);

/// What `splines` make of `gp`, where they are, with what LimitBand() leaves a trajectory of their
/// band.
std::shared_ptr<const PoseTrajectory> SmoothTrajectory(const PoseTrajectory& gp,
                                                       const CorrectionSplines& splines,
                                                       int threads);

}  // namespace imu_pose_calib
