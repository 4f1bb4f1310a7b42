#pragma once

/// Room core/verdict: how sure the result is, in numbers and words (S5).
/// In: Marginals and prepared sessions. Out: sigmas, observability, status, message and warnings of
/// a Calibration, agreement of halves and sessions. Changes no estimate.

#include <string>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/calibration/marginals.h"

namespace imu_pose_calib {

/// T_FS of two frames of the body, IMUs or pose sensors, whose places in the rig are 0. Covariances
/// are those of (p_MF, R_MF) and (p_MS, R_MS), rotations about the axes of F and S; `cross` is that
/// of the one with the other.
BetweenImus Between(const Rigid3& T_MF, const Matrix6d& covariance_F, const Rigid3& T_MS,
                    const Matrix6d& covariance_S, const Matrix6d& cross = Matrix6d::Zero());

/// Adds the principal directions of a 3x3 covariance, each with its sigma; none for 0.
void AddDirections(const Eigen::Matrix3d& C, const std::string& name, const std::string& frame,
                   const std::string& unit, std::vector<Observability>* spectrum);

/// Gives each direction its status and sorts them, the worst first. Returns the status of all, and
/// one sentence of it.
Status GradeSpectrum(const CalibrationOptions& options, std::vector<Observability>* spectrum,
                     std::string* message);

/// Stage S5: fills covariances, sigmas, observability, split halves, status and message.
void GradeResult(const CalibrationOptions& options, const Marginals& marginals,
                 Calibration* result);

/// Adds a warning in words for each sign that the model does not fit the data: correlated
/// residuals, drifting clocks, wrong scales, a long accel_delay.
void WarnOfMisfit(const Marginals& marginals, Calibration* result);

}  // namespace imu_pose_calib
