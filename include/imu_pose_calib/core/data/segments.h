#pragma once

#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/data/conditioned_data.h"

namespace imu_pose_calib {

/// Removes the poses that leave, and segments of which less than two are left, and returns how many
/// have gone.
size_t RemovePoses(const std::vector<bool>& leaves, ConditionedData* data);

/// Cuts the poses into segments at gaps; runs that are too short are dropped and counted.
/// Throws DataError when no run is left.
void SplitAtGaps(const CalibrationOptions& options, ConditionedData* data);

/// Cuts the segments where a pose cannot follow from the one before it (swapped marker labels, a
/// tracker that finds itself anew) and counts the jumps. Runs between jumps that are too short for
/// a segment are dropped and count as outliers. Single spikes must be gone already.
/// Throws DataError when no run is left.
void SplitAtJumps(const CalibrationOptions& options, ConditionedData* data);

}  // namespace imu_pose_calib
