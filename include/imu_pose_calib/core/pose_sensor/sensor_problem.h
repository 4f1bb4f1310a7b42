#pragma once

#include <Eigen/Core>
#include <memory>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/ground_truth/trajectory.h"

namespace imu_pose_calib {

/// A pose of the sensor, where T_MS and its clock put it on the marker's trajectory, and what the
/// filter makes of V then.
struct SensorPose {
  TimedPose measured;  ///< T_VS; sensor clock, after the session's epoch
  Eigen::Array2d weight = Eigen::Array2d::Ones();  ///< robust, of position and rotation
  bool begins_piece = false;                       ///< of V
  BodyState sensor;                                ///< S in W
  Rigid3 world;         ///< R_VW, and where V has the sensor: p_VW + scale R_VW p_WS
  Matrix6d covariance;  ///< of that position [m] and the rotation [rad], both in V
};

/// One session of a sensor, as estimated.
struct SensorSession {
  std::shared_ptr<const SessionTrajectory> marker;
  int64_t epoch_ns = 0;  ///< sensor clock
  ClockLine clock;       ///< of both after their epochs
  StreamReport report;
  double scale = 1.0;
  Eigen::Array2d noise, drift;      ///< PoseSensorSession::noise and drift
  std::vector<SensorPose> samples;  ///< none: the session lacks the sensor
};

struct SensorEstimate {
  Rigid3 T_MS;
  std::vector<SensorSession> sessions;
};

/// SensorPose::world as the pose alone implies it.
Rigid3 ImpliedWorld(const SensorPose& sample);
/// The same V where the sensor is at another pose.
Rigid3 Carried(const SensorSession& session, const SensorPose& from, const SensorPose& to,
               const Rigid3& world);
/// Measured pose less the one where V is `world`, both in V [m, rad].
Vector6d FindResidual(const SensorPose& sample, const Rigid3& world);

/// Puts the poses where the clock of the estimate says. Those that fall off the marker's trajectory
/// are left out for good: what is solved for must not come and go.
void PlaceSamples(const Rigid3& T_MS, SensorSession* session);

/// Minimum of the cost of all sessions (doc/math.md, "Pose sensors"); noise, drift and weights are
/// kept. False when it does not converge.
bool SolveSensor(const CalibrationOptions& options, SensorEstimate* estimate);
/// Weights of the poses, noise and drift from what is left; true when they are as before.
bool FindNoise(SensorEstimate* estimate);

/// Covariance of p_MS, of R_MS on the right, then of time shift, drift of the clock and scale of
/// each session: H^-1, enlarged by the sandwich over time blocks. What is calibrated stays, V
/// follows it.
Eigen::MatrixXd FindSensorCovariance(const CalibrationOptions& options, SensorEstimate* estimate);

}  // namespace imu_pose_calib
