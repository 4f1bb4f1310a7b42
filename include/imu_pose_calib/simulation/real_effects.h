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
};
std::mt19937 RandomOf(RandomEffect effect, uint32_t seed);

double Uniform(std::mt19937* random, double low, double high);
/// Normal per axis; leaves `random` alone when sigma is 0.
Eigen::Vector3d Gaussian(std::mt19937* random, double sigma);
/// Uniform direction.
Eigen::Vector3d RandomDirection(std::mt19937* random);

/// Samples of a recording at a rate.
size_t Count(double duration_s, double rate_hz);
/// Pose clock [s] at `s` after the first sample of the IMU.
double PoseTime(const SimulatorOptions& options, double s);

/// Values of `signal` at k / rate_hz [s] behind a first-order low-pass; cutoff_hz = 0: none.
std::vector<Eigen::Vector3d> Sampled(const std::function<Eigen::Vector3d(double)>& signal,
                                     double rate_hz, size_t count, double cutoff_hz);
/// Delay [s] of that low-pass at low frequencies.
double FilterDelay(double cutoff_hz);

/// RealEffects::mount_hz: `signal` behind a damped resonance, from 1 s before `begin` [s]; it
/// starts there with the force that the spring has at rest.
class Resonance {
 public:
  Resonance(const std::function<Eigen::Vector3d(double)>& signal, double resonance_hz, double begin,
            double end);
  Eigen::Vector3d At(double t) const;

 private:
  double begin_;
  std::vector<Eigen::Vector3d> values_;
};

/// Ornstein-Uhlenbeck process of 3 s.
std::vector<Eigen::Vector3d> SlowError(double sigma, double rate_hz, size_t count,
                                       std::mt19937 random);

/// RealEffects::pose_updates. Errors [m] of positions p_WM at rate_hz.
std::vector<Eigen::Vector3d> CarriedOn(double sigma, double rate_hz,
                                       const std::vector<Eigen::Vector3d>& p_WM,
                                       std::mt19937 random);

/// RealEffects::fused_poses_s: poses fused with the IMU by one who knows T_MI, the clocks and the
/// gyroscope's first bias. `data`: before samples are lost.
std::vector<PoseSample> FusedPoses(const SimulatorOptions& options, const SessionData& data);

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
