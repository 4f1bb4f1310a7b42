#include "imu_pose_calib/core/calibration/joint_noise.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>

#include "imu_pose_calib/core/calibration/band.h"

namespace imu_pose_calib {
namespace {

constexpr int kSteps = 200;  // of integrals over frequency
/// Share of the band and of the poses' frequencies in which residuals are whole.
constexpr double kWhole = 0.8;
/// Periodograms that the expectation is worth that noise is as white as the samples' spread, give
/// or take a factor of e in the density; and the share of them that holds back what is far below.
constexpr double kWhiteness = 30.0, kLeastWhiteness = 3e-4;
constexpr int kRounds = 300;  // of the likelihood's ascent
/// Bounds of the sigma of slow errors [m, rad]: nothing beside the noise of poses, with which H
/// stays regular; and beyond what is an error.
constexpr double kLeastSlowError = 1e-6, kMostSlowError = 0.1;
constexpr double kLeastShare = 0.1;      // of the way to the noise that is found
constexpr double kShareOfWeights = 0.5;  // of the way to an IMU's weights, that neighbours act on
constexpr double kInfinity = std::numeric_limits<double>::infinity();

bool IsLinear(Quantity quantity) {
  return quantity == Quantity::kPosition || quantity == Quantity::kAccel;
}

/// Of the noise of a sensor; of poses that state how theirs differs as they are weighed.
double DensityOf(const LeastSquares& joint, const SensorModel& model) {
  if (!IsOfPoses(model.quantity)) return model.Density();
  double information = 0.0, count = 0.0;
  for (size_t i = 0; i < model.weights.size(); ++i) {
    const RecordedSample pose = joint.At(model, i);
    information += pose.count / (pose.scale * pose.scale);
    count += pose.count;
  }
  return model.Density() * count / information;
}

/// Densities of the noise that sensors of one kind have together in a session, as they tell of the
/// same motion.
struct Densities : std::map<Quantity, double> {
  double OfPoses(bool is_linear) const {
    return at(is_linear ? Quantity::kPosition : Quantity::kRotation);
  }
  double OfImus(bool is_linear) const { return at(is_linear ? Quantity::kAccel : Quantity::kGyro); }
};

Densities JointDensities(const LeastSquares& joint, size_t session) {
  Densities S;
  for (const SensorModel& model : joint.models)
    if (model.session == session) S[model.quantity] += 1.0 / DensityOf(joint, model);
  for (auto& [quantity, density] : S) density = 1.0 / density;
  return S;
}

/// Squared residual that the weight of each sample is found from, which are in order of time; or
/// the mean of those within `reach` [s], where that is larger.
std::vector<double> SquaresAround(const LeastSquares& joint, const SensorBlocks& sensor,
                                  double reach) {
  const std::vector<ProblemSample>& samples = sensor.samples;
  std::vector<double> squares, larger;
  for (size_t i = 0; i < samples.size(); ++i)
    squares.push_back(joint.AtUsualWeight(sensor, i).squaredNorm());
  size_t begin = 0, end = 0;
  double sum = 0.0;
  for (size_t i = 0; i < samples.size(); ++i) {
    for (; end < samples.size() && samples[end].t <= samples[i].t + reach; ++end)
      sum += squares[end];
    for (; samples[begin].t < samples[i].t - reach; ++begin) sum -= squares[begin];
    larger.push_back(std::max(squares[i], sum / static_cast<double>(end - begin)));
  }
  return larger;
}

double Omega2(double frequency) { return std::pow(2.0 * M_PI * frequency, 2); }

/// Of an IMU, which measures a derivative of positions or of rotations; squared.
double Gain(bool is_linear, double omega2) { return is_linear ? omega2 * omega2 : omega2; }

/// Share of IMUs in what tells of positions or rotations, in the mean over the spline's band [Hz].
double ImuShare(const Densities& S, Quantity quantity, double band) {
  const bool is_linear = IsLinear(quantity);
  const double of_poses = S.OfPoses(is_linear);
  double sum = 0.0;
  for (int k = 0; k < kSteps; ++k) {
    const double omega2 = Omega2((k + 0.5) / kSteps * band);
    sum += of_poses / (of_poses + S.OfImus(is_linear) / Gain(is_linear, omega2));
  }
  return sum / kSteps;
}

/// A noise that is found.
struct Noise {
  double white, most;  ///< as it is expected, and its bound
  double trust;        ///< periodograms that this expectation is worth
};
/// A density found in `count` periodograms, the sum of shares of noises.
struct Observation {
  double count, density;
  struct Part {
    size_t noise;
    double share;
  };
  std::vector<Part> parts;
};

/// Power spectral densities of the noise of sensors that tell of the same motion, by maximum
/// likelihood of the spectra of their residuals, doc/math.md, S4, "Noise".
std::vector<double> FitDensities(const std::vector<Noise>& noises,
                                 const std::vector<Observation>& observations) {
  std::vector<double> x;
  for (const Noise& noise : noises) x.push_back(noise.white);
  // From above: each as if it were all of what is found. Next to nothing of it is a maximum, too.
  for (const Observation& o : observations)
    for (const Observation::Part& part : o.parts)
      if (part.share > 0.0)
        x[part.noise] += o.density / part.share / static_cast<double>(observations.size());
  for (size_t k = 0; k < x.size(); ++k) x[k] = std::min(noises[k].most, x[k]);
  for (int round = 0; round < kRounds; ++round) {
    std::vector<double> found(x.size(), 0.0), expected(x.size(), 0.0);
    for (const Observation& o : observations) {
      double sum = 0.0;
      for (const Observation::Part& part : o.parts) sum += part.share * x[part.noise];
      for (const Observation::Part& part : o.parts) {
        found[part.noise] += o.count * part.share * o.density / (sum * sum);
        expected[part.noise] += o.count * part.share / sum;
      }
    }
    for (size_t k = 0; k < x.size(); ++k) {
      const double white = noises[k].white, apart = std::log(white / x[k]);
      const double trust = noises[k].trust, pull = trust * apart / (1.0 + apart * apart);
      found[k] +=
          trust * (1.0 + kLeastWhiteness * white / x[k]) / x[k] + std::max(0.0, pull) / x[k];
      expected[k] += trust * (1.0 + kLeastWhiteness) / x[k] + std::max(0.0, -pull) / x[k];
      if (found[k] > 0.0)  // else nothing tells of it
        x[k] = std::min(noises[k].most, x[k] * std::sqrt(found[k] / expected[k]));
    }
  }
  return x;
}

/// Sets the noise of the sensors of positions and accelerations, or of rotations and turn rates, of
/// a session, and the sigma of the slow errors of its poses.
void FitNoiseOf(bool is_linear, size_t session, const LeastSquares& joint,
                std::vector<SensorStatistics>* statistics) {
  std::vector<size_t> sensors;  // the poses first
  for (size_t k = 0; k < joint.sensors.size(); ++k)
    if (joint.sensors[k].model->session == session &&
        IsLinear(joint.sensors[k].model->quantity) == is_linear)
      sensors.push_back(k);
  const SessionEstimate& estimate = joint.estimate->sessions[session];
  const SlowErrors& slow = is_linear ? estimate.position_errors : estimate.rotation_errors;
  std::vector<Noise> noises;
  std::vector<double> white;  // densities that are set
  for (const size_t k : sensors) {
    const SensorModel& model = *joint.sensors[k].model;
    white.push_back(DensityOf(joint, model));
    const double expected = std::pow((*statistics)[k].spread.scale / model.noise, 2) * white.back();
    // What errs slowly in an IMU is its bias.
    const bool is_pose = IsOfPoses(model.quantity);
    noises.push_back({expected, is_pose ? kInfinity : expected, kWhiteness});
  }
  noises.push_back({slow.std * slow.std, kMostSlowError * kMostSlowError, 0.0});

  std::vector<Observation> observations;  // how poses and an IMU differ
  const NoiseSpectrum& of_poses = (*statistics)[sensors[0]].spectrum;
  for (size_t f = 0; f < of_poses.density.size(); ++f) {
    const double omega2 = Omega2(NoiseSpectrum::Frequency(f)), gain = Gain(is_linear, omega2);
    std::vector<double> densities = white;  // of the noise of each, as positions or rotations
    for (size_t k = 1; k < densities.size(); ++k) densities[k] /= gain;
    densities[0] += slow.std * slow.std * slow.Density(omega2);
    double information = 0.0;
    for (const double density : densities) information += 1.0 / density;
    // Of residuals, the trajectory being between the sensors.
    const auto left = [&](size_t k) {
      return std::sqrt(std::max(0.0, densities[k] - 1.0 / information));
    };
    for (size_t k = 1; k < sensors.size(); ++k) {
      const NoiseSpectrum& of_imu = (*statistics)[sensors[k]].spectrum;
      if (f >= of_imu.density.size()) continue;
      const double found = std::sqrt(of_poses.density[f]) + std::sqrt(of_imu.density[f] / gain);
      const double apart = std::pow(found / (left(0) + left(k)), 2) * (densities[0] + densities[k]);
      observations.push_back({std::min(of_poses.count, of_imu.count),
                              apart,
                              {{0, 1.0}, {k, 1.0 / gain}, {sensors.size(), slow.Density(omega2)}}});
    }
  }
  const std::vector<double> x = FitDensities(noises, observations);
  for (size_t k = 0; k < sensors.size(); ++k)
    (*statistics)[sensors[k]].noise =
        joint.sensors[sensors[k]].model->noise * std::sqrt(x[k] / white[k]);
  (*statistics)[sensors[0]].slow_std = std::max(kLeastSlowError, std::sqrt(x.back()));
}

}  // namespace

double NoiseMove::Next(double wanted) {
  const double share = moved_ / (wanted_ - wanted);
  wanted_ = wanted;
  moved_ = wanted * (share > 0.0 ? std::clamp(share, kLeastShare, 1.0) : 1.0);
  return moved_;
}

void ShareFreedom(const CorrectionSplines& splines, size_t session, LeastSquares* joint) {
  const double band = Band(splines.spacing());
  // As many as there is noise in that band.
  const double points = static_cast<double>(splines.d.size()) * 2.0 * band * splines.spacing();
  const Densities S = JointDensities(*joint, session);
  for (SensorBlocks& sensor : joint->sensors) {
    const SensorModel& model = *sensor.model;
    if (model.session != session) continue;
    const double imus = ImuShare(S, model.quantity, band);
    const double share = IsOfPoses(model.quantity)
                             ? 1.0 - imus
                             : imus * S.at(model.quantity) / model.Density();  // of all IMUs'
    sensor.band =
        kWhole * std::min(band, 0.5 * joint->Find(Quantity::kPosition, session)->model->rate_hz);
    sensor.fitted = share * points / std::max(1.0, sensor.count);
  }
}

void UpdateWeights(const LeastSquares& joint, const std::vector<CorrectionSplines>& splines,
                   std::vector<SensorModel>* models) {
  for (size_t k = 0; k < models->size(); ++k) {
    SensorModel& model = (*models)[k];
    const SensorBlocks& sensor = joint.sensors[k];
    // Where knots do not follow the motion, residuals of an IMU swing through zero and none of them
    // is right.
    const bool is_pose = IsOfPoses(model.quantity);
    const double reach = is_pose ? 0.0 : 0.5 * kSplineOrder * splines[model.session].spacing();
    const double share = is_pose ? 1.0 : kShareOfWeights;
    const std::vector<double> squares = SquaresAround(joint, sensor, reach);
    for (size_t i = 0; i < sensor.samples.size(); ++i) {
      double& weight = model.weights[sensor.samples[i].index];
      const double found = model.spread.Weight(squares[i]);
      weight *= std::pow(found / weight, share);
    }
  }
}

void FitNoise(const LeastSquares& joint, std::vector<SensorStatistics>* statistics) {
  for (size_t s = 0; s < joint.sessions.size(); ++s)
    for (const bool is_linear : {true, false}) FitNoiseOf(is_linear, s, joint, statistics);
}

}  // namespace imu_pose_calib
