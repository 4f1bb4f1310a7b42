#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <iterator>
#include <memory>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/data/conditioned_data.h"
#include "imu_pose_calib/core/ground_truth/trajectory.h"

namespace imu_pose_calib {

/// A pose of the sensor, and the marker's motion where the estimate of its clock puts it.
struct SensorPose {
  double t;                   ///< [s] sensor clock, after the session's epoch
  Rigid3 T_VS;                ///< measured
  PoseStd scale;              ///< of its noise, as far as the source states it
  PoseStd weight{1.0, 1.0};   ///< robust
  BodyState marker;           ///< at that instant
  size_t knot = 0;            ///< of V, before it
  double u = 0.0;             ///< 0..1 from there to the next one
  bool begins_piece = false;  ///< of V

  Eigen::Vector3d p_WS(const Rigid3& T_MS) const { return marker.p_WB + marker.q_WB * T_MS.p; }
};

/// T_VW at an instant; linear up to the next knot, which is of the same piece unless it begins one.
struct WorldKnot {
  double t;  ///< [s] sensor clock
  Rigid3 T_VW;
  bool begins_piece;
  Eigen::Vector3d p_WS;               ///< [m] where the sensor is: V drifts about it
  Vector6d moved = Vector6d::Zero();  ///< of the solve: p_VW [m], and R_VW on the left [rad]
};

/// The later one of the two knots that V at t is between.
template <typename Knots>
auto KnotAfter(const Knots& knots, double t) {
  const auto after =
      std::upper_bound(knots.begin() + 1, knots.end(), t,
                       [](double value, const auto& knot) { return value < knot.t; });
  return after == knots.end() || after->begins_piece ? std::prev(after) : after;
}

/// One session of a sensor, as estimated. t_M = t + time_shift + clock_drift (t - reference), both
/// after their epochs.
struct SensorSession {
  std::shared_ptr<const SessionTrajectory> marker;
  ConditionedData data;  ///< without IMUs; no poses: the session lacks the sensor
  double time_shift = 0.0, clock_drift = 0.0, reference = 0.0;  ///< [s], [s/s], [s]
  double scale = 1.0;
  PoseStd noise;           ///< per axis and pose
  PoseStd drift;           ///< [m/sqrt(s)], [rad/sqrt(s)]
  PoseStd loss{1.0, 1.0};  ///< factors of the noise by which weighted poses tell less
  std::vector<SensorPose> samples;
  std::vector<double> jumps;  ///< [s, sensor clock] between two poses
  std::vector<WorldKnot> knots;
};

struct SensorEstimate {
  Rigid3 T_MS;
  std::vector<SensorSession> sessions;
};

/// Measured pose less the predicted one: position in V [m], rotation in S [rad].
Vector6d FindResidual(const SensorEstimate& estimate, const SensorSession& session,
                      const SensorPose& sample);

/// By how much the step from one T_VW to another moves what is at p_V [m], and turns it [rad].
Vector6d WorldStep(const Rigid3& from, const Rigid3& to, const Eigen::Vector3d& p_V);

/// Median of the T_VW that poses imply, component by component, where the sensor is at the middle
/// one; `end` is one past the last.
Rigid3 MedianWorld(const Rigid3& T_MS, double scale, const SensorPose* begin,
                   const SensorPose* end);

/// Puts the poses where the clock of the estimate says, among the knots if there are any. Those
/// that fall off the marker's trajectory are left out for good: what is solved for must not come
/// and go.
void PlaceSamples(SensorSession* session);
/// Knots of V as far apart as its drift allows, each the median of the poses around it.
void PlaceKnots(const Rigid3& T_MS, SensorSession* session);

/// Minimum of the cost of all sessions (doc/math.md, "Pose sensors"), by Ceres; noise, drift and
/// weights are kept, poses placed anew. False when it does not converge.
bool SolveSensor(const CalibrationOptions& options, SensorEstimate* estimate);
/// Weights of the poses, noise and drift from what is left; true when they are as before.
bool FindNoise(SensorEstimate* estimate);

/// Covariance of p_MS, of R_MS on the right, then of time shift, drift of the clock and scale of
/// each session that has the sensor: H^-1, and enlarged by the sandwich over time blocks. The
/// estimate stays.
struct SensorCovariance {
  Eigen::MatrixXd model, covariance;
};
SensorCovariance FindSensorCovariance(const CalibrationOptions& options, SensorEstimate* estimate);

}  // namespace imu_pose_calib
