#pragma once

#include "imu_pose_calib/core/calibration_problem.h"

namespace imu_pose_calib {

/// Knot spacing [s] of the joint solve: options.knot_spacing_s, or refined on the liveliest seconds
/// of the log until the IMU residuals stop shrinking (doc/math.md, S4, "Knot spacing").
double ChooseKnotSpacing(const CalibrationOptions& options,
                         const PoseTrajectory& trajectory,
                         const ConditionedData& data,
                         const Estimate& estimate);

/// Stage S4 as a whole at one knot spacing: passes of JointProblem with the noise and the robust
/// weights that the residuals before show, until the noise found agrees with the noise assumed
/// (doc/math.md, S4, "Passes"). Moves `estimate`.
Solution SolveJointly(const CalibrationOptions& options,
                      const PoseTrajectory& trajectory,
                      const ConditionedData& data,
                      double knot_spacing_s,
                      Estimate* estimate);

}  // namespace imu_pose_calib
