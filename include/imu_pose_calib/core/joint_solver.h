#pragma once

#include "imu_pose_calib/core/calibration_problem.h"

namespace imu_pose_calib {

/// Where the joint solve starts from beside the estimate.
struct JointStart {
  double knot_spacing_s;
  NoiseStd noise;
};

/// Knot spacing: options.knot_spacing_s, or refined on the liveliest seconds of the log until the
/// IMU residuals stop shrinking (doc/math.md, S4, "Knot spacing"). The noise is what these
/// residuals show, and `estimate` moves to the calibration of these seconds.
JointStart ChooseKnotSpacing(const CalibrationOptions& options,
                             const PoseTrajectory& trajectory,
                             const ConditionedData& data,
                             Estimate* estimate);

/// Stage S4 as a whole at one knot spacing: passes of JointProblem with the noise and the robust
/// weights that the residuals before show, until the noise found agrees with the noise assumed
/// (doc/math.md, S4, "Passes"). Moves `estimate`.
Solution SolveJointly(const CalibrationOptions& options,
                      const PoseTrajectory& trajectory,
                      const ConditionedData& data,
                      const JointStart& start,
                      Estimate* estimate);

}  // namespace imu_pose_calib
