#include "imu_pose_calib/core/calibration/joint_solver.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <optional>
#include <utility>

#include "imu_pose_calib/core/calibration/band.h"
#include "imu_pose_calib/core/calibration/joint_noise.h"
#include "imu_pose_calib/core/calibration/joint_problem.h"

namespace imu_pose_calib {
namespace {

/// Passes end when no noise changes by more than this factor, or with the last of so many.
constexpr double kSettled = 1.02;
constexpr int kMaxPasses = 40;

constexpr double kStep = 0.02;              // [s] between the instants looked at
constexpr double kExcerpt = 8.0;            // [s] on which the knot spacing is chosen
constexpr double kCoarsestKnots = 0.12;     // [s]
constexpr double kMinSamplesPerKnot = 4.0;  // IMU samples
/// Share of those seconds that knots must cover, more than the ends of two runs can be too short
/// for; and share of the samples of each sensor that they must hold.
constexpr double kLeastFollowed = 0.15, kLeastCovered = 0.1;
/// Of gyro times accel residual, that knots twice as dense have to leave at most.
constexpr double kShrinkage = 0.985;
/// Of the knot spacing at which noise hides what is left of the motion.
constexpr double kReserve = M_SQRT1_2;

/// The session without what splines of this spacing cannot follow.
PreparedSession Correctable(const CalibrationOptions& options, const PreparedSession& session,
                            double spacing) {
  return LimitBand(session, Band(spacing), options.Threads());
}

/// Those of the samples from `begin` to `end` [s, pose clock].
std::vector<TimedSample> Within(const std::vector<TimedSample>& samples,
                                const ImuSessionEstimate& clock, double begin, double end) {
  const auto first = std::lower_bound(
      samples.begin(), samples.end(), begin,
      [&clock](const TimedSample& s, double t) { return clock.PoseTime(s.t) < t; });
  return {first,
          std::upper_bound(first, samples.end(), end, [&clock](double t, const TimedSample& s) {
            return t < clock.PoseTime(s.t);
          })};
}

/// The log from `begin` to `end` [s, pose clock].
PreparedSession Excerpt(const PreparedSession& session, const SessionEstimate& estimate,
                        double begin, double end) {
  PreparedSession excerpt = session;
  for (size_t i = 0; i < session.data.imus.size(); ++i) {
    ConditionedImu& imu = excerpt.data.imus[i];
    imu.gyro = Within(imu.gyro, estimate.imus[i], begin, end);
    imu.accel = Within(imu.accel, estimate.imus[i], begin, end);
    if (imu.gyro.empty() || imu.accel.empty()) imu = ConditionedImu();
  }
  std::vector<TimedPose>& poses = excerpt.data.poses;
  poses.clear();
  excerpt.data.segments.clear();
  for (const IndexRange& segment : session.data.segments) {
    const size_t first = poses.size();
    for (size_t i = segment.begin; i < segment.end; ++i)
      if (session.data.poses[i].t >= begin && session.data.poses[i].t <= end)
        poses.push_back(session.data.poses[i]);
    if (poses.size() >= first + 2) excerpt.data.segments.push_back({first, poses.size()});
  }
  return excerpt;
}

/// Whether both sensors of every IMU have samples for enough of the time from `begin` to `end` [s,
/// pose clock].
bool IsCovered(const PreparedSession& session, const SessionEstimate& estimate, double begin,
               double end) {
  for (size_t i = 0; i < session.data.imus.size(); ++i) {
    const ConditionedImu& imu = session.data.imus[i];
    const auto is_covered = [&](const std::vector<TimedSample>& samples, double rate_hz) {
      const size_t count = Within(samples, estimate.imus[i], begin, end).size();
      return static_cast<double>(count) > kLeastCovered * (end - begin) * rate_hz;
    };
    if (imu.IsPresent() && (!is_covered(imu.gyro, imu.gyro_report.rate_hz) ||
                            !is_covered(imu.accel, imu.accel_report.rate_hz)))
      return false;
  }
  return true;
}

struct ExcitedSpan {
  double begin = 0.0, end = 0.0;  ///< [s] pose clock
  double excitation = -1.0;       ///< see JointStart; negative: there is none
};

/// The `duration_s` of the log in which the marker turns most, as far as `knots` cover it.
ExcitedSpan FindLiveliest(const PreparedSession& session, const SessionEstimate& estimate,
                          const CorrectionSplines& knots, double duration_s) {
  double first = session.data.poses.front().t, last = session.data.poses.back().t;
  for (size_t i = 0; i < session.data.imus.size(); ++i) {
    const ConditionedImu& imu = session.data.imus[i];
    if (!imu.IsPresent()) continue;
    first = std::max(first, estimate.imus[i].PoseTime(imu.gyro.front().t));
    last = std::min(last, estimate.imus[i].PoseTime(imu.gyro.back().t));
  }
  ExcitedSpan best{first, first + duration_s};
  for (double t = first; t + 0.5 * duration_s < last; t += 0.5 * duration_s) {
    double sum = 0.0, followed = 0.0;
    for (double s = t; s < std::min(last, t + duration_s); s += kStep) {
      MarkerRotation<double> marker;
      if (!knots.Locate(s) || !session.trajectory->EvaluateRotation(s, &marker)) continue;
      sum += marker.alpha_M.squaredNorm();
      followed += kStep / duration_s;
    }
    const double excitation = kStep / duration_s * sum;
    if (excitation <= best.excitation || followed < kLeastFollowed ||
        !IsCovered(session, estimate, t, std::min(last, t + duration_s)))
      continue;
    best = {t, t + duration_s, excitation};
  }
  return best;
}

/// S4 at given knot spacings: trajectories and calibration in passes of least squares, each with
/// the noise and the robust weights that the residuals of the one before show.
class JointSolver {
 public:
  JointSolver(const CalibrationOptions& options, std::vector<PreparedSession>* sessions,
              const std::vector<double>& knot_spacings_s, const std::vector<double>& noise,
              Estimate* estimate)
      : options_(options),
        sessions_(sessions),
        estimate_(estimate),
        models_(InitialModels(options, *sessions)) {
    for (size_t k = 0; k < noise.size(); ++k) models_[k].noise = noise[k];
    for (size_t s = 0; s < sessions->size(); ++s) {
      splines_.emplace_back((*sessions)[s].data, *estimate, s, knot_spacings_s[s]);
      const std::vector<TimedPose>& poses = (*sessions)[s].data.poses;
      estimate->sessions[s].rotation_errors = SlowErrors(poses.front().t, poses.back().t);
    }
  }

  const std::vector<SensorModel>& models() const { return models_; }

  /// A plain and a robust pass. What IMUs leave, over all of them: it shrinks while knots become
  /// denser for a reason.
  double FindNoise() {
    Pass();
    SetNoise();
    if (!Pass()) ThrowNotConverged(options_);
    double residual = 1.0, imus = 0.0;
    for (size_t k = 0; k < models_.size(); ++k) {
      const Quantity quantity = models_[k].quantity;
      if (quantity == Quantity::kGyro || quantity == Quantity::kAccel)
        residual *= statistics_[k].spread.scale;
      if (quantity == Quantity::kGyro) imus += 1.0;
    }
    return std::pow(residual, 1.0 / imus);
  }

  /// Of each sensor, as the last residuals show it.
  std::vector<double> Noise() const {
    std::vector<double> noise;
    for (const SensorStatistics& sensor : statistics_) noise.push_back(sensor.noise);
    return noise;
  }

  /// Starts close to the solution.
  Solution Solve() {
    bool has_converged = Pass();
    Solution solution;
    solution.has_settled = false;
    for (int pass = 1; pass < kMaxPasses && !solution.has_settled; ++pass) {
      const std::vector<double> before = Noise();
      SetNoise();
      if (pass == 1) MoveTrajectories();
      has_converged = Pass();
      double change = 1.0;
      for (size_t k = 0; k < before.size(); ++k)
        change =
            std::max({change, before[k] / statistics_[k].noise, statistics_[k].noise / before[k]});
      solution.has_settled = change < kSettled && has_converged;
    }
    if (!has_converged) ThrowNotConverged(options_);
    SetNoise();
    Build();
    AddSpuriousInformation(splines_, problem_.get());
    solution.marginals = FindMarginals(problem_.get());
    solution.statistics = statistics_;
    // Of everything: trajectories, gravity and biases too.
    problem_->Move(solution.marginals.step);
    solution.residuals = problem_->TakeResiduals();
    problem_.reset();
    solution.models = std::move(models_);
    solution.splines = std::move(splines_);
    solution.iterations = iterations_;
    return solution;
  }

 private:
  /// A problem with the noise and the weights that are set; at first, all weights are 1.
  void Build() {
    problem_.reset();  // never two of them at a time
    std::vector<const double*> held = at_bound_;
    // Second derivatives of a trajectory that is not corrected hold the noise of the poses.
    if (!are_moved_)
      for (const ImuEstimate& imu : estimate_->imus)
        held.insert(held.end(), {&imu.accel_smoothing, &imu.mount_compliance});
    problem_ = BuildJointProblem(options_, *sessions_, models_, estimate_, &splines_, held);
  }

  /// Whether it has converged: if not, another one starts closer to the solution, and may.
  bool Pass() {
    Build();
    const std::optional<int> iterations = problem_->Solve(kRoughTolerance);
    iterations_ += iterations.value_or(options_.max_iterations);
    statistics_ = problem_->FindStatistics();
    FitNoise(problem_.get(), &statistics_);
    // No source averages rotations over longer than positions, and no mount gives way upwards:
    // other errors look like that.
    HoldAtZero(&estimate_->position_smoothing);
    for (ImuEstimate& imu : estimate_->imus) HoldAtZero(&imu.mount_compliance);
    return iterations.has_value();
  }

  /// Unless it is positive.
  void HoldAtZero(double* parameter) {
    if (*parameter >= 0.0) return;
    *parameter = 0.0;
    at_bound_.push_back(parameter);
  }

  /// To the solution, as far as they can hold it; the splines begin anew.
  void MoveTrajectories() {
    are_moved_ = true;
    for (size_t s = 0; s < sessions_->size(); ++s) {
      PreparedSession& session = (*sessions_)[s];
      CorrectionSplines& splines = splines_[s];
      std::vector<TimedPose> poses = session.data.poses;
      for (TimedPose& pose : poses) {
        if (const auto corrected = splines.Correct(*session.trajectory, pose.t)) {
          pose.q_WM = corrected->q_WM;
          pose.p_WM = corrected->p_WM;
        } else {
          const Rigid3 T_WM = session.trajectory->PoseAt(pose.t);
          pose.q_WM = T_WM.q;
          pose.p_WM = T_WM.p;
        }
      }
      session.trajectory =
          SmoothTrajectory(session, std::move(poses), Band(splines.spacing()), options_.Threads());
      std::fill(splines.d.begin(), splines.d.end(), Eigen::Vector3d::Zero());
      std::fill(splines.phi.begin(), splines.phi.end(), Eigen::Vector3d::Zero());
    }
  }

  /// As the last residuals show it.
  void SetNoise() {
    for (size_t k = 0; k < models_.size(); ++k) {
      models_[k].noise = statistics_[k].noise;
      models_[k].spread = statistics_[k].spread;
    }
    UpdateWeights(*problem_, splines_, &models_);
  }

  const CalibrationOptions& options_;
  std::vector<PreparedSession>* const sessions_;
  Estimate* const estimate_;
  std::vector<SensorModel> models_;
  std::vector<CorrectionSplines> splines_;
  std::unique_ptr<LeastSquares> problem_;
  std::vector<SensorStatistics> statistics_;  ///< of the last pass
  std::vector<const double*> at_bound_;       ///< parameters that stay 0
  bool are_moved_ = false;                    ///< trajectories
  int iterations_ = 0;
};

/// An excerpt solved at one knot spacing.
struct Trial {
  std::vector<PreparedSession> sessions;
  Estimate estimate;
  JointSolver solver;
  double residual;

  Trial(const CalibrationOptions& options, const PreparedSession& excerpt, double spacing,
        const Estimate& start)
      : sessions{Correctable(options, excerpt, spacing)},
        estimate(start),
        solver(options, &sessions, {spacing}, {}, &estimate),
        residual(solver.FindNoise()) {}
};

/// A trial that is worth having only if it comes to an end: nothing where it does not.
std::unique_ptr<Trial> TryDenser(const CalibrationOptions& options, const PreparedSession& excerpt,
                                 double spacing, const Estimate& start) {
  try {
    return std::make_unique<Trial>(options, excerpt, spacing, start);
  } catch (const DataError&) {
    return nullptr;
  }
}

}  // namespace

JointStart ChooseKnotSpacing(const CalibrationOptions& options, const PreparedSession& session,
                             Estimate* estimate) {
  const bool is_given = options.knot_spacing_s > 0.0;
  double spacing = is_given ? options.knot_spacing_s : kCoarsestKnots;
  const ExcitedSpan span =
      FindLiveliest(session, estimate->sessions[0],
                    CorrectionSplines(session.data, *estimate, 0, spacing), kExcerpt);
  if (span.excitation < 0.0)
    throw DataError("there are no seconds in which poses and the samples of every imu are there");
  const PreparedSession excerpt = Excerpt(session, estimate->sessions[0], span.begin, span.end);
  auto best = std::make_unique<Trial>(options, excerpt, spacing, *estimate);
  double slowest = std::numeric_limits<double>::infinity();
  for (const SensorModel& model : best->solver.models())
    if (model.quantity == Quantity::kGyro || model.quantity == Quantity::kAccel)
      slowest = std::min(slowest, model.rate_hz);
  const double finest = kMinSamplesPerKnot / slowest;
  while (!is_given && 0.5 * spacing >= finest) {
    auto denser = TryDenser(options, excerpt, 0.5 * spacing, *estimate);
    if (!denser || !(denser->residual <= kShrinkage * best->residual)) break;
    best = std::move(denser);
    spacing *= 0.5;
  }
  // Motion that the knots do not follow mimics a lever arm long before the noise shows it.
  if (!is_given && kReserve * spacing >= finest) {
    if (auto denser = TryDenser(options, excerpt, kReserve * spacing, *estimate)) {
      best = std::move(denser);
      spacing *= kReserve;
    }
  }
  const std::vector<double> noise = best->solver.Noise();
  const SessionEstimate start = estimate->sessions[0];
  *estimate = best->estimate;
  // Seconds do not tell where the samples of hours are: S2 does.
  for (size_t i = 0; i < start.imus.size(); ++i) {
    const double reach = session.data.poses.back().t - session.data.poses.front().t;
    ImuSessionEstimate& clock = estimate->sessions[0].imus[i];
    if (std::abs(clock.clock_drift - start.imus[i].clock_drift) * reach <= spacing &&
        clock.walk.IsLine())
      continue;
    static_cast<ClockLine&>(clock) = start.imus[i];
    clock.walk = start.imus[i].walk;
  }
  return {spacing, Correctable(options, session, spacing), noise, span.excitation};
}

Solution SolveJointly(const CalibrationOptions& options, const std::vector<JointStart>& starts,
                      std::vector<PreparedSession>* sessions, Estimate* estimate) {
  std::vector<double> spacings, noise;
  for (const JointStart& start : starts) {
    spacings.push_back(start.knot_spacing_s);
    noise.insert(noise.end(), start.noise.begin(), start.noise.end());
  }
  return JointSolver(options, sessions, spacings, noise, estimate).Solve();
}

}  // namespace imu_pose_calib
