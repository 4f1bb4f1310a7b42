#include "imu_pose_calib/core/calibrator.h"

#include <algorithm>
#include <cmath>
#include <memory>

#include "imu_pose_calib/core/conditioning.h"
#include "imu_pose_calib/core/gp_problem.h"
#include "imu_pose_calib/core/initializer.h"
#include "imu_pose_calib/core/joint_problem.h"
#include "imu_pose_calib/core/observability.h"
#include "imu_pose_calib/core/pose_trajectory.h"
#include "imu_pose_calib/core/so3.h"

namespace imu_pose_calib {
namespace {

constexpr double kNoiseAgreement = 1.1;  // factor between noise assumed and noise found
constexpr int kMinPasses = 3;            // of the joint solve: plain, robust, settled
constexpr int kMaxPasses = 6;
constexpr double kRoughTolerance = 1e-3;  // while noise and weights still change
constexpr double kJointTolerance = 1e-6;
constexpr double kGpTolerance = 1e-8;

constexpr double kExcerpt = 8.0;            // [s] on which the knot spacing is chosen
constexpr double kCoarsestKnots = 0.12;     // [s]
constexpr double kMinSamplesPerKnot = 4.0;  // IMU samples
constexpr double kShrinkage = 0.96;         // of gyro times accel residual that is worth more knots

/// Poses: as the GP's likelihood says. IMU: from densities, sigma = density sqrt(rate).
NoiseStd InitialNoise(const CalibrationOptions& options,
                      const PoseTrajectory& trajectory,
                      const ConditionedData& data) {
  NoiseStd noise;
  noise.position = trajectory.position_hyperparameters().noise_std;
  noise.rotation = trajectory.rotation_hyperparameters().noise_std;
  noise.gyro = options.gyro_noise_density * std::sqrt(data.gyro_report.rate_hz);
  noise.accel = options.accel_noise_density * std::sqrt(data.accel_report.rate_hz);
  return noise;
}

/// The `duration_s` of the log in which the marker turns most, as far as the IMU covers it.
ConditionedData LiveliestExcerpt(const ConditionedData& data,
                                 const PoseTrajectory& trajectory,
                                 const Estimate& estimate,
                                 double duration_s) {
  const double first = std::max(data.poses.front().t, data.gyro.front().t + estimate.time_shift);
  const double last = std::min(data.poses.back().t, data.gyro.back().t + estimate.time_shift);
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
  ConditionedData excerpt = data;
  excerpt.segments.clear();
  for (const IndexRange& segment : data.segments) {
    const auto index = [&](double t) {
      const auto segment_begin = data.poses.begin() + static_cast<ptrdiff_t>(segment.begin);
      const auto segment_end = data.poses.begin() + static_cast<ptrdiff_t>(segment.end);
      return static_cast<size_t>(
          std::lower_bound(segment_begin,
                           segment_end,
                           t,
                           [](const TimedPose& pose, double value) { return pose.t < value; }) -
          data.poses.begin());
    };
    const IndexRange part{index(begin), index(begin + duration_s)};
    if (part.size() >= 2) excerpt.segments.push_back(part);
  }
  return excerpt;
}

struct Solution {
  ResidualStatistics statistics;
  CalibrationCovariance covariance;
};

/// S3: rotation, gyro bias and time shift on the gyroscope; then everything on both sensors, twice:
/// each time with the noise that the residuals before show.
Solution SolveAgainstTrajectory(const CalibrationOptions& options,
                                const PoseTrajectory& trajectory,
                                const ConditionedData& data,
                                Estimate* estimate) {
  using Sensors = GpProblem::Sensors;
  NoiseStd noise = InitialNoise(options, trajectory, data);
  const auto solve = [&](Sensors sensors, double tolerance) {
    auto problem = std::make_unique<GpProblem>(options, trajectory, data, sensors, noise, estimate);
    problem->Solve(tolerance);
    noise = problem->Statistics().noise;
    return problem;
  };
  solve(Sensors::kGyro, kRoughTolerance);
  solve(Sensors::kGyroAndAccel, kRoughTolerance);
  const auto problem = solve(Sensors::kGyroAndAccel, kGpTolerance);
  return {problem->Statistics(), problem->Covariance()};
}

/// Largest factor between two noise estimates of one sensor.
double Change(const NoiseStd& a, const NoiseStd& b) {
  const auto factor = [](double x, double y) { return std::max(x / y, y / x); };
  return std::max({factor(a.position, b.position),
                   factor(a.rotation, b.rotation),
                   factor(a.gyro, b.gyro),
                   factor(a.accel, b.accel)});
}

/// S4 at one knot spacing: everything and the trajectory, again with the noise that the residuals
/// show and with robust weights until the noise found agrees with the noise assumed. The first pass
/// weights all samples alike: it does not know what is an outlier.
class JointSolver {
 public:
  JointSolver(const CalibrationOptions& options,
              const PoseTrajectory& trajectory,
              const ConditionedData& data,
              double knot_spacing_s,
              const NoiseStd& noise,
              Estimate* estimate)
      : options_(options),
        trajectory_(trajectory),
        data_(data),
        estimate_(estimate),
        noise_(noise),
        weights_(data),
        splines_(data, *estimate, knot_spacing_s) {}

  /// One pass; `statistics` describes its residuals.
  std::unique_ptr<JointProblem> Pass(double tolerance, ResidualStatistics* statistics) {
    auto problem = std::make_unique<JointProblem>(
        options_, trajectory_, data_, noise_, weights_, estimate_, &splines_);
    problem->Solve(tolerance);
    *statistics = problem->Statistics();
    assumed_ = noise_;
    noise_ = statistics->noise;
    problem->UpdateWeights(noise_, &weights_);
    return problem;
  }

  Solution Solve() {
    Solution solution;
    for (int pass = 1;; ++pass) {
      const double tolerance = pass < kMinPasses ? kRoughTolerance : kJointTolerance;
      const auto problem = Pass(tolerance, &solution.statistics);
      const bool consistent = Change(noise_, assumed_) < kNoiseAgreement;
      if (pass < kMinPasses || (!consistent && pass < kMaxPasses)) continue;
      solution.covariance = problem->Covariance();
      return solution;
    }
  }

 private:
  const CalibrationOptions& options_;
  const PoseTrajectory& trajectory_;
  const ConditionedData& data_;
  Estimate* const estimate_;
  NoiseStd noise_, assumed_;
  SampleWeights weights_;
  CorrectionSplines splines_;
};

/// Refines the knots on the liveliest seconds of the log until the IMU residuals stop shrinking.
double ChooseKnotSpacing(const CalibrationOptions& options,
                         const PoseTrajectory& trajectory,
                         const ConditionedData& data,
                         const Estimate& estimate) {
  if (options.knot_spacing_s > 0.0) return options.knot_spacing_s;
  const ConditionedData excerpt = LiveliestExcerpt(data, trajectory, estimate, kExcerpt);
  const double finest =
      kMinSamplesPerKnot / std::min(data.gyro_report.rate_hz, data.accel_report.rate_hz);
  const NoiseStd noise = InitialNoise(options, trajectory, data);
  double spacing = kCoarsestKnots;
  double residual_before = 0.0;
  for (;; spacing *= 0.5) {
    Estimate trial = estimate;
    JointSolver solver(options, trajectory, excerpt, spacing, noise, &trial);
    ResidualStatistics statistics;
    for (int pass = 1; pass < kMinPasses; ++pass) solver.Pass(kRoughTolerance, &statistics);
    const double residual = statistics.noise.gyro * statistics.noise.accel;
    const bool shrinks = residual_before == 0.0 || residual < kShrinkage * residual_before;
    if (!shrinks || 0.5 * spacing < finest) return spacing;
    residual_before = residual;
  }
}

void ReportData(const ConditionedData& data, Calibration* result) {
  result->poses = data.pose_report;
  result->gyro = data.gyro_report;
  result->accel = data.accel_report;
  result->segments = data.segments.size();
  result->gaps = data.gaps;
}

void ReportTrajectory(const PoseTrajectory& trajectory,
                      const ConditionedData& data,
                      Calibration* result) {
  result->position_lengthscale_s = trajectory.position_hyperparameters().lengthscale_s;
  result->rotation_lengthscale_s = trajectory.rotation_hyperparameters().lengthscale_s;
  double position2 = 0.0, rotation2 = 0.0, count = 0.0;
  for (const TimedPose& pose : data.poses) {
    if (!trajectory.Contains(pose.t)) continue;
    const PoseTrajectory::Pose smooth = trajectory.PoseAt(pose.t);
    position2 += (pose.p_WM - smooth.p_WM).squaredNorm();
    rotation2 += Log(Eigen::Quaterniond(smooth.q_WM.conjugate() * pose.q_WM)).squaredNorm();
    count += 3.0;
  }
  result->rms.position = std::sqrt(position2 / count);
  result->rms.rotation = std::sqrt(rotation2 / count);
}

void ReportEstimate(const Estimate& estimate,
                    const ResidualStatistics& statistics,
                    const ConditionedData& data,
                    Calibration* result) {
  result->T_MI = {estimate.q_MI.normalized(), estimate.p_MI};
  if (result->T_MI.q.w() < 0.0) result->T_MI.q.coeffs() *= -1.0;
  result->time_shift =
      1e-9 * static_cast<double>(data.pose_epoch_ns - data.imu_epoch_ns) + estimate.time_shift;
  result->accel_delay = estimate.accel_delay;
  result->g_W = estimate.g_W;
  result->gyro_bias = estimate.gyro_bias.Mean();
  result->accel_bias = estimate.accel_bias.Mean();
  result->noise = statistics.noise;
  result->rms.gyro = statistics.rms.gyro;
  result->rms.accel = statistics.rms.accel;
  if (statistics.rms.position == 0.0) return;  // the trajectory was not estimated
  result->rms.position = statistics.rms.position;
  result->rms.rotation = statistics.rms.rotation;
}

}  // namespace

Calibration Calibrate(const CalibrationOptions& options, const CalibrationData& data) {
  options.Validate();
  Calibration result;
  result.method = options.method;

  ConditionedData conditioned = Condition(options, data);
  const PoseTrajectory trajectory = FitTrajectory(options, &conditioned);
  ReportData(conditioned, &result);
  ReportTrajectory(trajectory, conditioned, &result);
  if (IsMotionDegenerate(MeasureTurns(trajectory, conditioned), &result)) return result;

  const Start start = Initialise(options, trajectory, conditioned);
  Estimate estimate(start, conditioned, options.bias_knot_interval_s);

  Solution solution;
  if (options.method == Method::kJoint) {
    result.knot_spacing_s = ChooseKnotSpacing(options, trajectory, conditioned, estimate);
    solution = JointSolver(options,
                           trajectory,
                           conditioned,
                           result.knot_spacing_s,
                           InitialNoise(options, trajectory, conditioned),
                           &estimate)
                   .Solve();
  } else {
    solution = SolveAgainstTrajectory(options, trajectory, conditioned, &estimate);
  }
  ReportEstimate(estimate, solution.statistics, conditioned, &result);
  GradeResult(options, solution.covariance, &result);
  return result;
}

const char* ToString(Status status) {
  switch (status) {
    case Status::kOk:
      return "ok";
    case Status::kWeak:
      return "weak";
    case Status::kDegenerate:
      return "degenerate";
    case Status::kNotRun:
      break;
  }
  return "not run";
}

const char* ToString(Method method) {
  switch (method) {
    case Method::kJoint:
      return "joint";
    case Method::kGp:
      break;
  }
  return "gp";
}

}  // namespace imu_pose_calib
