#pragma once

#include <algorithm>

namespace imu_pose_calib {

/// Where the parabola through a peak and its neighbours has its vertex, in steps beyond the peak.
inline double PeakOffset(double before, double peak, double after) {
  const double bend = 2.0 * peak - before - after;
  return bend > 0.0 ? std::clamp(0.5 * (after - before) / bend, -0.5, 0.5) : 0.0;
}

}  // namespace imu_pose_calib
