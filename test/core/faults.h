#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <random>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/base/types.h"

/// What goes wrong in recordings, done to good ones. Times [s] count from the first sample.
namespace imu_pose_calib {

/// Calls `change(sample)` for the samples in [begin_s, end_s).
template <typename Sample, typename Change>
void ChangeBetween(double begin_s, double end_s, std::vector<Sample>* samples, Change change) {
  const int64_t first_ns = samples->front().t_ns;
  for (Sample& s : *samples) {
    const double t = 1e-9 * static_cast<double>(s.t_ns - first_ns);
    if (t >= begin_s && t < end_s) change(&s);
  }
}

template <typename Sample>
void RemoveBetween(double begin_s, double end_s, std::vector<Sample>* samples) {
  const int64_t first_ns = samples->front().t_ns;
  const auto is_inside = [&](const Sample& s) {
    const double t = 1e-9 * static_cast<double>(s.t_ns - first_ns);
    return t >= begin_s && t < end_s;
  };
  samples->erase(std::remove_if(samples->begin(), samples->end(), is_inside), samples->end());
}

/// The tracker swaps labels: the marker's frame is turned on its body by q_MF.
inline void SwapLabels(double begin_s, double end_s, const Eigen::Quaterniond& q_MF,
                       SessionData* data) {
  ChangeBetween(begin_s, end_s, &data->poses, [&](PoseSample* s) { s->q_WM = s->q_WM * q_MF; });
}

/// The tracker repeats its last pose.
inline void Freeze(double begin_s, double end_s, SessionData* data) {
  PoseSample last = data->poses.front();
  ChangeBetween(0.0, begin_s, &data->poses, [&](PoseSample* s) { last = *s; });
  ChangeBetween(begin_s, end_s, &data->poses, [&](PoseSample* s) {
    s->p_WM = last.p_WM;
    s->q_WM = last.q_WM;
  });
}

/// A share of the poses is off by 10 cm and 20 degrees in any direction.
inline void AddOutliers(double share, uint32_t seed, SessionData* data) {
  std::mt19937 random(seed);
  std::normal_distribution<double> normal;
  const auto direction = [&] {
    return Eigen::Vector3d(normal(random), normal(random), normal(random)).normalized();
  };
  for (PoseSample& s : data->poses) {
    if (std::uniform_real_distribution<double>()(random) >= share) continue;
    s.p_WM += 0.1 * direction();
    s.q_WM = s.q_WM * Exp<double>(M_PI / 9.0 * direction());
  }
}

/// A share of the samples is lost, in bursts of ten.
inline void LosePackets(double share, uint32_t seed, std::vector<ImuSample>* samples) {
  std::mt19937 random(seed);
  std::vector<ImuSample> kept;
  for (size_t i = 0; i < samples->size(); i += 10) {
    if (std::uniform_real_distribution<double>()(random) < share) continue;
    kept.insert(kept.end(), samples->begin() + static_cast<std::ptrdiff_t>(i),
                samples->begin() + static_cast<std::ptrdiff_t>(std::min(i + 10, samples->size())));
  }
  *samples = kept;
}

/// The sensor ends at +-limit.
inline void Clip(double limit, std::vector<ImuSample>* samples) {
  for (ImuSample& s : *samples) s.value = s.value.cwiseMax(-limit).cwiseMin(limit);
}

/// The IMU's clock runs slow by `ppm`: t_pose = (1 + 1e-6 ppm) t_imu + const.
inline void Drift(double ppm, ImuData* imu) {
  for (std::vector<ImuSample>* samples : {&imu->gyro, &imu->accel}) {
    const int64_t first_ns = samples->front().t_ns;
    for (ImuSample& s : *samples)
      s.t_ns -= std::llround(1e-6 * ppm * static_cast<double>(s.t_ns - first_ns));
  }
}

}  // namespace imu_pose_calib
