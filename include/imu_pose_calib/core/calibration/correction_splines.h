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
  /// The splines go along when the line of the clock that maps to t changes: from `before` to
  /// `after`, which are of the same IMU in the same session.
  void MoveWithClock(const ClockLine& before, const ClockLine& after, double delay_growth);

  /// The runs, in order: instants t [s, pose clock] and control points.
  struct Run {
    double begin, end;
    size_t first, points;
  };
  std::vector<Run> Runs() const;

  /// About the time between knots [s].
  double spacing() const { return spacing_; }

  /// While the clocks move, the splines stay with the poses; else they go along with the
  /// accelerometer of the first IMU.
  bool is_with_poses = false;

  std::vector<Eigen::Vector3d> d;    ///< control points [m] in W
  std::vector<Eigen::Vector3d> phi;  ///< control points [rad] in M

 private:
  struct Range {
    double begin, end;  ///< t [s]
    double spacing;     ///< [s]
    size_t first;       ///< control point
    size_t spans;
  };
  const Range* Find(double t) const;
  double spacing_;
  std::vector<Range> ranges_;
};

}  // namespace imu_pose_calib
