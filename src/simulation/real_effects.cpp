#include "imu_pose_calib/simulation/real_effects.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "imu_pose_calib/core/base/so3.h"

namespace imu_pose_calib {
namespace {

using Eigen::Quaterniond;
using Eigen::Vector3d;

constexpr double kFilterStep = 5e-4;    // [s] at most, between which a filtered signal is linear
constexpr double kSlowErrorTime = 3.0;  // [s]
constexpr double kDampingRatio = 0.2;   // of a mount
constexpr int64_t kTogether = 20'000;   // [ns] between the stamps of samples that come together
// Of a filter that carries poses on: updates a second [Hz], scale error of its accelerometer, gains
// of an update [1, 1/s].
constexpr double kUpdateRate = 20.0, kCarriedScale = 0.005, kPositionGain = 0.2,
                 kVelocityGain = 0.4;
constexpr double kFusedReach = 3.0;  // of the sigma of its weights

int64_t Nominal(int64_t first_ns, double rate_hz, size_t k) {
  return first_ns + std::llround(1e9 * static_cast<double>(k) / rate_hz);
}

/// Rotation since the first rate, which changes linearly from one to the next.
class TurnSinceStart {
 public:
  TurnSinceStart(const std::vector<Vector3d>& omega, const std::vector<double>& t)
      : omega_(omega), t_(t), q_(1, Quaterniond::Identity()) {
    for (size_t k = 0; k + 1 < t.size(); ++k) q_.push_back(From(k, t[k + 1]));
  }
  Quaterniond At(double t) const {
    const auto after = std::upper_bound(t_.begin() + 1, t_.end() - 1, t);
    return From(static_cast<size_t>(after - t_.begin()) - 1, t);
  }

 private:
  Quaterniond From(size_t k, double t) const {
    const double h = t - t_[k], share = h / (t_[k + 1] - t_[k]);
    return q_[k] * Exp<double>(h * (omega_[k] + 0.5 * share * (omega_[k + 1] - omega_[k])));
  }

  const std::vector<Vector3d>& omega_;
  const std::vector<double>& t_;
  std::vector<Quaterniond> q_;
};

}  // namespace

std::mt19937 RandomOf(RandomEffect effect, uint32_t seed) {
  std::seed_seq sequence{seed, static_cast<uint32_t>(effect) + 1u};
  return std::mt19937(sequence);
}

double Uniform(std::mt19937* random, double low, double high) {
  return std::uniform_real_distribution<double>(low, high)(*random);
}

Vector3d Gaussian(std::mt19937* random, double sigma) {
  std::normal_distribution<double> normal(0.0, sigma);
  Vector3d v;
  for (int i = 0; i < 3; ++i) v[i] = sigma > 0.0 ? normal(*random) : 0.0;
  return v;
}

Vector3d RandomDirection(std::mt19937* random) { return Gaussian(random, 1.0).normalized(); }

size_t Count(double duration_s, double rate_hz) {
  return static_cast<size_t>(std::floor(duration_s * rate_hz));
}

double PoseTime(const SimulatorOptions& options, double s) {
  return s + options.clock_drift * (s - 0.5 * options.duration_s);
}

double FilterDelay(double cutoff_hz) { return cutoff_hz > 0.0 ? 0.5 / (M_PI * cutoff_hz) : 0.0; }

std::vector<Vector3d> Sampled(const std::function<Vector3d(double)>& signal, double rate_hz,
                              size_t count, double cutoff_hz) {
  std::vector<Vector3d> samples;
  const double tau = FilterDelay(cutoff_hz);
  if (tau == 0.0) {
    for (size_t k = 0; k < count; ++k) samples.push_back(signal(static_cast<double>(k) / rate_hz));
    return samples;
  }
  // tau y' = x - y, solved for an x that is linear from one step to the next
  const int steps = static_cast<int>(std::ceil(1.0 / (rate_hz * std::min(kFilterStep, 0.2 * tau))));
  const double h = 1.0 / (rate_hz * steps), decay = std::exp(-h / tau);
  int i = -static_cast<int>(std::ceil(10.0 * tau / h));
  Vector3d x = signal(i * h), y = x;
  for (size_t k = 0; k < count; ++k) {
    for (; i < static_cast<int>(k) * steps; ++i) {
      const Vector3d next = signal((i + 1) * h), lag = tau / h * (next - x);
      y = next - lag + decay * (y - x + lag);
      x = next;
    }
    samples.push_back(y);
  }
  return samples;
}

Resonance::Resonance(const std::function<Vector3d(double)>& signal, double resonance_hz,
                     double begin, double end)
    : begin_(begin - 1.0) {
  // u'' = -x - omega^2 u - 2 zeta omega u' is how the IMU moves beside its place, for an x that is
  // linear from one step to the next; it feels x + u''. Fourth-order Runge-Kutta.
  const double omega = 2.0 * M_PI * resonance_hz;
  const auto felt = [&](const Vector3d& u, const Vector3d& v) -> Vector3d {
    return -omega * omega * u - 2.0 * kDampingRatio * omega * v;
  };
  const double h = kFilterStep;
  Vector3d x = signal(begin_), u = -x / (omega * omega), v = Vector3d::Zero();
  for (size_t k = 0; begin_ + static_cast<double>(k) * h <= end + h; ++k) {
    values_.push_back(felt(u, v));
    const Vector3d next = signal(begin_ + static_cast<double>(k + 1) * h), mean = 0.5 * (x + next);
    const Vector3d v1 = v, a1 = felt(u, v) - x;
    const Vector3d v2 = v + 0.5 * h * a1, a2 = felt(u + 0.5 * h * v1, v2) - mean;
    const Vector3d v3 = v + 0.5 * h * a2, a3 = felt(u + 0.5 * h * v2, v3) - mean;
    const Vector3d v4 = v + h * a3, a4 = felt(u + h * v3, v4) - next;
    u += h / 6.0 * (v1 + 2.0 * v2 + 2.0 * v3 + v4);
    v += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4);
    x = next;
  }
}

Vector3d Resonance::At(double t) const {
  const double place =
      std::clamp((t - begin_) / kFilterStep, 0.0, static_cast<double>(values_.size()) - 1.001);
  const auto k = static_cast<size_t>(place);
  return values_[k] + (place - static_cast<double>(k)) * (values_[k + 1] - values_[k]);
}

std::vector<Vector3d> SlowError(double sigma, double rate_hz, size_t count, std::mt19937 random) {
  const double kept = std::exp(-1.0 / (rate_hz * kSlowErrorTime));
  std::vector<Vector3d> errors(count);
  for (size_t k = 0; k < count; ++k)
    errors[k] = k == 0 ? Gaussian(&random, sigma)
                       : Vector3d(kept * errors[k - 1] +
                                  Gaussian(&random, sigma * std::sqrt(1.0 - kept * kept)));
  return errors;
}

std::vector<Vector3d> CarriedOn(double sigma, double rate_hz, const std::vector<Vector3d>& p_WM,
                                std::mt19937 random) {
  const double h = 1.0 / rate_hz;
  const auto period = std::max<size_t>(1, static_cast<size_t>(std::lround(rate_hz / kUpdateRate)));
  Vector3d error = Vector3d::Zero(), velocity = error;
  std::vector<Vector3d> errors;
  for (size_t k = 0; k < p_WM.size(); ++k) {
    if (k >= 2) {
      const Vector3d acceleration = (p_WM[k] - 2.0 * p_WM[k - 1] + p_WM[k - 2]) / (h * h);
      velocity += kCarriedScale * h * acceleration;
      error += h * velocity;
    }
    if (k % period == 0) {
      const Vector3d innovation = Gaussian(&random, sigma) - error;
      error += kPositionGain * innovation;
      velocity += kVelocityGain * innovation;
    }
    errors.push_back(error);
  }
  return errors;
}

std::vector<PoseSample> FusedPoses(const SimulatorOptions& options, const SessionData& data) {
  std::vector<double> t_pose, t_omega;
  std::vector<Vector3d> omega_M;
  const double delay = FilterDelay(options.effects.gyro_filter_hz);
  for (size_t k = 0; k < data.imus[0].gyro.size(); ++k) {
    t_omega.push_back(PoseTime(options, static_cast<double>(k) / options.gyro_rate_hz - delay));
    omega_M.push_back(options.T_MI.q * (data.imus[0].gyro[k].value - options.gyro_bias));
  }
  const TurnSinceStart turn(omega_M, t_omega);
  std::vector<Quaterniond> turns, start;  // each rotation, carried to the start
  for (size_t k = 0; k < data.poses.size(); ++k) {
    t_pose.push_back(static_cast<double>(k) / options.pose_rate_hz);
    turns.push_back(turn.At(t_pose[k]));
    start.push_back(data.poses[k].q_WM * turns[k].conjugate());
  }

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

double Ahead(const StreamEffects& effects, double t, double duration_s) {
  constexpr double kPeriod = 60.0, kStepAt = 0.45;
  return effects.wander_s * std::sin(2.0 * M_PI * t / kPeriod) +
         (t > kStepAt * duration_s ? effects.clock_step_s : 0.0);
}

std::vector<int64_t> Stream::Stamps() const {
  const size_t count = Count(duration_s, rate_hz);
  std::vector<int64_t> stamps(count);
  for (size_t k = 0; k < count; ++k) stamps[k] = Nominal(first_ns, rate_hz, k);
  const auto group = static_cast<size_t>(std::max(1.0, std::round(effects.burst)));
  if (effects.jitter_s > 0.0 || effects.latency_s > 0.0 || group > 1) {
    std::mt19937 random = stamp_random;
    int64_t delay = 0, last = std::numeric_limits<int64_t>::min();
    for (size_t k = 0; k < count; ++k) {
      if (k % group == 0) {
        double seconds = Gaussian(&random, effects.jitter_s).x();
        if (effects.latency_s > 0.0)
          seconds += std::exponential_distribution<double>(1.0 / effects.latency_s)(random);
        delay = std::llround(1e9 * seconds);
      }
      const size_t sent = std::min(count, (k / group + 1) * group) - 1;
      last = std::max(Nominal(first_ns, rate_hz, sent) + delay, last + kTogether);
      stamps[k] = last;
    }
  }
  if (const int64_t step = std::llround(1e9 * effects.step_s); step > 0)
    for (int64_t& stamp : stamps) stamp -= (stamp % step + step) % step;
  return stamps;
}

double Stream::MeanLateness() const {
  const std::vector<int64_t> stamps = Stamps();
  double sum = 0.0;
  for (size_t k = 0; k < stamps.size(); ++k)
    sum += 1e-9 * static_cast<double>(stamps[k] - Nominal(first_ns, rate_hz, k));
  return stamps.empty() ? 0.0 : sum / static_cast<double>(stamps.size());
}

}  // namespace imu_pose_calib
