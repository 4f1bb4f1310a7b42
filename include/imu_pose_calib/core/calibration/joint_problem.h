#pragma once

#include <memory>
#include <vector>

#include "imu_pose_calib/core/calibration/correction_splines.h"
#include "imu_pose_calib/core/calibration/least_squares.h"

namespace imu_pose_calib {

/// Stage S4: trajectories and calibration together, doc/math.md. Every pose and every IMU sample is
/// a residual weighted by its own noise only. `splines`: of each session.
std::unique_ptr<LeastSquares> BuildJointProblem(const CalibrationOptions& options,
                                                const std::vector<PreparedSession>& sessions,
                                                const std::vector<SensorModel>& models,
                                                Estimate* estimate,
                                                std::vector<CorrectionSplines>* splines);

}  // namespace imu_pose_calib
