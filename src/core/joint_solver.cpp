#include "imu_pose_calib/core/joint_solver.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>

#include "imu_pose_calib/core/joint_problem.h"
#include "imu_pose_calib/core/so3.h"

namespace imu_pose_calib {
namespace {

/// Factor between noise assumed and noise found, over the log and where the search for it is cheap.
constexpr double kNoiseAgreement = 1.5, kNoiseSettled = 1.15;
constexpr int kMaxPasses = 6, kMaxNoisePasses = 10;

constexpr double kExcerpt = 8.0;            // [s] on which the knot spacing is chosen
constexpr double kCoarsestKnots = 0.12;     // [s]
constexpr double kMinSamplesPerKnot = 4.0;  // IMU samples
/// Of gyro times accel residual, by the last step, that is worth knots twice and 1.4 times as
/// dense.
constexpr double kShrinkage = 0.96, kSteepShrinkage = 0.5;

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

void Move(const CalibrationVector& step, Estimate* estimate) {
  estimate->p_MI += step.segment<3>(kTranslation);
  estimate->q_MI = (estimate->q_MI * Exp<double>(step.segment<3>(kRotation))).normalized();
  estimate->time_shift += step[kTimeShift];
  estimate->accel_delay += step[kAccelDelay];
  estimate->clock_drift += step[kClockDrift];
  estimate->pose_smoothing += step[kPoseSmoothing];
  estimate->gyro_intrinsics += step.segment<6>(kGyroIntrinsics);
  estimate->accel_intrinsics += step.segment<9>(kAccelIntrinsics);
}

/// S4 at one knot spacing: trajectory and calibration in passes of least squares, each with the
/// noise and the robust weights that the residuals of the one before show.
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

  /// The noise of a plain and a robust pass.
  NoiseStd FindNoise() {
    Pass();
    NextPass(statistics_.noise);
    return statistics_.noise;
  }

  /// After FindNoise(): until the noise hardly depends on the one that the search started from.
  NoiseStd SettleNoise() {
    int pass = 2;
    do ++pass;
    while (NextPass(statistics_.noise) > kNoiseSettled && pass < kMaxNoisePasses);
    return statistics_.noise;
  }

  /// Starts close to the solution: residuals about the calibration of the start tell what is an
  /// outlier before it can move the calibration. Linear growth of the time shift cannot be known by
  /// then.
  Solution Solve() {
    Pass(!options_.estimate_clock_drift);
    int pass = 1;
    do ++pass;
    while (NextPass(ColoredNoise()) > kNoiseAgreement && pass < kMaxPasses);
    // The last step, with weights by the last residuals, comes with the covariance.
    SetNoise(ColoredNoise());
    Build();
    const CalibrationCovariance covariance = problem_->Covariance();
    Move(covariance.step, estimate_);
    return {statistics_, covariance};
  }

 private:
  /// A problem with the noise and the weights that are set; at first, all weights are 1.
  void Build() {
    problem_.reset();  // never two of them at a time
    problem_ = std::make_unique<JointProblem>(
        options_, trajectory_, data_, noise_, weights_, estimate_, &splines_);
  }

  void Pass(bool hold_calibration = false) {
    Build();
    if (hold_calibration) problem_->HoldCalibration();
    problem_->Solve(kRoughTolerance);
    statistics_ = problem_->Statistics();
  }

  /// A pass with `noise` and the weights that follow from it and the last residuals; the largest
  /// factor by which the noise found changes.
  double NextPass(const NoiseStd& noise) {
    const NoiseStd before = statistics_.noise;
    SetNoise(noise);
    Pass();
    return Change(before, statistics_.noise);
  }

  NoiseStd ColoredNoise() const {
    return Scale(statistics_.noise, problem_->NoiseColor(statistics_.noise));
  }

  void SetNoise(const NoiseStd& noise) {
    noise_ = noise;
    problem_->UpdateWeights(noise, &weights_);
  }

  const CalibrationOptions& options_;
  const PoseTrajectory& trajectory_;
  const ConditionedData& data_;
  Estimate* const estimate_;
  NoiseStd noise_;
  SampleWeights weights_;
  CorrectionSplines splines_;
  std::unique_ptr<JointProblem> problem_;
  ResidualStatistics statistics_;  ///< of the last pass
};

}  // namespace

JointStart ChooseKnotSpacing(const CalibrationOptions& options,
                             const PoseTrajectory& trajectory,
                             const ConditionedData& data,
                             Estimate* estimate) {
  const NoiseStd initial = InitialNoise(options, trajectory, data);
  const ConditionedData excerpt = LiveliestExcerpt(data, trajectory, *estimate, kExcerpt);
  const bool is_given = options.knot_spacing_s > 0.0;
  const double finest =
      kMinSamplesPerKnot / std::min(data.gyro_report.rate_hz, data.accel_report.rate_hz);
  double spacing = is_given ? options.knot_spacing_s : kCoarsestKnots;
  double residual_before = std::numeric_limits<double>::infinity();
  for (;;) {
    Estimate trial = *estimate;
    JointSolver solver(options, trajectory, excerpt, {spacing, initial}, &trial);
    const NoiseStd noise = solver.FindNoise();
    const double residual = noise.gyro * noise.accel;
    const double shrinkage = residual / residual_before;
    const bool may_halve = 0.5 * spacing >= finest;
    const double next = (may_halve ? 0.5 : M_SQRT1_2) * spacing;
    const bool is_worth = shrinkage < (may_halve ? kShrinkage : kSteepShrinkage);
    if (is_given || !is_worth || next < finest) {
      const NoiseStd settled = solver.SettleNoise();
      *estimate = trial;
      return {spacing, settled};
    }
    residual_before = residual;
    spacing = next;
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
