#pragma once

/// Room core/calibration: the model, and the minimum of its cost (S3, S4).
/// In: PreparedSession of each session and options. Out: Solution: the estimate, noise and weights
/// of the sensors, correction splines of the trajectory, and the marginals of what is calibrated.
/// Throws DataError when the last pass does not converge.

#include <vector>

#include "imu_pose_calib/core/calibration/solution.h"

namespace imu_pose_calib {

/// Where the joint solve of a session starts from beside the estimate.
struct JointStart {
  double knot_spacing_s;
  PreparedSession session;    ///< with what the splines can follow
  std::vector<double> noise;  ///< of the sensors, in the order of InitialModels()
  double excitation;  ///< [rad^2/s^4] mean square of alpha_M of the seconds that were looked at
};

/// Knot spacing of one session: options.knot_spacing_s, or refined on the most excited seconds of
/// the log until the IMU residuals stop shrinking or a denser one does not converge (doc/math.md,
/// S4, "Knot spacing"). The noise is what these residuals show, and `estimate` moves to the
/// calibration of these seconds.
JointStart ChooseKnotSpacing(const CalibrationOptions& options, const PreparedSession& session,
                             Estimate* estimate);

/// Stage S4 as a whole at the knot spacings and noise of each session; `sessions` are those of the
/// starts: passes of least squares with the noise and the robust weights that the residuals
/// before show, until the noise found agrees with the noise assumed (doc/math.md, S4, "Passes").
/// Moves `estimate` and the trajectories of the sessions.
Solution SolveJointly(const CalibrationOptions& options, const std::vector<JointStart>& starts,
                      std::vector<PreparedSession>* sessions, Estimate* estimate);

}  // namespace imu_pose_calib
