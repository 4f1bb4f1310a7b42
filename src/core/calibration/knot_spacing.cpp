#include "imu_pose_calib/core/calibration/knot_spacing.h"

#include <algorithm>
#include <cmath>
#include <complex>
#include <limits>
#include <unsupported/Eigen/FFT>
#include <vector>

#include "imu_pose_calib/core/calibration/band.h"

namespace imu_pose_calib {
namespace {

constexpr double kCoarsest = 0.064;         // [s]
constexpr double kMinSamplesPerKnot = 3.0;  // IMU samples
/// By how much what splines leave of gyroscope times accelerometer must shrink.
constexpr double kShrinkage = 0.02;
constexpr double kSpan = 2.0;      // [s] of a periodogram
constexpr size_t kFewBins = 8;     // of which a mean is not taken for the noise
constexpr double kFullSpan = 1.1;  // times the span, beyond which samples are missing
constexpr double kFilled = 5.5;    // periods between samples, up to which those missing are made up

/// Power of a sensor, without a unit, at multiples of 1 / kSpan up to half of its rate.
using Spectrum = std::vector<double>;

/// Sum over axes of the power of the samples from `begin` on, as many as twice the bins.
Spectrum Periodogram(const std::vector<TimedSample>& samples, size_t begin, size_t bins) {
  Eigen::FFT<double> fft;
  Spectrum power(bins, 0.0);
  std::vector<double> windowed(2 * bins);
  std::vector<std::complex<double>> transform;
  for (int axis = 0; axis < 3; ++axis) {
    for (size_t i = 0; i < windowed.size(); ++i) {
      const double angle = M_PI * static_cast<double>(i) / static_cast<double>(bins);
      windowed[i] = (1.0 - std::cos(angle)) *  // Hann's
                    (samples[begin + i].value[axis] - samples[begin].value[axis]);
    }
    fft.fwd(transform, windowed);
    for (size_t k = 0; k < bins; ++k) power[k] += std::norm(transform[k]);
  }
  return power;
}

/// With samples on straight lines where single ones are missing: a jump in time looks like fast
/// motion.
std::vector<TimedSample> WithoutDrops(const std::vector<TimedSample>& samples, double rate_hz) {
  std::vector<TimedSample> filled;
  for (const TimedSample& s : samples) {
    const double periods = filled.empty() ? 1.0 : (s.t - filled.back().t) * rate_hz;
    if (periods > 1.5 && periods < kFilled) {
      const TimedSample before = filled.back();
      const double count = std::round(periods);
      for (double k = 1.0; k < count; ++k) {
        filled.push_back(before);
        filled.back().t += k / count * (s.t - before.t);
        filled.back().value += k / count * (s.value - before.value);
      }
    }
    filled.push_back(s);
  }
  return filled;
}

/// The mean of spans, each weighted by its power, so that rests do not hide the motion.
Spectrum FindSpectrum(const std::vector<TimedSample>& recorded, double rate_hz) {
  const std::vector<TimedSample> samples = WithoutDrops(recorded, rate_hz);
  const auto bins = static_cast<size_t>(std::round(0.5 * kSpan * rate_hz));
  Spectrum spectrum(bins, 0.0);
  for (size_t begin = 0; begin + 2 * bins <= samples.size(); begin += bins) {
    if (samples[begin + 2 * bins - 1].t - samples[begin].t > kFullSpan * kSpan) continue;
    const Spectrum power = Periodogram(samples, begin, bins);
    double motion = 0.0;  // but for what is constant, which Hann's window spreads over two
    for (size_t k = 2; k < bins; ++k) motion += power[k];
    for (size_t k = 0; k < bins; ++k) spectrum[k] += motion * power[k];
  }
  return spectrum;
}

/// Of the frequencies in [low, high) [Hz], the sum and how many there are.
struct FrequencyBand {
  double power = 0.0, count = 0.0;

  FrequencyBand(const Spectrum& spectrum, double low, double high) {
    for (size_t k = 0; k < spectrum.size(); ++k) {
      const double frequency = static_cast<double>(k) / kSpan;
      if (frequency < low || frequency >= high) continue;
      power += spectrum[k];
      count += 1.0;
    }
  }
};

/// Of a frequency: the least mean of half an octave.
double FindNoise(const Spectrum& spectrum) {
  double noise = std::numeric_limits<double>::infinity();
  for (double low = 1.0; low * M_SQRT2 * kSpan < static_cast<double>(spectrum.size());
       low *= M_SQRT2) {
    const FrequencyBand band(spectrum, low, low * M_SQRT2);
    if (band.count >= kFewBins) noise = std::min(noise, band.power / band.count);
  }
  return noise;
}

/// By how much what is above `cutoff` [Hz] shrinks, in the logarithm of its rms, when the octave
/// there is followed down to its noise.
double Shrinkage(const Spectrum& spectrum, double cutoff) {
  const FrequencyBand octave(spectrum, cutoff, 2.0 * cutoff), above(spectrum, cutoff, INFINITY);
  const double motion = octave.power - octave.count * FindNoise(spectrum);
  return motion > 0.0 ? -0.5 * std::log(1.0 - motion / above.power) : 0.0;
}

}  // namespace

double ChooseKnotSpacing(const CalibrationOptions& options, const ConditionedData& data) {
  if (options.knot_spacing_s > 0.0) return options.knot_spacing_s;
  std::vector<Spectrum> spectra;
  double slowest = std::numeric_limits<double>::infinity(), imus = 0.0;
  for (const ConditionedImu& imu : data.imus) {
    if (!imu.IsPresent()) continue;
    const double gyro_hz = imu.gyro_report.rate_hz, accel_hz = imu.accel_report.rate_hz;
    spectra.push_back(FindSpectrum(imu.gyro, gyro_hz));
    spectra.push_back(FindSpectrum(imu.accel, accel_hz));
    slowest = std::min({slowest, gyro_hz, accel_hz});
    imus += 1.0;
  }
  const double finest = kMinSamplesPerKnot / slowest;
  double spacing = std::max(kCoarsest, finest);
  while (0.5 * spacing >= finest) {
    double shrinkage = 0.0;
    for (const Spectrum& spectrum : spectra) shrinkage += Shrinkage(spectrum, Band(spacing)) / imus;
    if (shrinkage < kShrinkage) break;
    spacing *= 0.5;
  }
  return spacing;
}

}  // namespace imu_pose_calib
