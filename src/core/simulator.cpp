#include "imu_pose_calib/core/simulator.h"

#include <cmath>
#include <random>

#include "imu_pose_calib/core/so3.h"

namespace imu_pose_calib {
namespace {

constexpr double kTwoPi = 2.0 * M_PI;
constexpr int kSinesPerAxis = 5;

double Uniform(std::mt19937* random, double low, double high) {
  return std::uniform_real_distribution<double>(low, high)(*random);
}

Eigen::Vector3d Gaussian(std::mt19937* random, double sigma) {
  std::normal_distribution<double> normal(0.0, sigma);
  Eigen::Vector3d v;
  for (int i = 0; i < 3; ++i) v[i] = sigma > 0.0 ? normal(*random) : 0.0;
  return v;
}

/// Brownian bias: steps of `walk` sqrt(period).
std::vector<ImuSample> SampleSensor(const std::vector<Eigen::Vector3d>& exact,
                                    double rate_hz,
                                    double noise,
                                    double walk,
                                    Eigen::Vector3d bias,
                                    int64_t first_ns,
                                    std::mt19937* random) {
  std::vector<ImuSample> samples(exact.size());
  for (size_t k = 0; k < exact.size(); ++k) {
    samples[k].t_ns = first_ns + std::llround(1e9 * static_cast<double>(k) / rate_hz);
    samples[k].value = exact[k] + bias + Gaussian(random, noise);
    bias += Gaussian(random, walk / std::sqrt(rate_hz));
  }
  return samples;
}

/// Mean of the pose from t - exposure_s / 2 to t + exposure_s / 2: Gauss-Legendre, three points.
Rigid3 MeanPose(const TrueTrajectory& trajectory, double t, double exposure_s) {
  const TrueState middle = trajectory.At(t);
  if (exposure_s == 0.0) return {Eigen::Quaterniond(middle.R_WM), middle.p_WM};
  Eigen::Vector3d p = 8.0 / 18.0 * middle.p_WM, turn = Eigen::Vector3d::Zero();
  for (const double side : {-0.5, 0.5}) {
    const TrueState state = trajectory.At(t + side * std::sqrt(0.6) * exposure_s);
    p += 5.0 / 18.0 * state.p_WM;
    turn += 5.0 / 18.0 * Log(Eigen::Quaterniond(middle.R_WM.transpose() * state.R_WM));
  }
  return {Eigen::Quaterniond(middle.R_WM) * Exp(turn), p};
}

}  // namespace

Eigen::Vector3d TrueTrajectory::Sines::Evaluate(double t, int derivative) const {
  // d^n/dt^n sin(w t + p) = w^n sin(w t + p + n pi/2)
  const double quarter_turns = derivative * M_PI / 2.0;
  return (amplitude.array() * frequency.array().pow(derivative) *
          (frequency.array() * t + phase.array() + quarter_turns).sin())
      .rowwise()
      .sum();
}

TrueTrajectory::TrueTrajectory(const SimulatorOptions& options) {
  std::mt19937 random(options.seed);
  const auto fill = [&random](double amplitude, Sines* sines) {
    for (Eigen::Matrix3Xd* m : {&sines->amplitude, &sines->frequency, &sines->phase})
      m->resize(3, kSinesPerAxis);
    for (int axis = 0; axis < 3; ++axis) {
      for (int k = 0; k < kSinesPerAxis; ++k) {
        const double hz = Uniform(&random, 0.15 + 0.25 * k, 0.4 + 0.25 * k);
        sines->frequency(axis, k) = kTwoPi * hz;
        sines->amplitude(axis, k) = amplitude * Uniform(&random, 0.6, 1.2) / (1.0 + 2.0 * hz * hz);
        sines->phase(axis, k) = Uniform(&random, 0.0, kTwoPi);
      }
    }
  };
  fill(0.15, &position_);
  fill(0.40, &rotation_);
  q_WB_ = Exp<double>(Gaussian(&random, 1.0));

  switch (options.motion) {
    case Motion::kHandheld:
      break;
    case Motion::kTumble:
      spin_ =
          4.0 * Eigen::Vector3d(Uniform(&random, -1, 1), Uniform(&random, -1, 1), 1).normalized();
      break;
    case Motion::kPlanar:
      position_.amplitude.row(2).setZero();
      rotation_.amplitude.topRows<2>().setZero();
      q_WB_ = Exp<double>(Eigen::Vector3d(0, 0, Uniform(&random, -1, 1)));
      break;
    case Motion::kHinge:
      position_.amplitude.setZero();
      rotation_.amplitude.bottomRows<2>().setZero();
      break;
    case Motion::kStatic:
      position_.amplitude.setZero();
      rotation_.amplitude.setZero();
      break;
  }
}

TrueState TrueTrajectory::At(double t) const {
  // R = R_WB Exp(r) S with S = Exp(spin t), so omega = S^T u + spin with u = J_r(r) r'.
  const Eigen::Vector3d r = rotation_.Evaluate(t, 0);
  const Eigen::Vector3d r_dot = rotation_.Evaluate(t, 1);
  const Eigen::Vector3d r_ddot = rotation_.Evaluate(t, 2);
  const Eigen::Matrix3d J = RightJacobian(r);
  const Eigen::Vector3d u = J * r_dot;
  const Eigen::Vector3d u_dot = J * r_ddot + RightJacobianRate(r, r_dot) * r_dot;
  const Eigen::Matrix3d S = Exp<double>(spin_ * t).toRotationMatrix();

  TrueState state;
  state.R_WM = (q_WB_ * Exp(r)).toRotationMatrix() * S;
  state.omega_M = S.transpose() * u + spin_;
  state.alpha_M = S.transpose() * u_dot - spin_.cross(S.transpose() * u);
  state.p_WM = position_.Evaluate(t, 0);
  state.v_W = position_.Evaluate(t, 1);
  state.a_W = position_.Evaluate(t, 2);
  return state;
}

SessionData Simulate(const SimulatorOptions& options) {
  const TrueTrajectory trajectory(options);
  std::mt19937 random((options.noise_seed == 0 ? options.seed : options.noise_seed) + 1000003u);
  const auto count = [&](double rate_hz) {
    return static_cast<size_t>(std::floor(options.duration_s * rate_hz));
  };

  SessionData data;
  for (size_t k = 0; k < count(options.pose_rate_hz); ++k) {
    const double t = static_cast<double>(k) / options.pose_rate_hz;
    const Rigid3 mean = MeanPose(trajectory, t, options.pose_exposure_s);
    PoseSample pose;
    pose.t_ns = options.start_ns + std::llround(1e9 * t);
    pose.q_WM = mean.q * Exp(Gaussian(&random, options.rotation_std));
    pose.p_WM = mean.p + Gaussian(&random, options.position_std);
    data.poses.push_back(pose);
  }

  const Eigen::Matrix3d R_IM = options.T_MI.q.toRotationMatrix().transpose();
  // Pose clock at s seconds after the first IMU stamp.
  const auto at = [&](double s) {
    return trajectory.At(s + options.clock_drift * (s - 0.5 * options.duration_s));
  };
  std::vector<Eigen::Vector3d> gyro, accel;
  for (size_t k = 0; k < count(options.gyro_rate_hz); ++k)
    gyro.push_back(options.gyro_matrix * R_IM *
                   at(static_cast<double>(k) / options.gyro_rate_hz).omega_M);
  for (size_t k = 0; k < count(options.accel_rate_hz); ++k) {
    const TrueState s = at(static_cast<double>(k) / options.accel_rate_hz - options.accel_delay_s);
    const Eigen::Vector3d& p = options.T_MI.p;
    accel.push_back(options.accel_matrix * R_IM *
                    (s.R_WM.transpose() * (s.a_W - options.g_W) + s.alpha_M.cross(p) +
                     s.omega_M.cross(s.omega_M.cross(p))));
  }
  const int64_t first_ns = options.start_ns - std::llround(1e9 * options.time_shift_s);
  data.imus[0].gyro = SampleSensor(gyro,
                                   options.gyro_rate_hz,
                                   options.gyro_std,
                                   options.gyro_bias_walk,
                                   options.gyro_bias,
                                   first_ns,
                                   &random);
  data.imus[0].accel = SampleSensor(accel,
                                    options.accel_rate_hz,
                                    options.accel_std,
                                    options.accel_bias_walk,
                                    options.accel_bias,
                                    first_ns,
                                    &random);
  return data;
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
  SessionData data = Simulate(options);
  for (size_t i = 1; i < imus; ++i) data.imus.push_back(Simulate(FurtherImu(options, i)).imus[0]);
  return data;
}

}  // namespace imu_pose_calib
