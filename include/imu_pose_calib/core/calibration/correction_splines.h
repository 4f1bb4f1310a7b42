#pragma once

#include <optional>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/base/spline.h"
#include "imu_pose_calib/core/calibration/estimate.h"
#include "imu_pose_calib/core/trajectory/pose_trajectory.h"

namespace imu_pose_calib {

/// The GP's motion with corrections d and phi, of which there are values and time derivatives in
/// the columns.
template <typename T>
MarkerState<T> Corrected(const MarkerState<double>& gp, const Eigen::Matrix<T, 3, 3>& d,
                         const Eigen::Matrix<T, 3, 3>& phi) {
  using Vector3 = Eigen::Matrix<T, 3, 1>;
  Vector3 u, u_dot;
  CorrectionRate<T>(phi.col(0), phi.col(1), phi.col(2), &u, &u_dot);
  const Eigen::Quaternion<T> E = Exp<T>(phi.col(0));
  const Vector3 omega_E = E.conjugate() * Vector3(gp.omega_M.cast<T>());
  MarkerState<T> state;
  state.q_WM = gp.q_WM.cast<T>() * E;
  state.omega_M = omega_E + u;
  state.alpha_M = E.conjugate() * Vector3(gp.alpha_M.cast<T>()) - u.cross(omega_E) + u_dot;
  state.p_WM = gp.p_WM.cast<T>() + d.col(0);
  state.v_W = gp.v_W.cast<T>() + d.col(1);
  state.a_W = gp.a_W.cast<T>() + d.col(2);
  return state;
}

/// What splines with knots `spacing_s` [s] apart follow well, below the highest frequency that they
/// can hold [Hz].
inline double Band(double spacing_s) { return 0.5625 * 0.5 / spacing_s; }
/// Samples of an IMU that are further apart [s] leave knots of such splines without one: a gap, at
/// which runs end.
inline double LongestStepOf(double spacing_s) { return 2.0 * spacing_s; }

/// Corrections of a session's trajectory of S1 by uniform cubic B-splines over t [s, pose clock],
/// one per run in which there are poses and samples of an IMU without a gap:
///   R_WM(t) = R_gp(t) Exp(phi(t)),   p_WM(t) = p_gp(t) + d(t).
class CorrectionSplines {
 public:
  /// Zero corrections with knots about `spacing_s` apart on the parts of the trajectory that the
  /// IMUs cover where the clocks of `estimate` stand, as far as their samples are used:
  /// kSegmentEdge from the ends of segments.
  CorrectionSplines(const ConditionedData& data, const Estimate& estimate, size_t session,
                    double spacing_s);

  /// Place of t; nothing when no spline covers it.
  std::optional<SplinePlace> Locate(double t) const;

  /// The GP's motion at t as it is corrected; nothing where it is not.
  std::optional<MarkerState<double>> Correct(const PoseTrajectory& gp, double t) const;

  /// That at the knots of each run, and how it would go on for `reach` [s] beyond them with the
  /// accelerations of the ends; `runs`: of the poses that are returned.
  std::vector<TimedPose> SampleMotion(const PoseTrajectory& gp, double reach, int threads,
                                      std::vector<IndexRange>* runs) const;

  /// Corrections of `to`, by which the motion stays at the knots what it is by those of `from`.
  void Rebase(const PoseTrajectory& from, const PoseTrajectory& to, int threads);

  /// Instants t [s, pose clock] and control points, of which there are `spans` + kSplineOrder - 1.
  struct Run {
    double begin, end, spacing;  ///< [s]
    size_t first, spans;
  };
  const std::vector<Run>& Runs() const { return runs_; }

  /// About the time between knots [s].
  double spacing() const { return spacing_; }

  std::vector<Eigen::Vector3d> d;    ///< control points [m] in W
  std::vector<Eigen::Vector3d> phi;  ///< control points [rad] in M

 private:
  const Run* Find(double t) const;  ///< null where no spline is

  double spacing_;
  std::vector<Run> runs_;
};

}  // namespace imu_pose_calib
