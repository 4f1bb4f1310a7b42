#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <functional>
#include <random>
#include <vector>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// What happens to the stamps of a stream, and to its samples on the way. 0: nothing.
struct StreamEffects {
  double wander_s = 0.0;      ///< [s] amplitude of a sine of a minute that the clock runs ahead by
  double clock_step_s = 0.0;  ///< [s] by which it jumps ahead after 45 % of the recording
  double jitter_s = 0.0;      ///< [s] sigma of the stamps
  double latency_s = 0.0;     ///< [s] mean of the exponential delay at which samples are stamped
  double burst = 0.0;         ///< samples that are stamped together, when the last of them is there
  double step_s = 0.0;        ///< [s] stamps are cut to multiples of it
  double drops = 0.0;         ///< [%] of the samples that are missing, at random
};

/// What recordings have beyond white noise and wandering biases, each by its strength. 0: not
/// there.
struct RealEffects {
  // --- True motion of the body, of which poses and IMU both tell ---

  /// [m/s^2] rms per axis from 20 to 80 Hz, and as much turning as gives that 0.2 m off.
  double vibration = 0.0;
  double rocking = 0.0;  ///< [rad/s] rms per axis from 20 to 80 Hz, about a point 0.2 m off
  /// [m/s^2] peak of jolts of some 20 ms, 30 a minute, and as much turning as gives that 0.2 m off.
  double shocks = 0.0;

  double gravity = 0.0;  ///< [m/s^2] by which it is stronger than SimulatorOptions::g_W

  // --- IMU ---

  /// [Hz] cutoff of a first-order low-pass before the noise, which delays by 1 / (2 pi cutoff).
  double gyro_filter_hz = 0.0, accel_filter_hz = 0.0;
  /// Sigma of the elements of both matrices less the identity; the gyroscope's are drawn below the
  /// diagonal only, so that I is defined by its axes.
  double scale_misalignment = 0.0;
  /// [m] largest distance per axis of I between the axes of the accelerometer. I's origin has the x
  /// of the middle of y and z, which is where turning accelerates along x, and so on.
  double size_effect = 0.0;
  double g_sensitivity = 0.0;  ///< [rad/s per m/s^2] sigma of gyroscope by specific force
  /// [rad/s] change of the gyroscope's bias by warming up, within minutes; of the accelerometer's
  /// ten times as much [m/s^2].
  double temperature_drift = 0.0;

  // --- Source of the poses ---

  double pose_scale = 0.0;  ///< by how much it exaggerates positions
  /// [m] sigma per axis of errors that last for some 3 s; of the rotation as much [rad].
  double slow_errors = 0.0;
  /// [m] from the centroid of the markers to M's origin, which errors of rotation move along.
  double marker_offset = 0.0;
  /// [s] poses are fused with the IMU: positions are means over this time, rotations means of those
  /// that the gyroscope carries here from then.
  double fused_poses_s = 0.0;

  /// [m] sigma of a tracker's positions, 20 a second, by which a filter corrects the poses that it
  /// carries on with an IMU whose accelerometer's scale is off by 0.5 %; poses have no other noise.
  double pose_updates = 0.0;

  StreamEffects pose_stream, imu_stream;
};

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

/// Normal per axis; leaves `random` alone when sigma is 0.
Eigen::Vector3d Gaussian(std::mt19937* random, double sigma);
/// Uniform direction.
Eigen::Vector3d RandomDirection(std::mt19937* random);

/// Values of `signal` at k / rate_hz [s] behind a first-order low-pass; cutoff_hz = 0: none.
std::vector<Eigen::Vector3d> Sampled(const std::function<Eigen::Vector3d(double)>& signal,
                                     double rate_hz, size_t count, double cutoff_hz);
/// Delay [s] of that low-pass at low frequencies.
double FilterDelay(double cutoff_hz);

/// Ornstein-Uhlenbeck process of 3 s.
std::vector<Eigen::Vector3d> SlowError(double sigma, double rate_hz, size_t count,
                                       std::mt19937 random);

/// RealEffects::pose_updates. Errors [m] of positions p_WM at rate_hz.
std::vector<Eigen::Vector3d> CarriedOn(double sigma, double rate_hz,
                                       const std::vector<Eigen::Vector3d>& p_WM,
                                       std::mt19937 random);

/// RealEffects::fused_poses_s. `t` [s] of the poses and of the turn rates omega_M, in one clock.
std::vector<PoseSample> Fused(const std::vector<PoseSample>& poses,
                              const std::vector<double>& t_pose,
                              const std::vector<Eigen::Vector3d>& omega_M,
                              const std::vector<double>& t_omega, double span_s);

/// Stamps of samples that are taken at first_ns + 1e9 k / rate_hz. They never go back.
std::vector<int64_t> Stamps(int64_t first_ns, double rate_hz, size_t count,
                            const StreamEffects& effects, std::mt19937 random);
/// [s] by how much these stamps are late, on average.
double MeanLateness(const std::vector<int64_t>& stamps, int64_t first_ns, double rate_hz);

/// Gives the samples their stamps and leaves some of them out.
template <typename Sample>
void Deliver(const std::vector<int64_t>& stamps, double drops_percent, std::mt19937 random,
             std::vector<Sample>* samples) {
  std::bernoulli_distribution is_lost(0.01 * drops_percent);
  std::vector<Sample> delivered;
  for (size_t k = 0; k < samples->size(); ++k) {
    (*samples)[k].t_ns = stamps[k];
    if (!is_lost(random)) delivered.push_back((*samples)[k]);
  }
  samples->swap(delivered);
}

}  // namespace imu_pose_calib
