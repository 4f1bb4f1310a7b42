#pragma once

#include <cstddef>
#include <vector>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// Poses from one measurement to the next of a filter that carries them on with an IMU in between,
/// or of an interpolation: there, they jump or bend, and no pose in between tells anything new
/// (doc/math.md, "Fused poses"). 1 when the poses show no such beat. In order of time.
size_t FindUpdatePeriod(const std::vector<PoseSample>& poses);

/// Keeps one of `period` poses, evenly in time, and returns how many have gone.
size_t KeepOneOf(size_t period, std::vector<PoseSample>* poses);

}  // namespace imu_pose_calib
