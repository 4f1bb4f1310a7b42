#pragma once

#include <vector>

#include "imu_pose_calib/core/options.h"
#include "imu_pose_calib/core/result.h"
#include "imu_pose_calib/core/types.h"

namespace imu_pose_calib {

/// Estimates T_MI and accel_delay of every IMU of a rig and the time shifts of every session, from
/// poses of M and IMU samples of I (doc/math.md). No initial guess is needed. All sessions are
/// recordings of one rig; they need not share a world frame, a clock, a length or the IMUs that
/// they hold.
///
/// Throws InputError for options out of range and DataError for data that cannot be used (too few
/// samples, wrong units, no overlap, no motion). A motion that leaves part of the calibration
/// undetermined gives status kDegenerate.
Calibration Calibrate(const CalibrationOptions& options, const std::vector<SessionData>& sessions);

/// The same of a single recording.
Calibration Calibrate(const CalibrationOptions& options, const SessionData& session);

}  // namespace imu_pose_calib
