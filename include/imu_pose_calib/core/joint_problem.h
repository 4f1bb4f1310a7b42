#pragma once

#include <optional>
#include <vector>

#include "imu_pose_calib/core/calibration_problem.h"
#include "imu_pose_calib/core/spline.h"

namespace imu_pose_calib {

/// Corrections of the trajectory of S1 by uniform cubic B-splines, one per run without a gap:
///   R_WM(t) = R_gp(t) Exp(phi(t)),   p_WM(t) = p_gp(t) + d(t).
class CorrectionSplines {
 public:
  /// Where an instant lies: fraction `u` of a span and the index of the first of the kSplineOrder
  /// control points that act on it.
  struct Place {
    size_t first;
    double u;
    double spacing;  ///< [s] of the span
  };

  /// Zero corrections with knots about `spacing_s` apart on the parts of the trajectory that the
  /// IMU samples cover at the time shift of `estimate`.
  CorrectionSplines(const ConditionedData& data, const Estimate& estimate, double spacing_s);

  /// Place of t [s, pose clock]; nothing when no spline covers t.
  std::optional<Place> Locate(double t) const;

  std::vector<Eigen::Vector3d> d;    ///< control points [m] in W
  std::vector<Eigen::Vector3d> phi;  ///< control points [rad] in M

 private:
  struct Range {
    double begin, end;  ///< [s] pose clock
    double spacing;     ///< [s]
    size_t first;       ///< control point
    size_t spans;
  };
  const Range* Find(double t) const;
  std::vector<Range> ranges_;
};

/// Stage S4: trajectory and calibration together, doc/math.md. Every pose and every IMU sample is a
/// residual weighted by its own noise only.
class JointProblem : public CalibrationProblem {
 public:
  JointProblem(const CalibrationOptions& options,
               const PoseTrajectory& trajectory,
               const ConditionedData& data,
               const NoiseStd& noise,
               Estimate* estimate,
               CorrectionSplines* splines);

 private:
  void AddPoses();
  void AddGyro();
  void AddAccel();
  /// Variance of the lever arm's coefficients at t_M that the joint trajectory's errors cause.
  double LeverArmErrors(double t_M, double spacing) const;
  std::vector<double*> ControlPoints(const std::vector<std::vector<Eigen::Vector3d>*>& splines,
                                     const CorrectionSplines::Place& place) const;

  CorrectionSplines* const splines_;
};

}  // namespace imu_pose_calib
