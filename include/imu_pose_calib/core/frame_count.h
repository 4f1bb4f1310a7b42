#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace imu_pose_calib {

/// Numbers of the frames of samples that arrived in this order; the first is 0, each at least one
/// more than the one before. The latency of sample i, at t_i [s], is t_i - period frames_i.
struct FrameCount {
  std::vector<int64_t> frames;

  /// Samples before which frames are missing.
  size_t Jumps() const;
};

/// Period of a source [s] and the mean distance of its stamps from a line through a few of them, in
/// periods.
struct Period {
  double seconds = 0.0;
  double scatter = 0.0;
};

/// The period of at least 100 stamps [s], to about 1e-3; 0 when they hardly advance but for pauses.
Period FindPeriod(const std::vector<double>& t);

/// The same to about 1e-4, from one within 3e-3.
Period RefinePeriod(const std::vector<double>& t, const Period& period);

/// Counts frames. A frame is taken for missing where the stamps stay later for good.
FrameCount CountFrames(const std::vector<double>& t, const Period& period);

/// Counts them again by the distribution of the latencies [s] that the first count left about a
/// clock: stamps that were cut, or by time of arrival, have a sharp edge.
FrameCount CountAgain(const FrameCount& count,
                      const std::vector<double>& latency,
                      const Period& period);

}  // namespace imu_pose_calib
