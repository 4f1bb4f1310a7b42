#pragma once

#include <Eigen/Core>
#include <cmath>
#include <cstdint>
#include <functional>
#include <random>
#include <vector>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/simulation/simulator_options.h"

namespace imu_pose_calib {

/// Random numbers of their own for each effect, so that it is the same whatever others there are.
enum class RandomEffect : uint32_t {
  kVibration,
  kRocking,
  kShocks,
  kIntrinsics,
  kSizeEffect,
  kGSensitivity,
  kTemperature,
  kSlowErrors,
  kMarkerOffset,
  kPoseStamps,
  kImuStamps,
  kPoseDrops,
  kImuDrops,
  kPoseUpdates,
  kPoseDrift,
};
std::mt19937 RandomOf(RandomEffect effect, uint32_t seed);

double Uniform(std::mt19937* random, double low, double high);
/// Normal per axis; leaves `random` alone when sigma is 0.
Eigen::Vector3d Gaussian(std::mt19937* random, double sigma);
/// Uniform direction.
Eigen::Vector3d RandomDirection(std::mt19937* random);

/// Samples of a recording at a rate.
size_t Count(double duration_s, double rate_hz);

/// Values of `signal` at k / rate_hz [s] behind a first-order low-pass; cutoff_hz = 0: none.
std::vector<Eigen::Vector3d> Sampled(const std::function<Eigen::Vector3d(double)>& signal,
                                     double rate_hz, size_t count, double cutoff_hz);
/// Delay [s] of that low-pass at low frequencies.
double FilterDelay(double cutoff_hz);

/// [s] by which the clock of a stream is ahead, `t` [s] after the first sample.
double Ahead(const StreamEffects& effects, double t, double duration_s);

/// Samples that are taken at first_ns + 1e9 k / rate_hz, on their way to the recording.
struct Stream {
  const StreamEffects& effects;
  int64_t first_ns;
  double rate_hz, duration_s;
  std::mt19937 stamp_random, drop_random;

  /// Stamps by a clock that is never ahead. They never go back.
  std::vector<int64_t> Stamps() const;
  /// [s] by how much these are late, on average.
  double MeanLateness() const;

  /// Gives the samples their stamps and leaves some of them out.
  template <typename Sample>
  void Deliver(std::vector<Sample>* samples) const {
    const std::vector<int64_t> stamps = Stamps();
    std::mt19937 random = drop_random;
    std::bernoulli_distribution is_lost(0.01 * effects.drops);
    std::vector<Sample> delivered;
    for (size_t k = 0; k < samples->size(); ++k) {
      if (is_lost(random)) continue;
      delivered.push_back((*samples)[k]);
      const double t = 1e-9 * static_cast<double>(stamps[k] - first_ns);
      delivered.back().t_ns = stamps[k] + std::llround(1e9 * Ahead(effects, t, duration_s));
    }
    samples->swap(delivered);
  }
};

}  // namespace imu_pose_calib
