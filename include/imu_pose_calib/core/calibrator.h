#pragma once

#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// Told when a stage begins, and with the iterations that it took, 0 for none, when it has ended.
using Progress = std::function<void(const std::string& stage, std::optional<int> iterations)>;

/// Estimates T_MI and accel_delay of every IMU of a rig and the time shifts of every session, from
/// poses of M and IMU samples of I (doc/math.md). No initial guess is needed. All sessions are
/// recordings of one rig; they need not share a world frame, a clock, a length or the IMUs that
/// they hold.
///
/// Throws InputError for options out of range and DataError for data that cannot be used (too few
/// samples, wrong units, no overlap, no motion). A motion that leaves part of the calibration
/// undetermined gives status kDegenerate.
Calibration Calibrate(const CalibrationOptions& options, std::vector<SessionData> sessions,
                      const Progress& progress = {});

/// The same of a single recording.
Calibration Calibrate(const CalibrationOptions& options, const SessionData& session);

}  // namespace imu_pose_calib
