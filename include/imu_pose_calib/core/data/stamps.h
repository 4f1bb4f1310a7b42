#pragma once

#include <cstdint>
#include <vector>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// A sample stamped further from the median of its stream is astray (stamp 0, clock set meanwhile).
constexpr int64_t kMaxAstrayNs = 6 * 3600 * int64_t{1'000'000'000};

/// A sample that arrives up to this much after a later-stamped one is sorted in; beyond, one of the
/// stamps is not believed.
constexpr int64_t kMaxReorderNs = 1'000'000'000;

/// Why a stamp is not believed: hours from the others; after most of what arrived around it, see
/// IsStampedAhead(); more than a second before one that arrived earlier.
enum class StampFault { kNone, kAstray, kAhead, kReversed };

/// Whether stamp i, in order of arrival, is by more than a second after most of those that come
/// next, and after most of those before it as well. The last before a clock jumps back agree with
/// those before them, the first after a pause with those that come next.
bool IsStampedAhead(const std::vector<int64_t>& stamps_ns, size_t i);

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
