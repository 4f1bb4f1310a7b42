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
  double t;                   ///< [s] sensor clock, after the session's epoch
  Rigid3 T_VS;                ///< measured
  PoseStd scale;              ///< of its noise, as far as the source states it
  PoseStd weight{1.0, 1.0};   ///< robust
  bool begins_piece = false;  ///< of V
  BodyState sensor;           ///< S in W
  Rigid3 T_VW;                ///< by all poses
  Matrix6d covariance;        ///< of T_VW, as a WorldStep() where the sensor is
};

/// One session of a sensor, as estimated. t_M = t + time_shift + clock_drift (t - reference), both
/// after their epochs.
struct SensorSession {
  std::shared_ptr<const SessionTrajectory> marker;
  int64_t epoch_ns = 0;  ///< sensor clock
  StreamReport report;
  double time_shift = 0.0, clock_drift = 0.0, reference = 0.0;  ///< [s], [s/s], [s]
  double scale = 1.0;
  PoseStd noise;                    ///< per axis and pose
  PoseStd drift;                    ///< [m/sqrt(s)], [rad/sqrt(s)]
  PoseStd loss{1.0, 1.0};           ///< factors of the noise by which weighted poses tell less
  std::vector<SensorPose> samples;  ///< none: the session lacks the sensor
};

struct SensorEstimate {
  Rigid3 T_MS;
  std::vector<SensorSession> sessions;
};

/// Measured pose less the predicted one where V is `T_VW`, both in V [m, rad].
Vector6d FindResidual(const SensorSession& session, const SensorPose& sample, const Rigid3& T_VW);

/// T_VW as the pose alone implies it.
Rigid3 ImpliedWorld(const SensorSession& session, const SensorPose& sample);

/// Puts the poses where the clock of the estimate says. Those that fall off the marker's trajectory
/// are left out for good: what is solved for must not come and go.
void PlaceSamples(const Rigid3& T_MS, SensorSession* session);

/// Minimum of the cost of all sessions (doc/math.md, "Pose sensors"); noise, drift and weights are
/// kept. False when it does not converge.
bool SolveSensor(const CalibrationOptions& options, SensorEstimate* estimate);
/// Weights of the poses, noise and drift from what is left; true when they are as before.
bool FindNoise(SensorEstimate* estimate);

/// Covariance of p_MS, of R_MS on the right, then of time shift, drift of the clock and scale of
/// each session that has the sensor: H^-1, and enlarged by the sandwich over time blocks. What is
/// calibrated stays, V follows it.
struct SensorCovariance {
  Eigen::MatrixXd model, covariance;
};
SensorCovariance FindSensorCovariance(const CalibrationOptions& options, SensorEstimate* estimate);

}  // namespace imu_pose_calib
