#pragma once

#include <cstdint>
#include <optional>
#include <vector>

namespace imu_pose_calib {

/// Stamps of the clock of a source that samples evenly, but for missing frames, from those recorded
/// in order of arrival, with which they agree on average (doc/math.md, "Clock of the stamps").
/// Where the clock breaks another one begins; stretches too short for one stay as recorded. Nothing
/// when counting periods does not explain the stamps.
std::optional<std::vector<int64_t>> RecoverClock(const std::vector<int64_t>& recorded_ns);

}  // namespace imu_pose_calib
