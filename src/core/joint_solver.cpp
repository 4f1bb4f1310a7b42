#include "imu_pose_calib/core/joint_solver.h"

#include <algorithm>
#include <cmath>
#include <memory>

#include "imu_pose_calib/core/joint_problem.h"

namespace imu_pose_calib {
namespace {

constexpr double kNoiseAgreement = 1.25;  // factor between noise assumed and noise found
constexpr int kMinPasses = 2;             // plain, robust
constexpr int kMaxPasses = 6;
/// Change of the cost, half the sum of squares in sigma, after which the last pass stops: no
/// parameter is notably off in its sigma.
constexpr double kSettled = 0.3;

constexpr double kExcerpt = 8.0;            // [s] on which the knot spacing is chosen
constexpr double kCoarsestKnots = 0.12;     // [s]
constexpr double kMinSamplesPerKnot = 4.0;  // IMU samples
constexpr double kShrinkage = 0.96;         // of gyro times accel residual that is worth more knots

/// Samples of the log from `begin` to `end` [s, pose clock].
ConditionedData Excerpt(const ConditionedData& data,
                        const Estimate& estimate,
                        double begin,
                        double end) {
  const auto crop = [&](std::vector<TimedSample>* samples) {
    const auto is_outside = [&](const TimedSample& s) {
      const double t = estimate.PoseTime(s.t);
      return t < begin || t > end;
    };
    samples->erase(std::remove_if(samples->begin(), samples->end(), is_outside), samples->end());
  };
  ConditionedData excerpt = data;
  crop(&excerpt.gyro);
  crop(&excerpt.accel);
  excerpt.poses.clear();
  excerpt.segments.clear();
  for (const IndexRange& segment : data.segments) {
    const size_t first = excerpt.poses.size();
    for (size_t i = segment.begin; i < segment.end; ++i)
      if (data.poses[i].t >= begin && data.poses[i].t <= end)
        excerpt.poses.push_back(data.poses[i]);
    if (excerpt.poses.size() >= first + 2)
      excerpt.segments.push_back({first, excerpt.poses.size()});
  }
  return excerpt;
}

/// The `duration_s` of the log in which the marker turns most, as far as the IMU covers it.
ConditionedData LiveliestExcerpt(const ConditionedData& data,
                                 const PoseTrajectory& trajectory,
                                 const Estimate& estimate,
                                 double duration_s) {
  const double first = std::max(data.poses.front().t, estimate.PoseTime(data.gyro.front().t));
  const double last = std::min(data.poses.back().t, estimate.PoseTime(data.gyro.back().t));
  double begin = first, liveliest = -1.0;
  for (double t = first; t + 0.5 * duration_s < last; t += 0.5 * duration_s) {
    double sum = 0.0;
    for (double s = t; s < std::min(last, t + duration_s); s += 0.02) {
      MarkerState<double> state;
      if (trajectory.Evaluate(s, &state)) sum += state.alpha_M.squaredNorm();
    }
    if (sum <= liveliest) continue;
    liveliest = sum;
    begin = t;
  }
  return Excerpt(data, estimate, begin, begin + duration_s);
}

/// Largest factor between two noise estimates of one sensor.
double Change(const NoiseStd& a, const NoiseStd& b) {
  const auto factor = [](double x, double y) { return std::max(x / y, y / x); };
  return std::max({factor(a.position, b.position),
                   factor(a.rotation, b.rotation),
                   factor(a.gyro, b.gyro),
                   factor(a.accel, b.accel)});
}

NoiseStd Scale(const NoiseStd& noise, const NoiseStd& factor) {
  return {noise.position * factor.position,
          noise.rotation * factor.rotation,
          noise.gyro * factor.gyro,
          noise.accel * factor.accel};
}

/// S4 at one knot spacing: everything and the trajectory, again with the noise that the residuals
/// show and with robust weights until the noise found agrees with the noise assumed. The first pass
/// weights all samples alike: it does not know what is an outlier.
class JointSolver {
 public:
  JointSolver(const CalibrationOptions& options,
              const PoseTrajectory& trajectory,
              const ConditionedData& data,
              const JointStart& start,
              Estimate* estimate)
      : options_(options),
        trajectory_(trajectory),
        data_(data),
        estimate_(estimate),
        noise_(start.noise),
        weights_(data),
        splines_(data, *estimate, start.knot_spacing_s) {}

  /// One pass; `statistics` describes its residuals. True when the noise they show agrees with the
  /// noise assumed.
  bool Pass(double tolerance, ResidualStatistics* statistics) {
    problem_.reset();  // never two of them at a time
    problem_ = std::make_unique<JointProblem>(
        options_, trajectory_, data_, noise_, weights_, estimate_, &splines_);
    problem_->Solve(tolerance);
    *statistics = problem_->Statistics();
    const NoiseStd found = Scale(statistics->noise, color_);
    const bool agrees = Change(noise_, found) < kNoiseAgreement;
    SetNoise(found);
    return agrees;
  }

  Solution Solve() {
    Solution solution;
    Pass(kRoughTolerance, &solution.statistics);
    color_ = problem_->NoiseColor(solution.statistics.noise);
    SetNoise(Scale(solution.statistics.noise, color_));
    for (int pass = kMinPasses; pass <= kMaxPasses; ++pass)
      if (Pass(kSettled / ExpectedCost(), &solution.statistics)) break;
    solution.covariance = problem_->Covariance();
    return solution;
  }

 private:
  void SetNoise(const NoiseStd& noise) {
    noise_ = noise;
    problem_->UpdateWeights(noise, &weights_);
  }

  /// The cost when every residual is as large as its spread.
  double ExpectedCost() const {
    const auto cost = [](size_t samples, double color) {
      return 1.5 * static_cast<double>(samples) / (color * color);
    };
    return cost(data_.poses.size(), color_.position) + cost(data_.poses.size(), color_.rotation) +
           cost(data_.gyro.size(), color_.gyro) + cost(data_.accel.size(), color_.accel);
  }

  const CalibrationOptions& options_;
  const PoseTrajectory& trajectory_;
  const ConditionedData& data_;
  Estimate* const estimate_;
  NoiseStd noise_;
  SampleWeights weights_;
  NoiseStd color_{1.0, 1.0, 1.0, 1.0};  ///< see JointProblem::NoiseColor()
  CorrectionSplines splines_;
  std::unique_ptr<JointProblem> problem_;
};

}  // namespace

JointStart ChooseKnotSpacing(const CalibrationOptions& options,
                             const PoseTrajectory& trajectory,
                             const ConditionedData& data,
                             Estimate* estimate) {
  const NoiseStd noise = InitialNoise(options, trajectory, data);
  if (options.knot_spacing_s > 0.0) return {options.knot_spacing_s, noise};
  const ConditionedData excerpt = LiveliestExcerpt(data, trajectory, *estimate, kExcerpt);
  const double finest =
      kMinSamplesPerKnot / std::min(data.gyro_report.rate_hz, data.accel_report.rate_hz);
  double residual_before = 0.0;
  for (double spacing = kCoarsestKnots;; spacing *= 0.5) {
    Estimate trial = *estimate;
    JointSolver solver(options, trajectory, excerpt, {spacing, noise}, &trial);
    ResidualStatistics statistics;
    for (int pass = 1; pass <= kMinPasses; ++pass) solver.Pass(kRoughTolerance, &statistics);
    const double residual = statistics.noise.gyro * statistics.noise.accel;
    const bool shrinks = residual_before == 0.0 || residual < kShrinkage * residual_before;
    if (!shrinks || 0.5 * spacing < finest) {
      *estimate = trial;
      return {spacing, statistics.noise};
    }
    residual_before = residual;
  }
}

Solution SolveJointly(const CalibrationOptions& options,
                      const PoseTrajectory& trajectory,
                      const ConditionedData& data,
                      const JointStart& start,
                      Estimate* estimate) {
  return JointSolver(options, trajectory, data, start, estimate).Solve();
}

}  // namespace imu_pose_calib
