#include "imu_pose_calib/core/joint_noise.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "imu_pose_calib/core/band.h"

namespace imu_pose_calib {
namespace {

/// The noise of an IMU within the band is looked at below the frequency where poses and IMU meet,
/// in no less than this [Hz]: longer means are few.
constexpr double kLowestBand = 1.0;
constexpr int kSteps = 200;  // of integrals over frequency
/// Parameters of the calibration that follow an axis of an IMU, beside its bias.
constexpr double kOtherParameters = 4.0;
/// Bounds of the sigma of slow errors [rad]: nothing beside the noise of poses, with which H stays
/// regular; and beyond what is an error.
constexpr double kLeastRotationError = 1e-5, kMostRotationError = 0.1;
constexpr double kLongestStride = 3.0;  // of a pass, in what it finds

bool IsOfPoses(Quantity quantity) {
  return quantity == Quantity::kPosition || quantity == Quantity::kRotation;
}

bool IsLinear(Quantity quantity) {
  return quantity == Quantity::kPosition || quantity == Quantity::kAccel;
}

/// Densities of the noise that sensors of one kind have together in a session, as they tell of the
/// same motion.
class JointDensities {
 public:
  JointDensities(const LeastSquares& joint, size_t session) {
    for (const SensorBlocks& sensor : joint.sensors)
      if (sensor.model->session == session)
        information_[static_cast<size_t>(sensor.model->quantity)] += 1.0 / sensor.model->Density();
  }
  double operator[](Quantity quantity) const {
    return 1.0 / information_[static_cast<size_t>(quantity)];
  }

  /// [Hz] above which the IMUs say more of the trajectory than the poses do: S_a = W^4 S_p and
  /// S_g = W^2 S_R, W = 2 pi frequency.
  double Crossover(Quantity quantity) const {
    const JointDensities& S = *this;
    return (IsLinear(quantity) ? std::pow(S[Quantity::kAccel] / S[Quantity::kPosition], 0.25)
                               : std::sqrt(S[Quantity::kGyro] / S[Quantity::kRotation])) /
           (2.0 * M_PI);
  }

 private:
  std::array<double, 4> information_{};
};

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

/// Densities of what poses and IMUs err by, of positions or rotations, at a frequency.
struct Errors {
  double poses, imus;
  double slow = 0.0;  ///< of poses, beside the white noise
};

Errors ErrorsAt(const JointDensities& S, Quantity quantity, double omega2) {
  return IsLinear(quantity)
             ? Errors{S[Quantity::kPosition], S[Quantity::kAccel] / (omega2 * omega2)}
             : Errors{S[Quantity::kRotation], S[Quantity::kGyro] / omega2};
}

double Omega2(double frequency) { return std::pow(2.0 * M_PI * frequency, 2); }

/// In the mean over the spline's band [Hz].
double ImuShare(const JointDensities& S, Quantity quantity, double band) {
  double sum = 0.0;
  for (int k = 0; k < kSteps; ++k) {
    const Errors errors = ErrorsAt(S, quantity, Omega2((k + 0.5) / kSteps * band));
    sum += errors.poses / (errors.poses + errors.imus);
  }
  return sum / kSteps;
}

/// A sensor's share of the share of its kind.
double OwnShare(const JointDensities& S, const SensorModel& model, double imus) {
  return IsOfPoses(model.quantity) ? 1.0 - imus : imus * S[model.quantity] / model.Density();
}

/// Means that see what the trajectory leaves of a sensor's noise, doc/math.md, S4, "Noise".
BandMeans MeansOf(const JointDensities& S,
                  const SensorModel& model,
                  const SlowErrors& errors,
                  double band) {
  const double highest = IsOfPoses(model.quantity)
                             ? band
                             : std::min(band, std::max(kLowestBand, S.Crossover(model.quantity)));
  BandMeans means;
  means.samples = std::max(1, static_cast<int>(std::round(0.5 * model.rate_hz / highest)));
  const double length = means.samples / model.rate_hz;
  const double end = std::min(band, 0.5 * model.rate_hz);
  double sum = 0.0;
  for (int k = 0; k < kSteps; ++k) {
    const double frequency = (k + 0.5) / kSteps * end, x = M_PI * frequency * length;
    const double passed = means.samples > 1 ? std::pow(std::sin(x) / x, 2) : 1.0;
    Errors at = ErrorsAt(S, model.quantity, Omega2(frequency));
    if (!IsLinear(model.quantity)) at.slow = errors.Density(Omega2(frequency));
    const double all = at.poses + at.slow + at.imus;
    sum +=
        passed * (IsOfPoses(model.quantity) ? at.poses / all
                                            : 1.0 - OwnShare(S, model, (at.poses + at.slow) / all));
  }
  means.left = 2.0 * length * end * sum / kSteps;
  return means;
}

}  // namespace

void ShareFreedom(const CorrectionSplines& splines, size_t session, LeastSquares* joint) {
  const double band = Band(splines.spacing());
  // As many as there is noise in that band.
  const double points = static_cast<double>(splines.d.size()) * 2.0 * band * splines.spacing();
  const JointDensities S(*joint, session);
  for (SensorBlocks& sensor : joint->sensors) {
    const SensorModel& model = *sensor.model;
    if (model.session != session) continue;
    const double share = OwnShare(S, model, ImuShare(S, model.quantity, band));
    const SessionEstimate& own = joint->estimate->sessions[session];
    sensor.means = MeansOf(S, model, own.rotation_errors, band);
    if (!IsOfPoses(model.quantity))
      sensor.means.left -=
          (kOtherParameters + static_cast<double>(own.imus[model.imu].gyro_bias.t.size())) /
          (1.0 + static_cast<double>(sensor.samples.size()) / sensor.means.samples);
    sensor.fitted = share * points / std::max(1.0, static_cast<double>(sensor.samples.size()));
  }
}

bool DoPosesLead(const CorrectionSplines& splines, size_t session, const LeastSquares& joint) {
  const JointDensities S(joint, session);
  return ImuShare(S, Quantity::kAccel, Band(splines.spacing())) < 0.5;
}

void FeignInformation(const std::vector<CorrectionSplines>& splines, LeastSquares* joint) {
  constexpr size_t kEnough = 2000;  // samples, of which the mean is taken
  for (const SensorBlocks& sensor : joint->sensors) {
    if (sensor.model->quantity != Quantity::kAccel) continue;
    const size_t session = sensor.model->session;
    const PoseTrajectory& trajectory = *joint->sessions[session].trajectory;
    const JointDensities S(*joint, session);
    double turn2 = 0.0, seen = 0.0;
    for (size_t i = 0; i < sensor.samples.size(); i += 1 + sensor.samples.size() / kEnough) {
      MarkerRotation<double> marker;
      if (!trajectory.EvaluateRotation(sensor.samples[i].t, &marker)) continue;
      turn2 += marker.omega_M.squaredNorm();
      seen += 1.0;
    }
    if (seen == 0.0) continue;
    const double band = Band(splines[session].spacing()), step = band / kSteps;  // [Hz]
    double density = 0.0;  // information per second
    for (int k = 0; k < kSteps; ++k) {
      const double w2 = Omega2((k + 0.5) * step);
      const double omega =
          1.0 / (1.0 / S[Quantity::kGyro] +
                 1.0 / (w2 * S[Quantity::kRotation]));  // poses and gyroscope add up
      const double lever = LeverArmCoefficientVariance(w2 * omega, omega, turn2 / seen);
      density += 2.0 * step * lever / (sensor.model->Density() + w2 * w2 * S[Quantity::kPosition]);
    }
    joint->feigned_information[sensor.model->imu] +=
        static_cast<double>(sensor.samples.size()) / sensor.model->rate_hz * density;
  }
}

void UpdateWeights(const LeastSquares& joint,
                   const std::vector<CorrectionSplines>& splines,
                   std::vector<SensorModel>* models) {
  for (size_t k = 0; k < models->size(); ++k) {
    SensorModel& model = (*models)[k];
    const SensorBlocks& sensor = joint.sensors[k];
    // Where knots do not follow the motion, residuals of an IMU swing through zero and none of them
    // is right.
    const double reach =
        IsOfPoses(model.quantity) ? 0.0 : 0.5 * kSplineOrder * splines[model.session].spacing();
    const std::vector<double> around = MeanSquareAround(sensor, reach);
    for (size_t i = 0; i < sensor.samples.size(); ++i)
      model.weights[sensor.samples[i].index] =
          model.spread.Weight(std::max(around[i], sensor.residuals[i].squaredNorm()));
  }
}

void UpdateRotationErrors(LeastSquares* joint) {
  for (size_t s = 0; s < joint->sessions.size(); ++s) {
    SlowErrors& errors = joint->estimate->sessions[s].rotation_errors;
    const JointDensities S(*joint, s);
    const double interval = errors.knots.t[1] - errors.knots.t[0];
    double increments2 = 0.0, share = 0.0;
    for (size_t k = 0; k + 1 < errors.knots.t.size(); ++k)
      increments2 +=
          (errors.knots.values[k + 1] - errors.Kept(k) * errors.knots.values[k]).squaredNorm() /
          (1.0 - errors.Kept(k) * errors.Kept(k));
    for (int k = 0; k < kSteps; ++k) {
      const double omega2 = Omega2(0.5 * (k + 0.5) / kSteps / interval);
      const double own = errors.Density(omega2);
      share += own / (own + S[Quantity::kRotation] + S[Quantity::kGyro] / omega2) / kSteps;
    }
    const double variance =
        increments2 / (3.0 * static_cast<double>(errors.knots.t.size() - 1) * share);
    // A pass moves it by the share that is found, on its way to where it stays.
    const double stride = std::min(1.0 / share, kLongestStride);
    errors.std *= std::pow(std::sqrt(variance) / errors.std, stride);
    errors.std = std::clamp(errors.std, kLeastRotationError, kMostRotationError);
  }
}

}  // namespace imu_pose_calib
