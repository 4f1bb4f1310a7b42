#pragma once

#include <cstdint>
#include <vector>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// Why a stamp is not believed: hours from the others (stamp 0, clock set meanwhile); more than a
/// second after most of what arrived around it; more than a second before one that arrived earlier.
enum class StampFault { kNone, kAstray, kAhead, kReversed };

/// The faults of stamps in order of arrival.
std::vector<StampFault> JudgeStamps(const std::vector<int64_t>& stamps_ns);

template <typename Sample>
std::vector<int64_t> Stamps(const std::vector<Sample>& samples) {
  std::vector<int64_t> stamps_ns;
  for (const Sample& s : samples) stamps_ns.push_back(s.t_ns);
  return stamps_ns;
}

/// Whether two samples are the same but for their stamps.
bool SameValue(const PoseSample& a, const PoseSample& b);
bool SameValue(const ImuSample& a, const ImuSample& b);

}  // namespace imu_pose_calib
