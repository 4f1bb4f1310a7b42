#include "imu_pose_calib/core/data/stamps.h"

#include <algorithm>
#include <cstdlib>
#include <limits>

namespace imu_pose_calib {
namespace {

constexpr int64_t kMaxAstrayNs = 6 * 3600 * int64_t{1'000'000'000};  // from the median
/// A sample that arrives up to this much after a later-stamped one is sorted in.
constexpr int64_t kMaxReorderNs = 1'000'000'000;

/// Whether stamp i, in order of arrival, is by more than a second after most of those that come
/// next, and after most of those before it as well. The last before a clock jumps back agree with
/// those before them, the first after a pause with those that come next.
bool IsStampedAhead(const std::vector<int64_t>& stamps_ns, size_t i) {
  constexpr size_t kNear = 9;
  const auto earlier = [&](size_t begin, size_t end) {
    size_t count = 0;
    for (size_t k = begin; k < end; ++k)
      if (stamps_ns[k] < stamps_ns[i] - kMaxReorderNs) ++count;
    return count;
  };
  const size_t before = std::min(i, kNear), after = std::min(stamps_ns.size() - 1 - i, kNear);
  return 2 * earlier(i + 1, i + 1 + after) > after && 2 * earlier(i - before, i) >= before;
}

}  // namespace

std::vector<StampFault> JudgeStamps(const std::vector<int64_t>& stamps_ns) {
  std::vector<StampFault> faults(stamps_ns.size(), StampFault::kNone);
  if (stamps_ns.empty()) return faults;
  std::vector<int64_t> sorted = stamps_ns;
  const auto middle = sorted.begin() + static_cast<ptrdiff_t>(sorted.size() / 2);
  std::nth_element(sorted.begin(), middle, sorted.end());
  int64_t latest = std::numeric_limits<int64_t>::min() + kMaxReorderNs;
  for (size_t i = 0; i < stamps_ns.size(); ++i) {
    if (std::abs(stamps_ns[i] - *middle) > kMaxAstrayNs)
      faults[i] = StampFault::kAstray;
    else if (IsStampedAhead(stamps_ns, i))
      faults[i] = StampFault::kAhead;
    else if (stamps_ns[i] < latest - kMaxReorderNs)
      faults[i] = StampFault::kReversed;
    else
      latest = std::max(latest, stamps_ns[i]);
  }
  return faults;
}

bool SameValue(const PoseSample& a, const PoseSample& b) {
  return a.p_WM == b.p_WM && a.q_WM.coeffs() == b.q_WM.coeffs();
}
bool SameValue(const ImuSample& a, const ImuSample& b) { return a.value == b.value; }

}  // namespace imu_pose_calib
