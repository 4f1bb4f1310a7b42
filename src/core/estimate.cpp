#include "imu_pose_calib/core/estimate.h"

#include <algorithm>
#include <cmath>

namespace imu_pose_calib {

BiasKnots::BiasKnots(const std::vector<TimedSample>& samples,
                     double interval_s,
                     const Eigen::Vector3d& initial) {
  if (interval_s == 0.0) {
    for (const TimedSample& s : samples) t.push_back(s.t);
  } else {
    const double duration = samples.back().t - samples.front().t;
    const int intervals = std::max(1, static_cast<int>(std::ceil(duration / interval_s)));
    for (int k = 0; k <= intervals; ++k) t.push_back(samples.front().t + duration * k / intervals);
  }
  values.assign(t.size(), initial);
}

std::pair<size_t, double> BiasKnots::Locate(double time) const {
  const auto after = std::upper_bound(t.begin() + 1, t.end() - 1, time);
  const auto k = static_cast<size_t>(after - t.begin()) - 1;
  return {k, std::clamp((time - t[k]) / (t[k + 1] - t[k]), 0.0, 1.0)};
}

Eigen::Vector3d BiasKnots::Mean() const {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  for (const Eigen::Vector3d& v : values) sum += v;
  return sum / static_cast<double>(values.size());
}

Estimate::Estimate(const Start& start, const ConditionedData& data, double bias_knot_interval_s)
    : time_shift(start.time_shift),
      accel_delay(start.accel_delay),
      clock_reference(0.5 * (data.gyro.front().t + data.gyro.back().t)),
      q_MI(start.q_MI),
      p_MI(start.p_MI),
      g_W(start.g_W),
      gyro_bias(data.gyro, bias_knot_interval_s, start.gyro_bias),
      accel_bias(data.accel, bias_knot_interval_s, start.accel_bias) {}

}  // namespace imu_pose_calib
