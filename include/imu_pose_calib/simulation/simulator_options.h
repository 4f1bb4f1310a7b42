#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <cmath>
#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// Shape of a simulated motion.
enum class Motion {
  kHandheld,  ///< swings of about 0.6 rad and 0.2 m on all six axes
  kTumble,    ///< many full turns about a wandering axis
  kArm,       ///< moves of about 1 rad and 0.3 m from rest to rest, in 1.5 to 3 s each
  kDrone,   ///< hovers: tilts of 0.1 to 0.2 rad at 0.5 to 3 Hz push it aside; turns slowly about z
  kPlanar,  ///< turns about W's z and moves in its xy plane only: p_MI along z is undetermined
  kHinge,   ///< turns about one fixed tilted axis, without moving
  kStatic,  ///< rests
};

/// All of them with their names, in order.
constexpr std::pair<Motion, const char*> kMotions[] = {
    {Motion::kHandheld, "handheld"}, {Motion::kTumble, "tumble"}, {Motion::kArm, "arm"},
    {Motion::kDrone, "drone"},       {Motion::kPlanar, "planar"}, {Motion::kHinge, "hinge"},
    {Motion::kStatic, "static"}};
inline const char* ToString(Motion motion) { return kMotions[static_cast<int>(motion)].second; }
/// Throws InputError when there is none of that name.
Motion ParseMotion(const std::string& name);

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
/// there. Effects() says more of each, and how strong it usually is.
struct RealEffects {
  // --- True motion of the body, of which poses and IMU both tell ---

  /// [m/s^2] rms per axis from 20 to 80 Hz, and as much turning as gives that 0.2 m off.
  double vibration = 0.0;
  double rocking = 0.0;  ///< [rad/s] rms per axis from 20 to 80 Hz, about a point 0.2 m off
  double shocks = 0.0;   ///< [m/s^2] peak of jolts of some 20 ms, which turn the body the same way
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
  /// [Hz] resonance of the spring that holds the IMU, which moves but does not turn, with a damping
  /// ratio of 0.2. T_MI is where it is without load.
  double mount_hz = 0.0;
  double g_sensitivity = 0.0;      ///< [rad/s per m/s^2] sigma of gyroscope by specific force
  double temperature_drift = 0.0;  ///< [rad/s] of the gyroscope, ten times [m/s^2] of the other

  // --- Source of the poses ---

  double pose_scale = 0.0;   ///< by how much it exaggerates positions
  double slow_errors = 0.0;  ///< [m] sigma per axis; of the rotation as much [rad]
  /// [m] from the centroid of the markers to M's origin, which errors of rotation move along.
  double marker_offset = 0.0;
  /// [s] poses are fused with the IMU: positions are means over this time, rotations means of those
  /// that the gyroscope carries here from then.
  double fused_poses_s = 0.0;
  /// [m] sigma of a tracker's positions, 20 a second, by which a filter corrects the poses that it
  /// carries on with an IMU whose accelerometer's scale is off by 0.5 %; poses have no other noise.
  double pose_updates = 0.0;
  double pose_drift = 0.0;  ///< [m] sigma per axis after 1 m of way, as of odometry; a tenth [rad]

  StreamEffects pose_stream, imu_stream;
};

/// A further source of poses on the body: T_VS with noise, a clock and a world of its own.
struct SimulatedPoseSensor {
  double rate_hz = 30.0;
  double position_std = 5e-3;  ///< [m] per axis
  double rotation_std = 5e-3;  ///< [rad] per axis
  double outliers = 0.0;       ///< share of its poses that are off by some 0.1 m and 0.3 rad
  Rigid3 T_MS{Eigen::Quaterniond(0.3, 0.5, -0.7, 0.4).normalized(), {0.1, -0.05, 0.15}};
  Rigid3 T_VW{Eigen::Quaterniond(0.8, 0.2, 0.5, -0.3).normalized(), {1.0, -2.0, 0.5}};
  double scale = 1.0;          ///< of its positions
  double time_shift_s = 0.03;  ///< t_pose = t_sensor + time_shift_s
  double clock_drift = 0.0;    ///< [s/s] growth of it, about mid-recording
  double drift = 0.0;          ///< [m] sigma per axis of V's walk after 1 m; a tenth of it [rad]
  int jumps = 0;               ///< of V by 0.2 m and 0.1 rad, evenly over the recording
};

/// A recording to simulate: truth, sensors and clocks.
struct SimulatorOptions {
  Motion motion = Motion::kHandheld;
  double duration_s = 40.0;
  uint32_t seed = 1;        ///< motion, noise and biases follow from it
  uint32_t noise_seed = 0;  ///< noise and biases follow from this one unless it is 0

  double pose_rate_hz = 100.0;
  double gyro_rate_hz = 200.0;
  double accel_rate_hz = 200.0;

  double pose_exposure_s = 0.0;   ///< [s] time around its stamp over which a pose is the mean
  double position_std = 1e-3;     ///< [m] per axis
  double rotation_std = 1e-3;     ///< [rad] per axis
  double gyro_std = 5e-3;         ///< [rad/s] per sample
  double accel_std = 2e-2;        ///< [m/s^2] per sample
  double gyro_bias_walk = 1e-5;   ///< [rad/s^2/sqrt(Hz)]
  double accel_bias_walk = 1e-4;  ///< [m/s^3/sqrt(Hz)]

  Rigid3 T_MI{Eigen::Quaterniond(0.5, -0.5, 0.5, 0.5), Eigen::Vector3d(0.05, -0.03, 0.08)};
  double time_shift_s = 0.02;  ///< t_pose = t_imu + time_shift_s
  double accel_delay_s = 0.0;  ///< t_pose = t_accel + time_shift_s - accel_delay_s
  double clock_drift = 0.0;    ///< [s/s] growth of the time shift, which holds at mid-recording
  Eigen::Matrix3d gyro_matrix = Eigen::Matrix3d::Identity();  ///< measured = matrix true + bias
  Eigen::Matrix3d accel_matrix = Eigen::Matrix3d::Identity();
  Eigen::Vector3d g_W{0.0, 0.0, -9.80665};          ///< [m/s^2]
  Eigen::Vector3d gyro_bias{0.004, -0.003, 0.005};  ///< [rad/s] at the start
  Eigen::Vector3d accel_bias{0.03, 0.05, -0.04};    ///< [m/s^2] at the start

  std::vector<SimulatedPoseSensor> pose_sensors;

  int64_t start_ns = 1'600'000'000'000'000'000;  ///< first pose stamp

  RealEffects effects;  ///< those of motion and poses follow from `seed`

  /// First stamp of the IMU [ns].
  int64_t ImuStart() const { return start_ns - std::llround(1e9 * time_shift_s); }
  /// Pose clock [s] at `s` after the first sample of the IMU.
  double PoseTime(double s) const { return s + clock_drift * (s - 0.5 * duration_s); }
};

/// An effect of real recordings that one number switches on.
struct Effect {
  const char* name;
  double* strength;
  double usual, least, most;  ///< strength that recordings have, and bounds that make sense
  const char *unit, *text;
};

/// All effects that recordings usually have, with their strengths in `options`.
std::vector<Effect> Effects(SimulatorOptions* options);

}  // namespace imu_pose_calib
