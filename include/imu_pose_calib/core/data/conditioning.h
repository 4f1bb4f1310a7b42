#pragma once

/// Room core/data: a recording becomes data that the next stages can rely on (S0).
/// In: samples of poses and IMUs in the order in which they arrived, and options.
/// Out: ConditionedData in SI units, strictly increasing time, cut at gaps and jumps; every dropped
/// sample is counted. Throws DataError for what cannot be used. Knows nothing of trajectories.

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/data/conditioned_data.h"
#include "imu_pose_calib/core/data/stamp_recovery.h"

namespace imu_pose_calib {

/// The pose T_WM [m] of what was recorded as the options say.
PoseSample ToMarkerPose(const CalibrationOptions& options, PoseSample recorded);

/// Stage S0. Every dropped sample is counted in a report.
/// Throws DataError naming the number and the bound when a stream is empty, too short, mostly
/// unusable, or not in SI units.
ConditionedData ConditionData(const CalibrationOptions& options, const SessionData& session);

/// The same once RecoverStamps() has looked at the stamps.
ConditionedData ConditionData(const CalibrationOptions& options, const SessionData& session,
                              const SessionStamps& stamps);

}  // namespace imu_pose_calib
