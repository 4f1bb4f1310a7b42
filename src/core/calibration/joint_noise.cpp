#include "imu_pose_calib/core/calibration/joint_noise.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <numeric>

#include "imu_pose_calib/core/calibration/band.h"

namespace imu_pose_calib {
namespace {

constexpr int kSteps = 200;  // of integrals over frequency
/// Share of the band and of the poses' frequencies in which residuals are whole.
constexpr double kWhole = 0.8;
/// Periodograms that the expectation is worth that noise is as white as the samples' spread, give
/// or take a factor of e in the density; and by which it holds back what is far below.
constexpr double kWhiteness = 30.0, kLeastWhiteness = 0.01;
/// Share of white noise in what poses err by, with which their residuals tell of it.
constexpr double kLeastWhite = 0.25;
constexpr int kRounds = 300;            // of the likelihood's ascent
constexpr double kLongestStride = 2.0;  // of a pass, in the sigma of slow errors that it finds
/// Share of the increments of slow errors that is looked at, the smallest, and their mean square
/// over that of all.
constexpr double kTaken = 0.95, kTakenMean = 0.877;
/// Bounds of that sigma [m, rad]: nothing beside the noise of poses, with which H stays regular;
/// and beyond what is an error.
constexpr double kLeastSlowError = 1e-6, kMostSlowError = 0.1;

bool IsLinear(Quantity quantity) {
  return quantity == Quantity::kPosition || quantity == Quantity::kAccel;
}

/// What poses tell, as far as they state their noise, over what they would without that.
double StatedInformation(const LeastSquares& joint, const SensorModel& model) {
  if (!IsOfPoses(model.quantity)) return 1.0;
  double sum = 0.0, count = 0.0;
  for (size_t i = 0; i < model.weights.size(); ++i) {
    const RecordedSample pose = joint.At(model, i);
    sum += pose.count / (pose.scale * pose.scale);
    count += pose.count;
  }
  return sum / count;
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
    if (model.session == session)
      S[model.quantity] += StatedInformation(joint, model) / model.Density();
  for (auto& [quantity, density] : S) density = 1.0 / density;
  return S;
}

/// Mean squared residual of the samples within `reach` [s] of each, which are in order of time.
std::vector<double> MeanSquareAround(const SensorBlocks& sensor, double reach) {
  const std::vector<ProblemSample>& samples = sensor.samples;
  std::vector<double> means;
  size_t begin = 0, end = 0;
  double sum = 0.0;
  for (const ProblemSample& sample : samples) {
    for (; end < samples.size() && samples[end].t <= sample.t + reach; ++end)
      sum += sensor.residuals[end].squaredNorm();
    for (; samples[begin].t < sample.t - reach; ++begin)
      sum -= sensor.residuals[begin].squaredNorm();
    means.push_back(sum / static_cast<double>(end - begin));
  }
  return means;
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
};
/// A density found in `count` periodograms, that is the sum of one that is known and of shares of
/// noises.
struct Observation {
  double count, density, known;
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
      double sum = o.known;
      for (const Observation::Part& part : o.parts) sum += part.share * x[part.noise];
      for (const Observation::Part& part : o.parts) {
        found[part.noise] += o.count * part.share * o.density / (sum * sum);
        expected[part.noise] += o.count * part.share / sum;
      }
    }
    for (size_t k = 0; k < x.size(); ++k) {
      const double white = noises[k].white, apart = std::log(white / x[k]);
      const double pull = kWhiteness * apart / (1.0 + apart * apart);
      found[k] += (kWhiteness + kLeastWhiteness * white / x[k] + std::max(0.0, pull)) / x[k];
      expected[k] += (kWhiteness + kLeastWhiteness + std::max(0.0, -pull)) / x[k];
      x[k] = std::min(noises[k].most, x[k] * std::sqrt(found[k] / expected[k]));
    }
  }
  return x;
}

/// Sets the noise of the sensors of positions and accelerations, or of rotations and turn rates, of
/// a session.
void FitNoiseOf(bool is_linear, size_t session, const LeastSquares& joint,
                std::vector<SensorStatistics>* statistics) {
  std::vector<size_t> sensors;  // the poses first
  for (size_t k = 0; k < joint.sensors.size(); ++k)
    if (joint.sensors[k].model->session == session &&
        IsLinear(joint.sensors[k].model->quantity) == is_linear)
      sensors.push_back(k);
  const SessionEstimate& estimate = joint.estimate->sessions[session];
  const SlowErrors& errors = is_linear ? estimate.position_errors : estimate.rotation_errors;
  std::vector<Noise> noises;
  std::vector<Observation> observations;
  for (const size_t k : sensors) {
    const SensorModel& model = *joint.sensors[k].model;
    const double expected = std::pow((*statistics)[k].spread.scale, 2) / model.rate_hz;
    // What errs slowly in an IMU is its bias.
    noises.push_back(
        {expected, IsOfPoses(model.quantity) ? std::numeric_limits<double>::infinity() : expected});
  }
  const double white = joint.sensors[sensors[0]].model->Density();  // of the poses
  for (size_t a = 0; a < sensors.size(); ++a) {
    const NoiseSpectrum& spectrum = (*statistics)[sensors[a]].spectrum;
    for (size_t f = 0; f < spectrum.density.size(); ++f) {
      const double omega2 = Omega2(NoiseSpectrum::Frequency(f));
      const double gain = Gain(is_linear, omega2);
      const double poses = white + errors.Density(omega2);
      std::vector<double> share{1.0 / poses};  // of each sensor
      for (size_t b = 1; b < sensors.size(); ++b)
        share.push_back(gain / joint.sensors[sensors[b]].model->Density());
      const double all = std::accumulate(share.begin(), share.end(), 0.0);
      for (double& own : share) own /= all;
      // Where the others' residuals tell more, or slow errors take up what poses err by: what is
      // left of that is a leak from other frequencies.
      if (share[a] > 0.5 || (a == 0 && white < kLeastWhite * poses)) continue;
      Observation observation{spectrum.count, spectrum.density[f], 0.0, {}};
      for (size_t b = 0; b < sensors.size(); ++b) {
        double part = std::pow(a == b ? 1.0 - share[b] : share[b], 2);
        if (a != b) part *= (a == 0 ? 1.0 : gain) / (b == 0 ? 1.0 : gain);
        if (a == 0) part *= std::pow(white / poses, 2);  // slow errors take up the rest
        if (b == 0) observation.known = part * (poses - white);
        observation.parts.push_back({b, part});
      }
      observations.push_back(std::move(observation));
    }
  }
  const std::vector<double> x = FitDensities(noises, observations);
  for (size_t a = 0; a < sensors.size(); ++a)
    (*statistics)[sensors[a]].noise = std::sqrt(x[a] * joint.sensors[sensors[a]].model->rate_hz);
}

/// Sets the sigma of slow errors of a session to what is found of them, doc/math.md, S4, "Slow
/// errors"; `S`: of the session.
void UpdateSlowErrors(const Densities& S, bool is_linear, SlowErrors* errors) {
  const BiasKnots& knots = errors->knots;
  const double interval = knots.t[1] - knots.t[0];
  std::vector<double> squares;  // of increments
  for (size_t k = 0; k + 1 < knots.t.size(); ++k)
    squares.push_back((knots.values[k + 1] - errors->Kept(k) * knots.values[k]).squaredNorm() /
                      (1.0 - errors->Kept(k) * errors->Kept(k)));
  // A touch or a clock that steps is no walk.
  std::sort(squares.begin(), squares.end());
  squares.resize(
      std::max<size_t>(1, static_cast<size_t>(kTaken * static_cast<double>(squares.size()))));
  double share = 0.0;
  for (int k = 0; k < kSteps; ++k) {
    const double omega2 = Omega2(0.5 * (k + 0.5) / kSteps / interval);
    const double own = errors->Density(omega2);
    const double others = S.OfPoses(is_linear) + S.OfImus(is_linear) / Gain(is_linear, omega2);
    share += own / (own + others) / kSteps;
  }
  const double mean = std::accumulate(squares.begin(), squares.end(), 0.0) /
                      (kTakenMean * static_cast<double>(squares.size()));
  const double variance = mean / (3.0 * share);
  // A pass moves it by the share that is found, on its way to where it stays.
  const double stride = std::min(1.0 / share, kLongestStride);
  errors->std *= std::pow(std::sqrt(variance) / errors->std, stride);
  errors->std = std::clamp(errors->std, kLeastSlowError, kMostSlowError);
}

}  // namespace

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
                   double share, std::vector<SensorModel>* models) {
  for (size_t k = 0; k < models->size(); ++k) {
    SensorModel& model = (*models)[k];
    const SensorBlocks& sensor = joint.sensors[k];
    // Where knots do not follow the motion, residuals of an IMU swing through zero and none of them
    // is right.
    const double reach =
        IsOfPoses(model.quantity) ? 0.0 : 0.5 * kSplineOrder * splines[model.session].spacing();
    const std::vector<double> around = MeanSquareAround(sensor, reach);
    for (size_t i = 0; i < sensor.samples.size(); ++i) {
      double& weight = model.weights[sensor.samples[i].index];
      const double shown =
          model.spread.Weight(std::max(around[i], sensor.residuals[i].squaredNorm()));
      weight *= std::pow(shown / weight, share);
    }
  }
}

void FitNoise(LeastSquares* joint, std::vector<SensorStatistics>* statistics) {
  for (size_t s = 0; s < joint->sessions.size(); ++s) {
    for (const bool is_linear : {true, false}) FitNoiseOf(is_linear, s, *joint, statistics);
    const Densities S = JointDensities(*joint, s);
    SessionEstimate& estimate = joint->estimate->sessions[s];
    UpdateSlowErrors(S, true, &estimate.position_errors);
    UpdateSlowErrors(S, false, &estimate.rotation_errors);
  }
}

}  // namespace imu_pose_calib
