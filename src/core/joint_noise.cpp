#include "imu_pose_calib/core/joint_noise.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <utility>

#include "imu_pose_calib/core/band.h"
#include "imu_pose_calib/core/median.h"
#include "imu_pose_calib/core/parallel.h"

namespace imu_pose_calib {
namespace {

constexpr double kFewestPairs = 10.0;      // that do not overlap
constexpr size_t kMaxPositions = 200'000;  // of the windows: more do not change the median
constexpr double kLeastCovered = 0.75;     // of a window
/// A sample stands for the time until the next one, at most so many periods or so much of a window.
constexpr double kMaxCellPeriods = 2.0, kMaxCellShare = 0.25;

/// Weighted samples of one window.
struct Window {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  double count = 0.0;    ///< sum of the weights
  double squares = 0.0;  ///< sum of their squares
  double covered = 0.0;  ///< [s]

  Eigen::Vector3d Mean() const { return sum / count; }
  /// Of the mean, in units of one sample's.
  double Variance() const { return squares / (count * count); }
};

/// The samples and their sums. Those at the end of a window weigh by the part of their time that
/// is within it, so a mean is continuous in both ends of its window.
class Cells {
 public:
  Cells(const std::vector<double>& t, const std::vector<Eigen::Vector3d>& x, double max_width)
      : t_(t), x_(x), max_width_(max_width), sums_{Eigen::Vector3d::Zero()}, covered_{0.0} {
    for (size_t i = 0; i < t.size(); ++i) {
      sums_.push_back(sums_.back() + x[i]);
      covered_.push_back(covered_.back() + Width(i));
    }
  }

  /// The `tau` [s] before the stamp of sample j.
  Window Before(size_t j, double tau) const {
    const double begin = t_[j] - tau;
    const auto after = std::upper_bound(t_.begin(), t_.begin() + static_cast<ptrdiff_t>(j), begin);
    const auto first = static_cast<size_t>(after - t_.begin());
    Window window = Whole(first, j);
    if (first > 0) AddPart(first - 1, 1.0 - Elapsed(first - 1, begin), &window);
    return window;
  }

  /// The `tau` [s] from the stamp of sample j on.
  Window After(size_t j, double tau) const {
    const double end = t_[j] + tau;
    const auto after = std::upper_bound(t_.begin() + static_cast<ptrdiff_t>(j), t_.end(), end);
    const auto last = static_cast<size_t>(after - t_.begin()) - 1;
    Window window = Whole(j, last);
    AddPart(last, Elapsed(last, end), &window);
    return window;
  }

  /// [s]
  double Width(size_t i) const {
    return i + 1 < t_.size() ? std::min(t_[i + 1] - t_[i], max_width_) : max_width_;
  }

 private:
  /// Share of the time of sample i that is over at t [s].
  double Elapsed(size_t i, double t) const {
    const double width = Width(i);
    return t - t_[i] < width ? (t - t_[i]) / width : 1.0;
  }
  Window Whole(size_t begin, size_t end) const {
    const auto count = static_cast<double>(end - begin);
    return {sums_[end] - sums_[begin], count, count, covered_[end] - covered_[begin]};
  }
  void AddPart(size_t i, double weight, Window* window) const {
    window->sum += weight * x_[i];
    window->count += weight;
    window->squares += weight * weight;
    window->covered += weight * Width(i);
  }

  const std::vector<double>& t_;
  const std::vector<Eigen::Vector3d>& x_;
  const double max_width_;
  std::vector<Eigen::Vector3d> sums_;  ///< of the samples before
  std::vector<double> covered_;        ///< [s] by them
};

/// Frequency [Hz] times tau [s] at which the Allan deviation is most sensitive.
constexpr double kAllanBand = 0.37;
constexpr double kLongestAveraging = 1.0;  // [s] beyond it biases and few means blur the noise
/// Noise within the band over the spread of samples below which vibration beyond it is seen in the
/// spread, the least that is believed, and the windows that it takes to tell.
constexpr double kMostlyBeyond = 0.6, kLeastShare = 0.01, kLeastWindows = 40.0;
/// Knots on either side that act on the trajectory at a sample.
constexpr double kReach = 0.5 * kSplineOrder;

/// Mean squared residual of the samples within `reach` [s] of each, which are in order of time.
template <typename Samples>
std::vector<double> MeanSquareAround(const Samples& samples,
                                     const std::vector<Eigen::Vector3d>& residuals,
                                     double reach) {
  std::vector<double> means;
  size_t begin = 0, end = 0;
  double sum = 0.0;
  for (const auto& sample : samples) {
    for (; end < samples.size() && samples[end].t <= sample.t + reach; ++end)
      sum += residuals[end].squaredNorm();
    for (; samples[begin].t < sample.t - reach; ++begin) sum -= residuals[begin].squaredNorm();
    means.push_back(sum / static_cast<double>(end - begin));
  }
  return means;
}

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

/// The IMUs' share of the information on the spline that a quantity tells of, in the mean over the
/// spline's band [Hz].
double ImuShare(const JointDensities& S, Quantity quantity, double band) {
  constexpr int kSteps = 100;
  const double crossover = S.Crossover(quantity);
  double sum = 0.0;
  for (int k = 0; k < kSteps; ++k) {
    const double x = std::pow((k + 0.5) / kSteps * band / crossover, IsLinear(quantity) ? 4 : 2);
    sum += x / (1.0 + x);
  }
  return sum / kSteps;
}

std::vector<double> Times(const SensorBlocks& sensor) {
  std::vector<double> t;
  for (const ProblemSample& sample : sensor.samples) t.push_back(sample.t);
  return t;
}

}  // namespace

double AllanNoise(const std::vector<double>& t, const std::vector<Eigen::Vector3d>& x, double tau) {
  if (t.size() < 2) return 0.0;
  const Cells cells(t, x, std::max(kMaxCellPeriods * MedianStep(t), kMaxCellShare * tau));
  const size_t stride = t.size() / kMaxPositions + 1;
  std::vector<double> differences;
  double slid = 0.0;  // [s]
  for (size_t j = 1; j < t.size(); j += stride) {
    const Window a = cells.Before(j, tau), b = cells.After(j, tau);
    if (std::min(a.covered, b.covered) < kLeastCovered * tau) continue;
    const Eigen::Vector3d difference =
        (a.Mean() - b.Mean()) / std::sqrt(a.Variance() + b.Variance());
    differences.insert(differences.end(), difference.data(), difference.data() + 3);
    slid += static_cast<double>(stride) * cells.Width(j);
  }
  if (differences.empty() || slid < kFewestPairs * 2.0 * tau) return 0.0;
  return RobustSigma(std::move(differences));
}

void ShareFreedom(const CorrectionSplines& splines, size_t session, LeastSquares* joint) {
  const double band = Band(splines.spacing());
  // As many as there is noise in that band.
  const double points = static_cast<double>(splines.d.size()) * 2.0 * band * splines.spacing();
  const JointDensities S(*joint, session);
  for (SensorBlocks& sensor : joint->sensors) {
    const SensorModel& model = *sensor.model;
    if (model.session != session) continue;
    const double imus = ImuShare(S, model.quantity, band);
    const double share =
        IsOfPoses(model.quantity) ? 1.0 - imus : imus * S[model.quantity] / model.Density();
    sensor.fitted = share * points / std::max(1.0, static_cast<double>(sensor.samples.size()));
  }
}

bool DoPosesLead(const CorrectionSplines& splines, size_t session, const LeastSquares& joint) {
  const JointDensities S(joint, session);
  return ImuShare(S, Quantity::kAccel, Band(splines.spacing())) < 0.5;
}

void FeignInformation(const std::vector<CorrectionSplines>& splines, LeastSquares* joint) {
  constexpr int kSteps = 200;
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
      const double w2 = std::pow(2.0 * M_PI * (k + 0.5) * step, 2);
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
    const double scale2 = std::pow(model.spread * joint.options.robust_loss_scale, 2);
    for (size_t i = 0; i < sensor.samples.size(); ++i)
      model.weights[sensor.samples[i].index] =
          1.0 / (1.0 + sensor.residuals[i].squaredNorm() / scale2);
    if (IsOfPoses(model.quantity)) continue;
    // Where knots do not follow the motion, residuals swing through zero and none of them is right.
    const std::vector<double> around = MeanSquareAround(
        sensor.samples, sensor.residuals, kReach * splines[model.session].spacing());
    for (size_t i = 0; i < sensor.samples.size(); ++i)
      model.weights[sensor.samples[i].index] /= 1.0 + std::pow(around[i] / scale2, 2);
  }
}

std::vector<double> NoiseColor(const LeastSquares& joint,
                               const std::vector<SensorStatistics>& statistics) {
  std::vector<double> colors(joint.sensors.size());
  InParallel(joint.options.Threads(), joint.sensors.size(), [&](size_t k) {
    const SensorBlocks& sensor = joint.sensors[k];
    const JointDensities S(joint, sensor.model->session);
    const Quantity quantity = sensor.model->quantity;
    const double crossover = S.Crossover(quantity) * (IsOfPoses(quantity) ? 2.0 : 0.5);
    const double tau = std::min(kLongestAveraging, kAllanBand / crossover);
    colors[k] =
        std::max(1.0, AllanNoise(Times(sensor), sensor.residuals, tau) / statistics[k].noise);
  });
  return colors;
}

std::vector<double> NoiseInBand(const LeastSquares& joint,
                                const std::vector<CorrectionSplines>& splines,
                                const std::vector<SensorStatistics>& statistics) {
  std::vector<double> shares;
  for (size_t k = 0; k < joint.sensors.size(); ++k) {
    const SensorBlocks& sensor = joint.sensors[k];
    const size_t session = sensor.model->session;
    shares.push_back(1.0);
    if (IsOfPoses(sensor.model->quantity) || sensor.samples.empty()) continue;
    const JointDensities S(joint, session);
    const double tau = kAllanBand / (0.5 * std::min(S.Crossover(sensor.model->quantity),
                                                    Band(splines[session].spacing())));
    const double duration = sensor.samples.back().t - sensor.samples.front().t;
    if (tau > kLongestAveraging || duration < kLeastWindows * tau) continue;
    std::vector<Eigen::Vector3d> residuals = sensor.residuals;
    for (size_t i = 0; i < residuals.size(); ++i)
      residuals[i] -= joint.Rest(*sensor.model, sensor.samples[i].index);
    const double share = AllanNoise(Times(sensor), residuals, tau) / statistics[k].noise;
    if (share < kMostlyBeyond) shares.back() = std::max(share, kLeastShare);
  }
  return shares;
}

}  // namespace imu_pose_calib
