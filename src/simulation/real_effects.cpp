#include "imu_pose_calib/simulation/real_effects.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace imu_pose_calib {
namespace {

using Eigen::Vector3d;

constexpr double kFilterStep = 5e-4;   // [s] at most, between which a filtered signal is linear
constexpr int64_t kTogether = 20'000;  // [ns] between the stamps of samples that come together

int64_t Nominal(int64_t first_ns, double rate_hz, size_t k) {
  return first_ns + std::llround(1e9 * static_cast<double>(k) / rate_hz);
}

}  // namespace

std::mt19937 RandomOf(RandomEffect effect, uint32_t seed) {
  std::seed_seq sequence{seed, static_cast<uint32_t>(effect) + 1u};
  return std::mt19937(sequence);
}

double Uniform(std::mt19937* random, double low, double high) {
  return std::uniform_real_distribution<double>(low, high)(*random);
}

Vector3d Gaussian(std::mt19937* random, double sigma) {
  if (!(sigma > 0.0)) return Vector3d::Zero();
  std::normal_distribution<double> normal;
  return Vector3d::NullaryExpr([&](Eigen::Index) { return sigma * normal(*random); });
}

Vector3d RandomDirection(std::mt19937* random) { return Gaussian(random, 1.0).normalized(); }

size_t Count(double duration_s, double rate_hz) {
  return static_cast<size_t>(std::floor(duration_s * rate_hz));
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
