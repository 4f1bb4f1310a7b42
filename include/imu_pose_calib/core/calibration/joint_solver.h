#pragma once

/// Room core/calibration: the model, and the minimum of its cost (S3, S4).
/// In: PreparedSession of each session and options. Out: Solution: the estimate, noise and weights
/// of the sensors, correction splines of the trajectory, and the marginals of what is calibrated.
/// Throws DataError when the last pass does not converge.

#include <vector>

#include "imu_pose_calib/core/calibration/solution.h"

namespace imu_pose_calib {

/// Stage S4 at the knot spacings [s] of the sessions: passes of least squares with the noise and
/// the robust weights that the residuals before show, until the noise found agrees with the noise
/// assumed (doc/math.md, S4, "Passes"). Moves `estimate`; the sessions lose what the splines cannot
/// follow, and their trajectories move to the solution.
Solution SolveJointly(const CalibrationOptions& options, const std::vector<double>& knot_spacings_s,
                      std::vector<PreparedSession>* sessions, Estimate* estimate);

}  // namespace imu_pose_calib
