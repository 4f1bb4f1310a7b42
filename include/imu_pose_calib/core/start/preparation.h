#pragma once

/// Room core/start: what the solve starts from, in closed form (S2), and what a recording is worth.
/// In: a session and options. Out: PreparedSession, with a Start for each IMU (time shift,
/// rotation, lever arm, gravity, walk of the clock), and DataCheck with all remarks. Throws
/// DataError when poses and IMU do not match, DegenerateMotion when turns do not suffice.

#include <memory>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/start/data_check.h"
#include "imu_pose_calib/core/start/initializer.h"

namespace imu_pose_calib {

/// A session as S0 to S2 leave it.
struct PreparedSession {
  ConditionedData data;
  std::shared_ptr<const PoseTrajectory> trajectory;
  std::vector<Start> starts;  ///< of each IMU of the rig; meaningless for one that is not present
  PoseStd pose_noise;         ///< per axis, as S1 finds it
};

/// Throws InputError when one value is given and kept of what there are several of.
void CheckSingle(const CalibrationOptions& options, size_t imus, size_t sessions);

/// Stages S0 to S2 of one session, with all that they remark in `check`.
///
/// Throws DataError for data that cannot be used and DegenerateMotion when the marker does not turn
/// enough; what was found by then is in `check`.
PreparedSession Prepare(const CalibrationOptions& options, const SessionData& session,
                        DataCheck* check);

/// What a recording is worth, by these stages, with the verdict. Data that Calibrate() would refuse
/// are `kRecordAgain`, or `kUsable` when they only need another option. Throws InputError for
/// options that it would refuse.
DataCheck CheckData(const CalibrationOptions& options, const SessionData& session);

}  // namespace imu_pose_calib
