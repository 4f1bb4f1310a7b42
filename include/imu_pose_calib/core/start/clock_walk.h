#pragma once

#include <cstddef>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/core/trajectory/pose_trajectory.h"

namespace imu_pose_calib {

/// A clock that is a line: t_pose = t + time_shift + clock_drift (t - clock_reference).
struct ClockLine {
  double time_shift = 0.0;       ///< [s]
  double clock_drift = 0.0;      ///< [s/s] growth of the time shift
  double clock_reference = 0.0;  ///< [s] IMU clock: instant at which time_shift holds

  /// Pose clock at t [s, IMU clock]. The accelerometer's samples describe t = stamp - accel_delay.
  double PoseTime(double t) const { return t + time_shift + clock_drift * (t - clock_reference); }
  /// The other way.
  double ImuTime(double t_M) const {
    return (t_M - time_shift + clock_drift * clock_reference) / (1.0 + clock_drift);
  }
};

/// What a clock's offset is beyond a line: a walk, piecewise linear between knots, whose increments
/// have priors of their own (doc/math.md, "Clocks that wander").
struct ClockWalk {
  std::vector<double> t;       ///< [s] IMU clock, increasing; none: the clock is a line
  std::vector<double> offset;  ///< [s] at the knots
  std::vector<double> std;     ///< [s] sigma of the increment after each knot but the last
  size_t reference = 0;        ///< knot at which the offset is 0
  std::vector<size_t> steps;   ///< knots after which the clock steps, from one sample to the next

  bool IsLine() const { return t.empty(); }
  /// Index of the knot before an instant (not the last one) and the fraction of the way to the
  /// next. Not of a line.
  std::pair<size_t, double> Locate(double instant) const;
  double At(double instant) const;
};

/// A clock that walks about a line.
struct Clock : ClockLine {
  ClockWalk walk;

  double PoseTime(double t) const { return ClockLine::PoseTime(t) + walk.At(t); }
  double ImuTime(double t_M) const;
};

/// Finds the walk of a clock that is a line, from the turn rates of trajectory and gyroscope; its
/// density is the likeliest. It stays a line when the rates do not speak for a walk. Moves the
/// time shift to where the walk is at the reference.
void FitClockWalk(const PoseTrajectory& trajectory, const std::vector<TimedSample>& gyro,
                  Clock* clock);

}  // namespace imu_pose_calib
