#include "imu_pose_calib/simulation/simulator.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <optional>
#include <random>
#include <utility>

#include "imu_pose_calib/core/base/so3.h"

namespace imu_pose_calib {
namespace {

constexpr double kWarmUp = 120.0;      // [s]
constexpr double kAccelWarmUp = 10.0;  // [m/s^2] of the accelerometer's bias per rad/s of the other

using Eigen::Quaterniond;
using Eigen::Vector3d;
using Signal = std::function<Vector3d(double)>;  // of time [s]

constexpr double kSlowErrorTime = 3.0;   // [s]
constexpr double kDampingRatio = 0.2;    // of a mount
constexpr double kResonanceStep = 5e-4;  // [s]
// Of a filter that carries poses on: updates a second [Hz], scale error of its accelerometer, gains
// of an update [1, 1/s].
constexpr double kUpdateRate = 20.0, kCarriedScale = 0.005, kPositionGain = 0.2,
                 kVelocityGain = 0.4;
constexpr double kFusedReach = 3.0;  // of the sigma of its weights

/// Seed of the IMU's noise.
uint32_t ImuSeed(const SimulatorOptions& options) {
  return options.noise_seed == 0 ? options.seed : options.noise_seed;
}

Stream PoseStream(const SimulatorOptions& options) {
  return {options.effects.pose_stream,
          options.start_ns,
          options.pose_rate_hz,
          options.duration_s,
          RandomOf(RandomEffect::kPoseStamps, options.seed),
          RandomOf(RandomEffect::kPoseDrops, options.seed)};
}

/// The same for gyroscope and accelerometer at the same rate: they come in one message.
Stream ImuStream(const SimulatorOptions& options, double rate_hz) {
  return {options.effects.imu_stream,
          options.ImuStart(),
          rate_hz,
          options.duration_s,
          RandomOf(RandomEffect::kImuStamps, ImuSeed(options)),
          RandomOf(RandomEffect::kImuDrops, ImuSeed(options))};
}

/// RealEffects::mount_hz: `signal` behind a damped resonance, from 1 s before `begin` to `end` [s];
/// it starts there with the force that the spring has at rest.
Signal Resonating(const Signal& signal, double resonance_hz, double begin, double end) {
  // u'' = -x - omega^2 u - 2 zeta omega u' is how the IMU moves beside its place, for an x that is
  // linear from one step to the next; it feels x + u''. Fourth-order Runge-Kutta.
  const double omega = 2.0 * M_PI * resonance_hz, h = kResonanceStep;
  const auto felt = [&](const Vector3d& u, const Vector3d& v) -> Vector3d {
    return -omega * omega * u - 2.0 * kDampingRatio * omega * v;
  };
  begin -= 1.0;
  std::vector<Vector3d> values;
  Vector3d x = signal(begin), u = -x / (omega * omega), v = Vector3d::Zero();
  for (size_t k = 0; begin + static_cast<double>(k) * h <= end + h; ++k) {
    values.push_back(felt(u, v));
    const Vector3d next = signal(begin + static_cast<double>(k + 1) * h), mean = 0.5 * (x + next);
    const Vector3d v1 = v, a1 = felt(u, v) - x;
    const Vector3d v2 = v + 0.5 * h * a1, a2 = felt(u + 0.5 * h * v1, v2) - mean;
    const Vector3d v3 = v + 0.5 * h * a2, a3 = felt(u + 0.5 * h * v2, v3) - mean;
    const Vector3d v4 = v + h * a3, a4 = felt(u + h * v3, v4) - next;
    u += h / 6.0 * (v1 + 2.0 * v2 + 2.0 * v3 + v4);
    v += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4);
    x = next;
  }
  return [=](double t) -> Vector3d {
    const double place =
        std::clamp((t - begin) / h, 0.0, static_cast<double>(values.size()) - 1.001);
    const auto k = static_cast<size_t>(place);
    return values[k] + (place - static_cast<double>(k)) * (values[k + 1] - values[k]);
  };
}

/// Ornstein-Uhlenbeck process of 3 s.
std::vector<Vector3d> SlowError(double sigma, double rate_hz, size_t count, std::mt19937 random) {
  const double kept = std::exp(-1.0 / (rate_hz * kSlowErrorTime));
  std::vector<Vector3d> errors(count);
  for (size_t k = 0; k < count; ++k)
    errors[k] = k == 0 ? Gaussian(&random, sigma)
                       : Vector3d(kept * errors[k - 1] +
                                  Gaussian(&random, sigma * std::sqrt(1.0 - kept * kept)));
  return errors;
}

/// RealEffects::pose_updates: gives its errors to exact positions at rate_hz.
void CarryOn(double sigma, double rate_hz, std::mt19937 random, std::vector<PoseSample>* poses) {
  const std::vector<PoseSample> exact = *poses;
  const double h = 1.0 / rate_hz;
  int64_t update = -1;
  Vector3d error = Vector3d::Zero(), velocity = error;
  for (size_t k = 0; k < exact.size(); ++k) {
    if (k >= 2) {
      const Vector3d acceleration =
          (exact[k].p_WM - 2.0 * exact[k - 1].p_WM + exact[k - 2].p_WM) / (h * h);
      velocity += kCarriedScale * h * acceleration;
      error += h * velocity;
    }
    if (const auto next = static_cast<int64_t>(static_cast<double>(k) * kUpdateRate / rate_hz);
        std::exchange(update, next) != next) {
      const Vector3d innovation = Gaussian(&random, sigma) - error;
      error += kPositionGain * innovation;
      velocity += kVelocityGain * innovation;
    }
    (*poses)[k].p_WM += error;
  }
}

/// Rotations at the instants [s] since the first rate, which changes linearly from one to the next.
std::vector<Quaterniond> TurnsSinceStart(const std::vector<Vector3d>& omega,
                                         const std::vector<double>& t,
                                         const std::vector<double>& instants) {
  std::vector<Quaterniond> turns, q(1, Quaterniond::Identity());
  const auto from = [&](size_t k, double until) -> Quaterniond {
    const double h = until - t[k], share = h / (t[k + 1] - t[k]);
    return q[k] * Exp<double>(h * (omega[k] + 0.5 * share * (omega[k + 1] - omega[k])));
  };
  for (size_t k = 0; k + 1 < t.size(); ++k) q.push_back(from(k, t[k + 1]));
  for (const double instant : instants) {
    const auto after = std::upper_bound(t.begin() + 1, t.end() - 1, instant);
    turns.push_back(from(static_cast<size_t>(after - t.begin()) - 1, instant));
  }
  return turns;
}

/// RealEffects::fused_poses_s: poses fused with the IMU by one who knows T_MI, the clocks and the
/// gyroscope's first bias. `data`: before samples are lost.
std::vector<PoseSample> FusedPoses(const SimulatorOptions& options, const SessionData& data) {
  std::vector<double> t_pose, t_omega;
  std::vector<Vector3d> omega_M;
  const double delay = FilterDelay(options.effects.gyro_filter_hz);
  for (size_t k = 0; k < data.imus[0].gyro.size(); ++k) {
    t_omega.push_back(options.PoseTime(static_cast<double>(k) / options.gyro_rate_hz - delay));
    omega_M.push_back(options.T_MI.q * (data.imus[0].gyro[k].value - options.gyro_bias));
  }
  for (size_t k = 0; k < data.poses.size(); ++k)
    t_pose.push_back(static_cast<double>(k) / options.pose_rate_hz);
  const std::vector<Quaterniond> turns = TurnsSinceStart(omega_M, t_omega, t_pose);
  std::vector<Quaterniond> start;  // each rotation, carried to the start
  for (size_t k = 0; k < data.poses.size(); ++k)
    start.push_back(data.poses[k].q_WM * turns[k].conjugate());

  const double sigma = options.effects.fused_poses_s / std::sqrt(12.0);  // that of a mean
  std::vector<PoseSample> fused = data.poses;
  size_t begin = 0;
  for (size_t k = 0; k < fused.size(); ++k) {
    while (t_pose[begin] < t_pose[k] - kFusedReach * sigma) ++begin;
    double sum = 0.0;
    Vector3d p = Vector3d::Zero(), r = Vector3d::Zero();
    for (size_t j = begin; j < fused.size() && t_pose[j] <= t_pose[k] + kFusedReach * sigma; ++j) {
      const double distance = (t_pose[j] - t_pose[k]) / sigma;
      const double weight = std::exp(-0.5 * distance * distance);
      sum += weight;
      p += weight * data.poses[j].p_WM;
      r += weight * Log(Quaterniond(start[k].conjugate() * start[j]));
    }
    fused[k].p_WM = p / sum;
    fused[k].q_WM = start[k] * Exp<double>(r / sum) * turns[k];
  }
  return fused;
}

/// Brownian bias: steps of `walk` sqrt(period). `warm_up`: its change as the sensor gets warm.
std::vector<ImuSample> SampleSensor(const std::vector<Vector3d>& exact, double rate_hz,
                                    double noise, double walk, Vector3d bias,
                                    const Vector3d& warm_up, std::mt19937* random) {
  std::vector<ImuSample> samples(exact.size());
  for (size_t k = 0; k < exact.size(); ++k) {
    const double warmth = -std::expm1(-static_cast<double>(k) / (rate_hz * kWarmUp));
    samples[k].value = exact[k] + bias + Gaussian(random, noise) + warmth * warm_up;
    bias += Gaussian(random, walk / std::sqrt(rate_hz));
  }
  return samples;
}

/// Mean of the pose from t - exposure_s / 2 to t + exposure_s / 2: Gauss-Legendre, three points.
Rigid3 MeanPose(const TrueTrajectory& trajectory, double t, double exposure_s) {
  const TrueState middle = trajectory.At(t);
  if (exposure_s == 0.0) return {Quaterniond(middle.R_WM), middle.p_WM};
  Vector3d p = 8.0 / 18.0 * middle.p_WM, turn = Vector3d::Zero();
  for (const double side : {-0.5, 0.5}) {
    const TrueState state = trajectory.At(t + side * std::sqrt(0.6) * exposure_s);
    p += 5.0 / 18.0 * state.p_WM;
    turn += 5.0 / 18.0 * Log(Quaterniond(middle.R_WM.transpose() * state.R_WM));
  }
  return {Quaterniond(middle.R_WM) * Exp(turn), p};
}

/// A frame V that drifts along the way of what is seen in it, by a walk: after 1 m it is off by
/// `drift` metres per axis (sigma) and a tenth of that in rad, after n metres by sqrt(n) times
/// that.
struct DriftingFrame {
  double drift;
  Rigid3 T_VW;
  std::optional<Vector3d> last;  ///< [m] in W

  /// On to the next place, about which V also moves by so much.
  void MoveTo(const Vector3d& p_W, Vector3d shift, Vector3d turn, std::mt19937* random) {
    const double way = last ? (p_W - *last).norm() : 0.0;
    last = p_W;
    shift += Gaussian(random, drift * std::sqrt(way));
    turn += Gaussian(random, 0.1 * drift * std::sqrt(way));
    const Vector3d p_V = T_VW.q * p_W + T_VW.p;
    T_VW.q = Exp<double>(turn) * T_VW.q;
    T_VW.p = p_V + shift - T_VW.q * p_W;
  }
};

std::vector<PoseSample> Poses(const SimulatorOptions& options, const TrueTrajectory& trajectory,
                              std::mt19937* random) {
  const RealEffects& effects = options.effects;
  const size_t count = Count(options.duration_s, options.pose_rate_hz);
  std::mt19937 slow = RandomOf(RandomEffect::kSlowErrors, options.seed);
  const auto slow_error = [&] {
    return SlowError(effects.slow_errors, options.pose_rate_hz, count, std::mt19937(slow()));
  };
  const std::vector<Vector3d> slow_p = slow_error(), slow_r = slow_error();
  std::mt19937 direction = RandomOf(RandomEffect::kMarkerOffset, options.seed);
  const Vector3d origin_M = effects.marker_offset * RandomDirection(&direction);

  DriftingFrame frame{effects.pose_drift, {}, {}};
  std::mt19937 drift = RandomOf(RandomEffect::kPoseDrift, options.seed);

  const bool is_carried_on = effects.pose_updates > 0.0;
  const double noise = is_carried_on ? 0.0 : 1.0;

  std::vector<PoseSample> poses(count);
  for (size_t k = 0; k < count; ++k) {
    const double t = static_cast<double>(k) / options.pose_rate_hz;
    const Rigid3 mean = MeanPose(trajectory, t, options.pose_exposure_s);
    const Quaterniond error =
        Exp<double>(noise * Gaussian(random, options.rotation_std) + slow_r[k]);
    poses[k].q_WM = mean.q * error;
    poses[k].p_WM = (1.0 + effects.pose_scale) * mean.p +
                    noise * Gaussian(random, options.position_std) + slow_p[k] +
                    mean.q * (error * origin_M - origin_M);
    frame.MoveTo(mean.p, Vector3d::Zero(), Vector3d::Zero(), &drift);
    poses[k].q_WM = frame.T_VW.q * poses[k].q_WM;
    poses[k].p_WM = frame.T_VW.q * poses[k].p_WM + frame.T_VW.p;
  }
  if (is_carried_on)
    CarryOn(effects.pose_updates, options.pose_rate_hz,
            RandomOf(RandomEffect::kPoseUpdates, options.seed), &poses);
  return poses;
}

/// What one IMU does to the truth, beside filters, noise and delays.
struct Flaws {
  Eigen::Matrix3d gyro_matrix, accel_matrix, g_sensitivity;
  Eigen::Matrix3d axes_I;  ///< [m] column i: where the accelerometer's axis i is
  Vector3d gyro_warm_up, accel_warm_up;

  explicit Flaws(const SimulatorOptions& options) {
    const RealEffects& effects = options.effects;
    const auto random_of = [&](RandomEffect effect) { return RandomOf(effect, ImuSeed(options)); };
    const auto matrix = [](double sigma, std::mt19937* random) {
      Eigen::Matrix3d m;
      for (int i = 0; i < 3; ++i) m.row(i) = Gaussian(random, sigma);
      return m;
    };
    std::mt19937 random = random_of(RandomEffect::kIntrinsics);
    const Eigen::Matrix3d I = Eigen::Matrix3d::Identity();
    const Eigen::Matrix3d gyro = matrix(effects.scale_misalignment, &random);
    gyro_matrix = options.gyro_matrix * (I + Eigen::Matrix3d(gyro.triangularView<Eigen::Lower>()));
    accel_matrix = options.accel_matrix * (I + matrix(effects.scale_misalignment, &random));
    random = random_of(RandomEffect::kGSensitivity);
    g_sensitivity = matrix(effects.g_sensitivity, &random);
    random = random_of(RandomEffect::kSizeEffect);
    for (int i = 0; i < 9; ++i) axes_I(i) = effects.size_effect * Uniform(&random, -0.5, 0.5);
    for (int i = 0; i < 3; ++i) axes_I.row(i).array() -= 0.5 * (axes_I.row(i).sum() - axes_I(i, i));
    random = random_of(RandomEffect::kTemperature);
    gyro_warm_up = effects.temperature_drift * RandomDirection(&random);
    accel_warm_up = kAccelWarmUp * effects.temperature_drift * RandomDirection(&random);
  }
};

ImuData Imu(const SimulatorOptions& options, const TrueTrajectory& trajectory,
            std::mt19937* random) {
  const Flaws flaws(options);
  const Eigen::Matrix3d R_IM = options.T_MI.q.toRotationMatrix().transpose();
  const Eigen::Matrix3d gyro_R_IM = flaws.gyro_matrix * R_IM;
  const Eigen::Matrix3d accel_R_IM = flaws.accel_matrix * R_IM;
  const Vector3d g_W = options.g_W + options.effects.gravity * options.g_W.normalized();
  const auto force_M = [&](const TrueState& s, const Vector3d& p) -> Vector3d {
    return s.R_WM.transpose() * (s.a_W - g_W) + s.alpha_M.cross(p) +
           s.omega_M.cross(s.omega_M.cross(p));
  };
  const auto gyro = [&](double t) -> Vector3d {
    const TrueState s = trajectory.At(options.PoseTime(t));
    return gyro_R_IM * s.omega_M + flaws.g_sensitivity * (R_IM * force_M(s, options.T_MI.p));
  };
  Signal felt_W;
  if (options.effects.mount_hz > 0.0) {
    const auto force_W = [&](double t_M) -> Vector3d {
      const TrueState s = trajectory.At(t_M);
      return s.R_WM * force_M(s, options.T_MI.p);
    };
    felt_W = Resonating(force_W, options.effects.mount_hz, options.PoseTime(-1.0),
                        options.PoseTime(options.duration_s + 1.0));
  }
  const auto accel = [&](double t) -> Vector3d {
    const double t_M = options.PoseTime(t - options.accel_delay_s);
    const TrueState s = trajectory.At(t_M);
    const Vector3d at_origin = force_M(s, options.T_MI.p);
    const Vector3d force = felt_W ? s.R_WM.transpose() * felt_W(t_M) : at_origin;
    Vector3d by_size;
    for (int i = 0; i < 3; ++i) {
      const Vector3d axis_M = options.T_MI.p + options.T_MI.q * flaws.axes_I.col(i);
      by_size[i] = R_IM.row(i).dot(force_M(s, axis_M) - at_origin);
    }
    return accel_R_IM * force + flaws.accel_matrix * by_size;
  };
  const auto sample = [&](const auto& signal, double rate_hz, double cutoff_hz) {
    return Sampled(signal, rate_hz, Count(options.duration_s, rate_hz), cutoff_hz);
  };

  ImuData data;
  data.gyro = SampleSensor(sample(gyro, options.gyro_rate_hz, options.effects.gyro_filter_hz),
                           options.gyro_rate_hz, options.gyro_std, options.gyro_bias_walk,
                           options.gyro_bias, flaws.gyro_warm_up, random);
  data.accel = SampleSensor(sample(accel, options.accel_rate_hz, options.effects.accel_filter_hz),
                            options.accel_rate_hz, options.accel_std, options.accel_bias_walk,
                            options.accel_bias, flaws.accel_warm_up, random);
  return data;
}

/// Poses and the samples of one IMU.
SessionData SimulateOne(const SimulatorOptions& options) {
  const TrueTrajectory trajectory(options);
  std::mt19937 random(ImuSeed(options) + 1000003u);
  SessionData data;
  data.poses = Poses(options, trajectory, &random);
  data.imus[0] = Imu(options, trajectory, &random);
  if (options.effects.fused_poses_s > 0.0) data.poses = FusedPoses(options, data);
  PoseStream(options).Deliver(&data.poses);
  ImuStream(options, options.gyro_rate_hz).Deliver(&data.imus[0].gyro);
  ImuStream(options, options.accel_rate_hz).Deliver(&data.imus[0].accel);
  return data;
}

/// T_VS as the sensor gives them.
std::vector<PoseSample> SensorPoses(const SimulatorOptions& options, size_t sensor) {
  const SimulatedPoseSensor& own = options.pose_sensors[sensor];
  const TrueTrajectory trajectory(options);
  std::mt19937 random(ImuSeed(options) + 7919u * static_cast<uint32_t>(sensor + 1));
  const size_t count = Count(options.duration_s, own.rate_hz);
  std::bernoulli_distribution is_off(own.outliers);
  std::vector<PoseSample> poses;
  DriftingFrame frame{own.drift, own.T_VW, {}};
  for (size_t k = 0; k < count; ++k) {
    const double s = static_cast<double>(k) / own.rate_hz;
    const double t = s + own.clock_drift * (s - 0.5 * options.duration_s);  // pose clock
    const TrueState state = trajectory.At(t);
    const Rigid3 T_WS{Quaterniond(state.R_WM) * own.T_MS.q, state.p_WM + state.R_WM * own.T_MS.p};
    Vector3d shift = Vector3d::Zero(), turn = Vector3d::Zero();
    const auto jumps = static_cast<size_t>(own.jumps) + 1;
    if (k > 0 && k * jumps / count != (k - 1) * jumps / count) {
      shift += 0.2 * RandomDirection(&random);
      turn += 0.1 * RandomDirection(&random);
    }
    frame.MoveTo(T_WS.p, shift, turn, &random);
    const Rigid3 T_VS = frame.T_VW * T_WS;
    const bool off = is_off(random);
    PoseSample pose;
    pose.t_ns = options.start_ns + std::llround(1e9 * (s - own.time_shift_s));
    pose.p_WM = own.scale * T_VS.p + Gaussian(&random, off ? 0.1 : own.position_std);
    pose.q_WM = T_VS.q * Exp<double>(Gaussian(&random, off ? 0.3 : own.rotation_std));
    poses.push_back(pose);
  }
  return poses;
}

}  // namespace

TrueClock::TrueClock(const SimulatorOptions& options) {
  const auto delay = [&](double rate_hz, double cutoff_hz) {
    return FilterDelay(cutoff_hz) + ImuStream(options, rate_hz).MeanLateness();
  };
  const double gyro = delay(options.gyro_rate_hz, options.effects.gyro_filter_hz);
  const double accel = delay(options.accel_rate_hz, options.effects.accel_filter_hz);
  time_shift_s = options.time_shift_s - gyro + PoseStream(options).MeanLateness();
  accel_delay_s = options.accel_delay_s + accel - gyro;
  time_shift_s += Wander(options, 0.5 * options.duration_s);
}

double Wander(const SimulatorOptions& options, double t) {
  return Ahead(options.effects.pose_stream, t, options.duration_s) -
         Ahead(options.effects.imu_stream, t, options.duration_s);
}

SimulatorOptions FurtherImu(SimulatorOptions first, size_t imu) {
  if (imu == 0) return first;
  const auto k = static_cast<double>(imu);
  first.noise_seed = first.seed + 5000u * static_cast<uint32_t>(imu);
  first.T_MI.p.x() += 0.2 * k;
  first.T_MI.q = first.T_MI.q * Exp<double>(Eigen::Vector3d(0.4, 1.1, -0.7) * k);
  first.time_shift_s -= 3.7 * k;
  first.accel_delay_s -= 3e-3 * k;
  return first;
}

SessionData Simulate(const SimulatorOptions& options, size_t imus) {
  SessionData data = SimulateOne(options);
  for (size_t i = 1; i < imus; ++i)
    data.imus.push_back(SimulateOne(FurtherImu(options, i)).imus[0]);
  for (size_t k = 0; k < options.pose_sensors.size(); ++k)
    data.pose_sensors.push_back(SensorPoses(options, k));
  return data;
}

}  // namespace imu_pose_calib
