#pragma once

/// Room simulation: recordings with exact truth, for tests, simulate_bag and evaluate.
/// In: options and effects that real recordings have. Out: SessionData, the truth, the Cramér-Rao
/// bound of what can be known; and how information grows within a recording, for the report.
/// Calibrate() needs none of it.

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <cstdint>
#include <functional>
#include <vector>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/simulation/real_effects.h"

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

/// All motions, in order.
constexpr Motion kMotions[] = {Motion::kHandheld, Motion::kTumble, Motion::kArm,   Motion::kDrone,
                               Motion::kPlanar,   Motion::kHinge,  Motion::kStatic};

/// "handheld", "tumble", ...
const char* ToString(Motion motion);

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

  int64_t start_ns = 1'600'000'000'000'000'000;  ///< first pose stamp

  RealEffects effects;  ///< those of motion and poses follow from `seed`
};

/// What an effect is called.
struct EffectName {
  const char *name, *unit, *text;
};
/// How strong it is.
struct EffectRange {
  double usual;        ///< that recordings have
  double least, most;  ///< that make sense
};
/// An effect that one number switches on.
struct EffectOption : EffectName, EffectRange {
  double& (*strength)(SimulatorOptions* options);
};

/// All effects that recordings usually have.
const std::vector<EffectOption>& EffectOptions();

/// Exact kinematics of the marker at one instant.
struct TrueState {
  Eigen::Matrix3d R_WM;
  Eigen::Vector3d p_WM;     ///< [m]
  Eigen::Vector3d v_W;      ///< [m/s]
  Eigen::Vector3d a_W;      ///< [m/s^2]
  Eigen::Vector3d omega_M;  ///< [rad/s]
  Eigen::Vector3d alpha_M;  ///< [rad/s^2]
};

/// Closed-form trajectory: a smooth motion, and what shakes the body on top of it.
class TrueTrajectory {
 public:
  explicit TrueTrajectory(const SimulatorOptions& options);
  /// State `t` [s] after the first pose.
  TrueState At(double t) const;

 private:
  /// Vector over time [s]: its value (0), first (1) or second (2) derivative.
  using Curve = std::function<Eigen::Vector3d(double t, int derivative)>;
  /// On top of a motion: M turns by Exp(turn) about a point of the body, then moves by `shift`.
  struct Shake {
    Curve shift_W, turn_M;
    Eigen::Vector3d pivot_M;
  };
  void AddShakes(const SimulatorOptions& options);

  Curve position_, rotation_;
  Eigen::Quaterniond q_WB_ = Eigen::Quaterniond::Identity();  ///< mean attitude
  Eigen::Vector3d spin_ = Eigen::Vector3d::Zero();            ///< [rad/s] steady turn
  std::vector<Shake> shakes_;
};

/// What a calibration should find: `time_shift_s` and `accel_delay_s` with the delays of the
/// sensors' filters and the mean lateness of the stamps.
struct TrueClock {
  double time_shift_s, accel_delay_s;

  explicit TrueClock(const SimulatorOptions& options);
};

/// [s] by how much the offset of the clocks exceeds a line, `t` [s] after the first sample.
double Wander(const SimulatorOptions& options, double t);

/// Poses and IMU samples of `options`; the same options give the same data.
SessionData Simulate(const SimulatorOptions& options);

/// IMU number `imu` on the body of `first`, which is number 0: 0.2 m further along x each, turned,
/// and with a clock, a delay and noise of its own.
SimulatorOptions FurtherImu(SimulatorOptions first, size_t imu);

/// Poses and the samples of several IMUs.
SessionData Simulate(const SimulatorOptions& options, size_t imus);

}  // namespace imu_pose_calib
