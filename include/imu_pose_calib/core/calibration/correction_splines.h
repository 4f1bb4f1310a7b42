#pragma once

#include <optional>
#include <vector>

#include "imu_pose_calib/core/base/spline.h"
#include "imu_pose_calib/core/calibration/estimate.h"

namespace imu_pose_calib {

/// Corrections of a session's trajectory of S1 by uniform cubic B-splines over t [s, pose clock],
/// one per run in which there are poses and samples of an IMU without a gap:
///   R_WM(t) = R_gp(t) Exp(phi(t)),   p_WM(t) = p_gp(t) + d(t).
class CorrectionSplines {
 public:
  /// Zero corrections with knots about `spacing_s` apart on the parts of the trajectory that the
  /// IMUs cover where the clocks of `estimate` stand.
  CorrectionSplines(const ConditionedData& data, const Estimate& estimate, size_t session,
                    double spacing_s);

  /// Place of t; nothing when no spline covers it.
  std::optional<SplinePlace> Locate(double t) const;

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
  double spacing_;
  std::vector<Run> runs_;
};

}  // namespace imu_pose_calib
