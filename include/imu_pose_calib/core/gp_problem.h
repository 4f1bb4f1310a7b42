#pragma once

#include <memory>

#include "imu_pose_calib/core/least_squares.h"
#include "imu_pose_calib/core/solution.h"

namespace imu_pose_calib {

/// Which sensors a problem of stage S3 holds.
enum class GpSensors { kGyro, kGyroAndAccel };

/// Stage S3: the calibration against the fixed trajectories of S1, doc/math.md. Throws DataError
/// when no sample falls on a trajectory.
std::unique_ptr<LeastSquares> BuildGpProblem(const CalibrationOptions& options,
                                             const std::vector<PreparedSession>& sessions,
                                             const std::vector<SensorModel>& models,
                                             GpSensors sensors,
                                             Estimate* estimate);

/// Stage S3 as a whole: rotation, gyro bias and time shift on the gyroscope; then everything on
/// both sensors, twice: each time with the noise that the residuals before show. Moves `estimate`.
Solution SolveAgainstTrajectory(const CalibrationOptions& options,
                                const std::vector<PreparedSession>& sessions,
                                Estimate* estimate);

}  // namespace imu_pose_calib
