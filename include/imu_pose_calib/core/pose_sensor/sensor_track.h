#pragma once

#include <functional>
#include <memory>
#include <optional>
#include <vector>

#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/ground_truth/imu_track.h"

namespace imu_pose_calib {

/// The motion of a pose sensor in one session: ground truth for its poses, from the marker's
/// trajectory and T_MS.
class SensorTrack {
 public:
  /// The session must have the sensor. TrackClock::kImu: its own.
  SensorTrack(const std::shared_ptr<const Solution>& solution, size_t session,
              const PoseSensorCalibration& sensor, TrackClock clock = TrackClock::kImu)
      : sensor_(sensor), session_(session), clock_(clock), trajectory_(solution, session) {}

  /// Of its poses that were used or, for a rate > 0 [Hz], evenly from the first of them to the last
  /// one.
  std::vector<ImuTrack::Instant> Instants(double rate_hz) const;

  /// S in place of I and without biases; nothing in gaps of the marker's poses. Covariances are 0
  /// without IMUs and with method `gp`; else that of the marker, of T_MS and, on the sensor's
  /// clock, of the clock, taken to be independent.
  std::optional<ImuState> At(double t) const;
  bool has_covariance() const { return trajectory_.covariance() != nullptr; }

 private:
  const PoseSensorSession& Own() const { return sensor_.sessions[session_]; }

  const PoseSensorCalibration& sensor_;
  const size_t session_;
  const TrackClock clock_;
  const SessionTrajectory trajectory_;
};

/// Errors of the poses that were used; V's drift and jumps count as errors. `T_WS`: truth at t [s,
/// pose clock]; poses where it is not known are left out.
SensorErrors FindErrors(const PoseSensorSession& session,
                        const std::function<std::optional<Rigid3>(double t)>& T_WS);
/// Against the trajectory of the solve.
SensorErrors FindErrors(const std::shared_ptr<const Solution>& solution, size_t session,
                        const PoseSensorCalibration& sensor);

}  // namespace imu_pose_calib
