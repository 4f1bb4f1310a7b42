#include "imu_pose_calib/core/joint_solver.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <optional>
#include <utility>

#include "imu_pose_calib/core/band.h"
#include "imu_pose_calib/core/joint_noise.h"
#include "imu_pose_calib/core/joint_problem.h"

namespace imu_pose_calib {
namespace {

/// Factor between noise assumed and noise found, over the log and where the search for it is cheap.
constexpr double kNoiseAgreement = 1.5, kNoiseSettled = 1.15;
constexpr int kMaxPasses = 6, kMaxNoisePasses = 10;

/// Of the noise of poses that S1 finds: a trajectory that follows every pose shows none.
constexpr double kLeastPositionNoise = 0.25, kLeastRotationNoise = 0.1;

/// Sigmas of a size effect that is shown, and of one that could be with other weights.
constexpr double kShownSize = 5.0, kPossibleSize = 3.0;

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
PreparedSession Correctable(const CalibrationOptions& options,
                            const PreparedSession& session,
                            double spacing) {
  return LimitBand(session, Band(spacing), options.Threads());
}

/// Samples of the log from `begin` to `end` [s, pose clock].
PreparedSession Excerpt(const PreparedSession& session,
                        const SessionEstimate& estimate,
                        double begin,
                        double end) {
  PreparedSession excerpt{{}, session.trajectory, session.starts, session.pose_noise};
  const ConditionedData& data = session.data;
  excerpt.data.pose_epoch_ns = data.pose_epoch_ns;
  excerpt.data.pose_report = data.pose_report;
  excerpt.data.imus = data.imus;
  for (size_t i = 0; i < data.imus.size(); ++i) {
    const auto crop = [&](std::vector<TimedSample>* samples) {
      const auto is_outside = [&](const TimedSample& s) {
        const double t = estimate.imus[i].PoseTime(s.t);
        return t < begin || t > end;
      };
      samples->erase(std::remove_if(samples->begin(), samples->end(), is_outside), samples->end());
    };
    ConditionedImu& imu = excerpt.data.imus[i];
    crop(&imu.gyro);
    crop(&imu.accel);
    if (imu.gyro.empty() || imu.accel.empty()) imu = ConditionedImu();
  }
  for (const IndexRange& segment : data.segments) {
    std::vector<TimedPose>& poses = excerpt.data.poses;
    const size_t first = poses.size();
    for (size_t i = segment.begin; i < segment.end; ++i)
      if (data.poses[i].t >= begin && data.poses[i].t <= end) poses.push_back(data.poses[i]);
    if (poses.size() >= first + 2) excerpt.data.segments.push_back({first, poses.size()});
  }
  return excerpt;
}

/// Whether both sensors of every IMU have samples for most of the time from `begin` to `end` [s,
/// pose clock].
bool IsCovered(const PreparedSession& session,
               const SessionEstimate& estimate,
               double begin,
               double end) {
  for (size_t i = 0; i < session.data.imus.size(); ++i) {
    const ConditionedImu& imu = session.data.imus[i];
    if (!imu.IsPresent()) continue;
    const double from = estimate.imus[i].ImuTime(begin), to = estimate.imus[i].ImuTime(end);
    const auto is_covered = [&](const std::vector<TimedSample>& samples, double rate_hz) {
      const auto before = [](const TimedSample& s, double t) { return s.t < t; };
      const auto first = std::lower_bound(samples.begin(), samples.end(), from, before);
      const auto last = std::lower_bound(first, samples.end(), to, before);
      return static_cast<double>(last - first) > kLeastCovered * (to - from) * rate_hz;
    };
    if (!is_covered(imu.gyro, imu.gyro_report.rate_hz) ||
        !is_covered(imu.accel, imu.accel_report.rate_hz))
      return false;
  }
  return true;
}

struct LivelySpan {
  double begin = 0.0, end = 0.0;  ///< [s] pose clock
  double liveliness = -1.0;       ///< see JointStart; negative: there is none
};

/// The `duration_s` of the log in which the marker turns most, as far as `knots` cover it.
LivelySpan FindLiveliest(const PreparedSession& session,
                         const SessionEstimate& estimate,
                         const CorrectionSplines& knots,
                         double duration_s) {
  double first = session.data.poses.front().t, last = session.data.poses.back().t;
  for (size_t i = 0; i < session.data.imus.size(); ++i) {
    const ConditionedImu& imu = session.data.imus[i];
    if (!imu.IsPresent()) continue;
    first = std::max(first, estimate.imus[i].PoseTime(imu.gyro.front().t));
    last = std::min(last, estimate.imus[i].PoseTime(imu.gyro.back().t));
  }
  LivelySpan best{first, first + duration_s};
  for (double t = first; t + 0.5 * duration_s < last; t += 0.5 * duration_s) {
    double sum = 0.0, followed = 0.0;
    for (double s = t; s < std::min(last, t + duration_s); s += kStep) {
      MarkerRotation<double> marker;
      if (!knots.Locate(s) || !session.trajectory->EvaluateRotation(s, &marker)) continue;
      sum += marker.alpha_M.squaredNorm();
      followed += kStep / duration_s;
    }
    const double liveliness = kStep / duration_s * sum;
    if (liveliness <= best.liveliness || followed < kLeastFollowed ||
        !IsCovered(session, estimate, t, std::min(last, t + duration_s)))
      continue;
    best = {t, t + duration_s, liveliness};
  }
  return best;
}

/// S4 at given knot spacings: trajectories and calibration in passes of least squares, each with
/// the noise and the robust weights that the residuals of the one before show.
class JointSolver {
 public:
  JointSolver(const CalibrationOptions& options,
              const std::vector<PreparedSession>& sessions,
              const std::vector<double>& knot_spacings_s,
              const std::vector<double>& noise,
              Estimate* estimate)
      : options_(options),
        sessions_(sessions),
        estimate_(estimate),
        models_(InitialModels(options, sessions)),
        holds_size_(estimate->imus.size(), true) {
    for (const SensorModel& model : models_) floor_.push_back(LeastNoise(model));
    for (size_t k = 0; k < noise.size(); ++k) models_[k].noise = models_[k].spread = noise[k];
    for (size_t s = 0; s < sessions.size(); ++s)
      splines_.emplace_back(sessions[s].data, *estimate, s, knot_spacings_s[s]);
  }

  const std::vector<SensorModel>& models() const { return models_; }

  /// The noise of a plain and a robust pass.
  std::vector<double> FindNoise() {
    Pass();
    NextPass(Noise());
    return Noise();
  }

  /// After FindNoise(): until the noise hardly depends on the one that the search started from.
  std::vector<double> SettleNoise() {
    int pass = 2;
    do ++pass;
    while (NextPass(Noise()) > kNoiseSettled && pass < kMaxNoisePasses);
    return Noise();
  }

  /// Starts close to the solution: residuals about the calibration of the start tell what is an
  /// outlier before it can move the calibration. The noise within the band is measured while
  /// sensors weigh by their spread.
  Solution Solve() {
    Pass(Calibration::kHeld);
    NextPass(Noise());
    in_band_ = NoiseInBand(*problem_, splines_, statistics_);
    int pass = 2;
    do ++pass;
    while (NextPass(ColoredNoise(), Calibration::kTested) > kNoiseAgreement && pass < kMaxPasses);
    BuildLast();
    if (may_show_sizes_ && Release()) BuildLast();
    FeignInformation(splines_, problem_.get());
    Solution solution;
    solution.marginals = FindMarginals(problem_.get());
    solution.statistics = statistics_;
    // Of everything: trajectories, gravity and biases too.
    FollowClocks([&] { problem_->Move(solution.marginals.step); });
    solution.residuals = problem_->TakeResiduals();
    problem_.reset();
    solution.models = std::move(models_);
    solution.splines = std::move(splines_);
    solution.iterations = iterations_;
    return solution;
  }

 private:
  /// What a pass does with it. Tested: it also finds whether there may be size effects.
  enum class Calibration { kHeld, kFound, kTested };

  /// With weights by the last residuals.
  void BuildLast() {
    SetNoise(ColoredNoise());
    Build();
  }

  /// From now on the size effects that the data show are estimated; whether there are any.
  bool Release() {
    const SizeTest test = TestSizes(problem_.get(), kShownSize, true);
    if (test.shown.empty()) return false;
    for (const Parameter& size : test.shown) holds_size_[size.imu] = false;
    FollowClocks([&] { problem_->Move(test.step); });
    statistics_ = problem_->FindStatistics();
    return true;
  }

  /// What is believed of a sensor's noise at least.
  double LeastNoise(const SensorModel& model) const {
    const PoseStd& noise = sessions_[model.session].pose_noise;
    if (model.quantity == Quantity::kPosition) return kLeastPositionNoise * noise.position;
    return model.quantity == Quantity::kRotation ? kLeastRotationNoise * noise.rotation : 0.0;
  }

  /// A problem with the noise and the weights that are set; at first, all weights are 1.
  void Build() {
    problem_.reset();  // never two of them at a time
    problem_ = BuildJointProblem(options_, sessions_, models_, estimate_, &splines_);
    if (holds_position_smoothing_) problem_->problem.SetHeld(&estimate_->position_smoothing, true);
    for (size_t i = 0; i < holds_size_.size(); ++i)
      if (holds_size_[i])
        problem_->problem.SetHeld(estimate_->imus[i].accel_positions.data(), true);
  }

  void Pass(Calibration calibration = Calibration::kFound) {
    Build();
    if (calibration == Calibration::kHeld) HoldCalibration(problem_.get());
    FollowClocks([&] {
      std::optional<GaussNewtonStep> first;
      if (calibration == Calibration::kTested && options_.estimate_size_effect) {
        SizeTest test = TestSizes(problem_.get(), kPossibleSize, false);
        may_show_sizes_ = !test.shown.empty();
        first = std::move(test.step);
      }
      iterations_ += problem_->Solve(kRoughTolerance, std::move(first));
    });
    statistics_ = problem_->FindStatistics();
    // No source averages rotations over longer than positions: other errors look like that.
    if (estimate_->position_smoothing < 0.0) {
      estimate_->position_smoothing = 0.0;
      holds_position_smoothing_ = true;
    }
  }

  /// The splines go along with the clocks that `move` moves, as they did in the problem.
  template <typename MoveClocks>
  void FollowClocks(const MoveClocks& move) {
    const Estimate before = *estimate_;
    move();
    for (size_t s = 0; s < splines_.size(); ++s) {
      if (splines_[s].is_with_poses) continue;
      const size_t imu = before.sessions[s].FirstImu();
      splines_[s].Follow(before.sessions[s].imus[imu],
                         estimate_->sessions[s].imus[imu],
                         estimate_->imus[imu].accel_delay - before.imus[imu].accel_delay);
    }
  }

  /// A pass with `noise` and the weights that follow from it and the last residuals; the largest
  /// factor by which the noise of a sensor that is found changes.
  double NextPass(const std::vector<double>& noise, Calibration calibration = Calibration::kFound) {
    const std::vector<double> before = Noise();
    SetNoise(noise);
    Pass(calibration);
    const std::vector<double> after = Noise();
    double change = 1.0;
    for (size_t k = 0; k < after.size(); ++k)
      change = std::max({change, before[k] / after[k], after[k] / before[k]});
    return change;
  }

  /// Of each sensor, as the last residuals show it.
  std::vector<double> Noise() const {
    std::vector<double> noise;
    for (const SensorStatistics& sensor : statistics_) noise.push_back(sensor.noise);
    return noise;
  }

  std::vector<double> ColoredNoise() const {
    std::vector<double> noise = Noise();
    const std::vector<double> colors = NoiseColor(*problem_, statistics_);
    for (size_t k = 0; k < noise.size(); ++k)
      noise[k] *= in_band_[k] < 1.0 ? in_band_[k] : colors[k];
    return noise;
  }

  void SetNoise(const std::vector<double>& noise) {
    for (size_t k = 0; k < noise.size(); ++k) {
      models_[k].noise = std::max(noise[k], floor_[k]);
      models_[k].spread = statistics_[k].noise;
    }
    UpdateWeights(*problem_, splines_, &models_);
  }

  const CalibrationOptions& options_;
  const std::vector<PreparedSession>& sessions_;
  Estimate* const estimate_;
  std::vector<SensorModel> models_;
  std::vector<CorrectionSplines> splines_;
  std::unique_ptr<LeastSquares> problem_;
  std::vector<SensorStatistics> statistics_;  ///< of the last pass
  std::vector<double> in_band_;               ///< see NoiseInBand()
  std::vector<double> floor_;                 ///< of the noise, by sensor
  bool holds_position_smoothing_ = false;     ///< at 0
  std::vector<bool> holds_size_;              ///< of each IMU: no size effect
  bool may_show_sizes_ = false;
  int iterations_ = 0;
};

/// What the IMUs leave, over all of them: it shrinks while knots become denser for a reason.
double ImuResidual(const std::vector<SensorModel>& models, const std::vector<double>& noise) {
  double residual = 1.0, imus = 0.0;
  for (size_t k = 0; k < models.size(); ++k) {
    const Quantity quantity = models[k].quantity;
    if (quantity == Quantity::kGyro || quantity == Quantity::kAccel) residual *= noise[k];
    if (quantity == Quantity::kGyro) imus += 1.0;
  }
  return std::pow(residual, 1.0 / imus);
}

/// An excerpt solved at one knot spacing.
struct Trial {
  std::vector<PreparedSession> sessions;
  Estimate estimate;
  JointSolver solver;
  double residual;

  Trial(const CalibrationOptions& options,
        const PreparedSession& excerpt,
        double spacing,
        const Estimate& start)
      : sessions{Correctable(options, excerpt, spacing)},
        estimate(start),
        solver(options, sessions, {spacing}, {}, &estimate),
        residual(ImuResidual(solver.models(), solver.FindNoise())) {}
};

/// A trial that is worth having only if it comes to an end: nothing where it does not.
std::unique_ptr<Trial> TryDenser(const CalibrationOptions& options,
                                 const PreparedSession& excerpt,
                                 double spacing,
                                 const Estimate& start) {
  try {
    return std::make_unique<Trial>(options, excerpt, spacing, start);
  } catch (const DataError&) {
    return nullptr;
  }
}

}  // namespace

JointStart ChooseKnotSpacing(const CalibrationOptions& options,
                             const PreparedSession& session,
                             Estimate* estimate) {
  const bool is_given = options.knot_spacing_s > 0.0;
  double spacing = is_given ? options.knot_spacing_s : kCoarsestKnots;
  const LivelySpan lively = FindLiveliest(session,
                                          estimate->sessions[0],
                                          CorrectionSplines(session.data, *estimate, 0, spacing),
                                          kExcerpt);
  if (lively.liveliness < 0.0)
    throw DataError("there are no seconds in which poses and the samples of every imu are there");
  const PreparedSession excerpt = Excerpt(session, estimate->sessions[0], lively.begin, lively.end);
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
  // Motion that the knots do not follow feigns a lever arm long before the noise shows it.
  if (!is_given && kReserve * spacing >= finest) {
    if (auto denser = TryDenser(options, excerpt, kReserve * spacing, *estimate)) {
      best = std::move(denser);
      spacing *= kReserve;
    }
  }
  const std::vector<double> noise = best->solver.SettleNoise();
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
  return {spacing, Correctable(options, session, spacing), noise, lively.liveliness};
}

Solution SolveJointly(const CalibrationOptions& options,
                      const std::vector<PreparedSession>& sessions,
                      const std::vector<JointStart>& starts,
                      Estimate* estimate) {
  std::vector<double> spacings, noise;
  for (const JointStart& start : starts) {
    spacings.push_back(start.knot_spacing_s);
    noise.insert(noise.end(), start.noise.begin(), start.noise.end());
  }
  return JointSolver(options, sessions, spacings, noise, estimate).Solve();
}

}  // namespace imu_pose_calib
