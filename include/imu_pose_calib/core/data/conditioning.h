#pragma once

/// Room core/data: a recording becomes data that the next stages can rely on (S0).
/// In: samples of poses and IMUs in the order in which they arrived, and options.
/// Out: ConditionedData in SI units, strictly increasing time, cut at gaps and jumps; every dropped
/// sample is counted. Throws DataError for what cannot be used. Knows nothing of trajectories.

#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/core/data/conditioned_data.h"
#include "imu_pose_calib/core/data/stamp_recovery.h"

namespace imu_pose_calib {

/// Whether two poses are the same but for their stamps.
bool SameValue(const PoseSample& a, const PoseSample& b);

/// Samples that hold the value before: the source has no new one. A sensor at rest measures the
/// same again by chance; that value is as good as new, and shows by the next one, which is then
/// within two steps of its resolution (the smallest step of each axis).
std::vector<bool> FindRepeats(const std::vector<PoseSample>& samples);
std::vector<bool> FindRepeats(const std::vector<ImuSample>& samples);

/// The pose T_WM [m] of what was recorded as the options say.
PoseSample ToMarkerPose(const CalibrationOptions& options, PoseSample recorded);

/// Poses from one measurement to the next of a filter that carries them on with an IMU in between,
/// or of an interpolation: there, they jump or bend, and no pose in between tells anything new
/// (doc/math.md, "Fused poses"). 1 when the poses show no such beat. In order of time.
double FindUpdatePeriod(const std::vector<PoseSample>& poses);

/// Keeps one of `period` poses, evenly in time, and returns how many have gone.
size_t KeepOneOf(double period, std::vector<PoseSample>* poses);

/// Stage S0. Every dropped sample is counted in a report.
/// Throws DataError naming the number and the bound when a stream is empty, too short, mostly
/// unusable, or not in SI units.
ConditionedData ConditionData(const CalibrationOptions& options, const SessionData& session);

/// The same once RecoverStamps() has looked at the stamps.
ConditionedData ConditionData(const CalibrationOptions& options, const SessionData& session,
                              const SessionStamps& stamps);

}  // namespace imu_pose_calib
