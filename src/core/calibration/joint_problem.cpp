#include "imu_pose_calib/core/calibration/joint_problem.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <initializer_list>
#include <optional>
#include <utility>

#include "imu_pose_calib/core/base/parallel.h"
#include "imu_pose_calib/core/calibration/joint_noise.h"
#include "imu_pose_calib/core/calibration/joint_residuals.h"

namespace imu_pose_calib {
namespace {

// Sigmas of ordinary clocks, trackers and IMUs.
constexpr double kSmoothingPrior = 1e-3;  // [s^2]
constexpr double kPoseScalePrior = 1e-3;  // [1]
// A filter that spreads samples over time delays them, too. Where the delay is small, so is the
// smoothing, and errors of the poses would take its place.
// For a filter of first order, the squared delay; for a plain delay, nothing.
constexpr double kSmoothingPerDelay2 = 0.5, kSmoothingSpread = 1.0;
constexpr double kLeastFilterDelay = 0.01;        // [s]
constexpr double kScalePrior = 0.01;              // [1] diagonal of K_g and K_a
constexpr double kAlignmentPrior = M_PI / 360.0;  // [rad] their other elements: 0.5 deg
constexpr double kSizePrior = 2e-3;               // [m] places of the accelerometer's axes

constexpr double kCurvatureStep = 0.01;  // [s] of differences
constexpr double kSensors = 3.0;         // of one IMU and the poses, that share what may be kept

/// Of the elements of a matrix in rows, or of its lower triangle.
Eigen::VectorXd IntrinsicsPrior(bool is_triangle) {
  std::vector<double> sigmas;
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < (is_triangle ? row + 1 : 3); ++column)
      sigmas.push_back(row == column ? kScalePrior : kAlignmentPrior);
  return Eigen::Map<Eigen::VectorXd>(sigmas.data(), static_cast<Eigen::Index>(sigmas.size()));
}

/// What make(i) returns for i = 0 .. count - 1, on all threads: kept unless that is too much.
template <typename Sample>
Samples<Sample> Collect(const CalibrationOptions& options, size_t count,
                        const std::function<Sample(size_t)>& make) {
  const double mb = 1e-6 * static_cast<double>(count * sizeof(Sample));
  if (mb > options.max_factor_mb / kSensors) return {count, make};
  std::vector<Sample> samples(count);
  InPortions(options.Threads(), count, [&](size_t i) { samples[i] = make(i); });
  return samples;
}

/// The places of samples: a residual block takes those that share the first control point, the
/// knots of the bias, of poses of the slow error, and of the clock.
struct Run {
  int first, knot, walk = 0;
  bool operator==(const Run& o) const {
    return first == o.first && knot == o.knot && walk == o.walk;
  }
};

int AddKnot(double* value, Problem* problem) { return problem->AddParameters(value, 1); }
int AddKnot(Eigen::Vector3d* value, Problem* problem) {
  return problem->AddParameters(value->data(), 3);
}

/// Blocks of knots; the number of the first, which the others follow, -1 when there are none.
template <typename Value>
int AddKnots(std::vector<Value>* values, Problem* problem) {
  int first = -1;
  for (Value& value : *values) {
    const int block = AddKnot(&value, problem);
    if (first < 0) first = block;
  }
  return first;
}

/// The poses `kept` as samples of their position or rotation, with its noise, the pose's own
/// `scale` of it and the weight.
void AddSamples(const std::vector<TimedPose>& poses, const std::vector<size_t>& kept,
                double TimedPose::*scale, SensorBlocks* sensor) {
  const SensorModel& model = *sensor->model;
  sensor->samples.reserve(kept.size());
  for (const size_t i : kept)
    sensor->samples.push_back(
        {poses[i].t, static_cast<uint32_t>(i),
         static_cast<float>(model.noise * poses[i].*scale / std::sqrt(model.weights[i]))});
}

/// Calls add(begin, end, run) for samples that are alike.
template <typename Add>
void ForRuns(const std::vector<Run>& runs, const Add& add) {
  for (size_t begin = 0, end = 0; begin < runs.size(); begin = end) {
    while (end < runs.size() && runs[end] == runs[begin]) ++end;
    add(begin, end, runs[begin]);
  }
}

/// Where the samples of a session are while its clocks stand as they did when the problem was made.
struct Places {
  std::shared_ptr<const PoseTrajectory> trajectory;
  CorrectionSplines splines;
  ClockLine reference;  ///< clock of the first IMU
  Eigen::Vector3d g_W;

  /// The GP at t [s] on the pose clock.
  MarkerState<double> At(double t, MarkerState<double>* rate = nullptr) const {
    MarkerState<double> state;
    trajectory->Evaluate(t, &state, rate);
    return state;
  }
  /// The first control point's index at t [s], if GP and spline go on there.
  std::optional<int> FindSpan(double t) const {
    const auto place = splines.Locate(t);
    if (!place || !trajectory->Contains(t)) return std::nullopt;
    return static_cast<int>(place->first);
  }
  double ReferenceTime(double t) const { return reference.ImuTime(t) - reference.clock_reference; }
  /// f_M'' of the GP at t [s], where it moves as `middle`; [m/s^4], components in M.
  Eigen::Vector3d ForceCurvature(const MarkerState<double>& middle, double t,
                                 const Eigen::Vector3d& p_MI) const {
    if (!trajectory->Covers(t - kCurvatureStep, t + kCurvatureStep)) return Eigen::Vector3d::Zero();
    const auto force = [&](const MarkerState<double>& state) {
      return SpecificForce(state, g_W, p_MI);
    };
    return (force(At(t - kCurvatureStep)) - 2.0 * force(middle) + force(At(t + kCurvatureStep))) /
           (kCurvatureStep * kCurvatureStep);
  }
};

/// Adds the residual blocks of one session.
class SessionBuilder {
 public:
  /// `d`, `phi`: blocks of the first control points; the others follow.
  SessionBuilder(size_t session, int d, int phi, CorrectionSplines* splines, LeastSquares* joint);

  void AddPoses();
  void AddGyro(size_t imu);
  void AddAccel(size_t imu);

 private:
  /// Clocks, as blocks of parameters and how samples move with them.
  struct Clocks {
    std::vector<int> blocks;
    ClockMotions motions;
  };
  /// How the samples of an IMU's sensor move along the trajectory, of which the splines go along
  /// with the accelerometer of the reference IMU; of poses when `imu` is null.
  Clocks FindClocks(const size_t* imu, bool is_accel);
  /// IMU samples of stamp t at the instant t - delay. `complete(places, t_M, &sample)` does what is
  /// of the sensor, `create(samples)` makes its cost function, `blocks(first, knot)` are the blocks
  /// of a residual, given the first control point's index and the first bias knot's block.
  template <typename Sample, typename Complete, typename Create, typename BlocksOf>
  void AddImu(size_t imu, Quantity quantity, const std::vector<TimedSample>& data, double delay,
              BiasKnots* knots, const Complete& complete, const Create& create,
              const BlocksOf& blocks);
  const size_t session_;
  const int d_, phi_;
  CorrectionSplines* const splines_;
  LeastSquares* const joint_;
  const PreparedSession& prepared_;
  SessionEstimate& estimate_;
  const size_t first_imu_;
  ImuSessionEstimate& reference_;  ///< clock of the first IMU
  const std::shared_ptr<const Places> places_;
};

SessionBuilder::SessionBuilder(size_t session, int d, int phi, CorrectionSplines* splines,
                               LeastSquares* joint)
    : session_(session),
      d_(d),
      phi_(phi),
      splines_(splines),
      joint_(joint),
      prepared_(joint->sessions[session]),
      estimate_(joint->estimate->sessions[session]),
      first_imu_(estimate_.FirstImu()),
      reference_(estimate_.imus[first_imu_]),
      places_(std::make_shared<const Places>(
          Places{prepared_.trajectory, *splines, reference_, estimate_.g_W})) {}

SessionBuilder::Clocks SessionBuilder::FindClocks(const size_t* imu, bool is_accel) {
  std::vector<int> blocks;
  std::vector<ClockMotion> motions;
  const auto add = [&](double* parameter, double on_gp, double on_spline, auto factor) {
    blocks.push_back(joint_->problem.Find(parameter));
    motions.push_back({*parameter, on_gp, on_spline, factor});
  };
  // On the GP a sample of the IMU moves as its own clocks do; on the splines, unless they stay with
  // the poses, by what that exceeds the move of the reference accelerometer.
  const bool is_with_poses = splines_->is_with_poses;
  const bool is_reference = !is_with_poses && imu != nullptr && *imu == first_imu_;
  if (!is_reference && !is_with_poses) {
    add(&reference_.time_shift, 0.0, -1.0, ClockMotion::kOne);
    add(&reference_.clock_drift, 0.0, -1.0, ClockMotion::kReferenceTime);
  }
  if (!is_with_poses && (!is_reference || !is_accel))
    add(&joint_->estimate->imus[first_imu_].accel_delay, 0.0, 1.0, ClockMotion::kOne);
  if (imu != nullptr) {
    const double on_spline = is_reference ? 0.0 : 1.0;
    add(&estimate_.imus[*imu].time_shift, 1.0, on_spline, ClockMotion::kOne);
    add(&estimate_.imus[*imu].clock_drift, 1.0, on_spline, ClockMotion::kOwnTime);
    if (is_accel)
      add(&joint_->estimate->imus[*imu].accel_delay, -1.0, -on_spline, ClockMotion::kOne);
  }
  return {blocks, std::make_shared<const std::vector<ClockMotion>>(motions)};
}

/// The blocks of a residual: those of the control points from the places on, of `shared`, and of
/// the clocks.
std::vector<int> Blocks(std::initializer_list<int> splines, std::initializer_list<int> shared,
                        const std::vector<int>& clocks) {
  std::vector<int> blocks;
  for (const int first : splines)
    for (int j = 0; j < kSplineOrder; ++j) blocks.push_back(first + j);
  blocks.insert(blocks.end(), shared);
  blocks.insert(blocks.end(), clocks.begin(), clocks.end());
  return blocks;
}

void SessionBuilder::AddPoses() {
  const Clocks clocks = FindClocks(nullptr, false);
  Problem& problem = joint_->problem;
  BiasKnots& errors = estimate_.rotation_errors.knots;
  const int first_error = AddKnots(&errors.values, &problem);
  const std::vector<TimedPose>& poses = prepared_.data.poses;
  const std::shared_ptr<const Places> places = places_;
  std::vector<size_t> kept;
  std::vector<Run> runs;
  for (size_t i = 0; i < poses.size(); ++i) {
    const auto span = places_->FindSpan(poses[i].t);
    if (!span) continue;
    kept.push_back(i);
    runs.push_back({*span, static_cast<int>(errors.Locate(poses[i].t).first)});
  }
  const int pose_smoothing = problem.Find(&joint_->estimate->pose_smoothing);
  const int position_smoothing = problem.Find(&joint_->estimate->position_smoothing);
  SensorBlocks* const position = joint_->Find(Quantity::kPosition, session_);
  SensorBlocks* const rotation = joint_->Find(Quantity::kRotation, session_);
  AddSamples(poses, kept, &TimedPose::position_scale, position);
  AddSamples(poses, kept, &TimedPose::rotation_scale, rotation);
  const auto samples =
      Collect<JointPoseSample>(joint_->options, kept.size(), [=, &poses, &errors](size_t k) {
        const ProblemSample& at = position->samples[k];
        const TimedPose& pose = poses[at.index];
        const MarkerState<double> gp = places->At(at.t);
        return JointPoseSample{*places->splines.Locate(at.t),
                               gp.q_WM.conjugate() * pose.q_WM,
                               pose.p_WM - gp.p_WM,
                               gp.alpha_M,
                               gp.a_W,
                               places->ReferenceTime(at.t),
                               at.sigma,
                               rotation->samples[k].sigma,
                               errors.Locate(at.t).second};
      });
  const auto add = [&](std::shared_ptr<const SampledCost> cost, auto blocks, SensorBlocks* sensor) {
    ForRuns(runs, [&](size_t begin, size_t end, const Run& run) {
      sensor->Add(problem.AddResiduals(cost, begin, end, blocks(run)), poses[kept[begin]].t);
    });
  };
  add(
      CreateJointPositionResidual(samples, clocks.motions),
      [&](const Run& run) {
        return Blocks({d_ + run.first}, {pose_smoothing, position_smoothing}, clocks.blocks);
      },
      position);
  add(
      CreateJointRotationResidual(samples, clocks.motions),
      [&](const Run& run) {
        const int knot = first_error + run.knot;
        return Blocks({phi_ + run.first}, {pose_smoothing, knot, knot + 1}, clocks.blocks);
      },
      rotation);
}

template <typename Sample, typename Complete, typename Create, typename BlocksOf>
void SessionBuilder::AddImu(size_t imu, Quantity quantity, const std::vector<TimedSample>& data,
                            double delay, BiasKnots* knots, const Complete& complete,
                            const Create& create, const BlocksOf& blocks) {
  const ImuSessionEstimate clock = estimate_.imus[imu];
  SensorBlocks* sensor = joint_->Find(quantity, session_, imu);
  const SensorModel& model = *sensor->model;
  std::vector<Run> runs;
  sensor->samples.reserve(data.size());
  for (size_t i = 0; i < data.size(); ++i) {
    const double t_M = clock.PoseTime(data[i].t - delay);
    const auto span = places_->FindSpan(t_M);
    if (!span || !IsOnTrajectory(*prepared_.trajectory, t_M)) continue;
    runs.push_back({*span, static_cast<int>(knots->Locate(data[i].t).first)});
    if (!clock.walk.IsLine())
      runs.back().walk = static_cast<int>(clock.walk.Locate(data[i].t - delay).first);
    sensor->samples.push_back({t_M, static_cast<uint32_t>(i),
                               static_cast<float>(model.noise / std::sqrt(model.weights[i]))});
  }
  const double own_reference = delay + clock.clock_reference;
  const std::function<Sample(size_t)> make = [places = places_, sensor, knots, own_reference,
                                              complete, walk = clock.walk, delay, &data](size_t k) {
    const ProblemSample& at = sensor->samples[k];
    const TimedSample& measured = data[at.index];
    Sample sample;
    sample.place = *places->splines.Locate(at.t);
    sample.value = measured.value;
    sample.bias_u = knots->Locate(measured.t).second;
    sample.own_time = measured.t - own_reference;
    sample.reference_time = places->ReferenceTime(at.t);
    sample.sigma = at.sigma;
    if (!walk.IsLine()) {
      sample.walk_u = walk.Locate(measured.t - delay).second;
      sample.walk = walk.At(measured.t - delay);
    }
    complete(*places, at.t, &sample);
    return sample;
  };
  const int first_knot = AddKnots(&knots->values, &joint_->problem);
  ClockWalk& walk = estimate_.imus[imu].walk;
  const int first_walk = AddKnots(&walk.offset, &joint_->problem);
  if (!walk.IsLine()) joint_->problem.SetHeld(&walk.offset[walk.reference], true);
  const std::shared_ptr<const SampledCost> cost =
      create(Collect(joint_->options, runs.size(), make));
  ForRuns(runs, [&](size_t begin, size_t end, const Run& run) {
    std::vector<int> all = blocks(run.first, first_knot + run.knot);
    if (!walk.IsLine()) all.insert(all.end(), {first_walk + run.walk, first_walk + run.walk + 1});
    sensor->Add(joint_->problem.AddResiduals(cost, begin, end, all), sensor->samples[begin].t);
  });
}

void SessionBuilder::AddGyro(size_t imu) {
  const Clocks clocks = FindClocks(&imu, false);
  const Problem& problem = joint_->problem;
  ImuEstimate& rig = joint_->estimate->imus[imu];
  const int q_MI = problem.Find(rig.q_MI.coeffs().data());
  const int intrinsics = problem.Find(rig.gyro_intrinsics.data());
  AddImu<JointImuSample>(
      imu, Quantity::kGyro, prepared_.data.imus[imu].gyro, 0.0, &estimate_.imus[imu].gyro_bias,
      [](const Places& places, double t_M, JointImuSample* sample) {
        MarkerRotation<double> gp;
        places.trajectory->EvaluateRotation(t_M, &gp);
        sample->omega_M = gp.omega_M;
        sample->alpha_M = gp.alpha_M;
      },
      [&](Samples<JointImuSample> samples) {
        return CreateJointGyroResidual(std::move(samples), clocks.motions,
                                       !estimate_.imus[imu].walk.IsLine());
      },
      [&](int first, int knot) {
        return Blocks({phi_ + first}, {q_MI, intrinsics, knot, knot + 1}, clocks.blocks);
      });
}

void SessionBuilder::AddAccel(size_t imu) {
  const Clocks clocks = FindClocks(&imu, true);
  const Problem& problem = joint_->problem;
  ImuEstimate& rig = joint_->estimate->imus[imu];
  const bool with_curvature =
      rig.accel_smoothing != 0.0 || problem.IsEstimated(&rig.accel_smoothing);
  const int q_MI = problem.Find(rig.q_MI.coeffs().data());
  const int p_MI = problem.Find(rig.p_MI.data());
  const int g_W = problem.Find(estimate_.g_W.data());
  const int intrinsics = problem.Find(rig.accel_intrinsics.data());
  const int smoothing = problem.Find(&rig.accel_smoothing);
  const int scale = problem.Find(&joint_->estimate->pose_scale);
  const int positions = problem.Find(rig.accel_positions.data());
  AddImu<JointAccelSample>(
      imu, Quantity::kAccel, prepared_.data.imus[imu].accel, rig.accel_delay,
      &estimate_.imus[imu].accel_bias,
      [with_curvature, p_MI = Eigen::Vector3d(rig.p_MI)](const Places& places, double t_M,
                                                         JointAccelSample* sample) {
        MarkerState<double> rate;
        const MarkerState<double> gp = places.At(t_M, &rate);
        sample->q_WM = gp.q_WM;
        sample->omega_M = gp.omega_M;
        sample->alpha_M = gp.alpha_M;
        sample->a_W = gp.a_W;
        sample->jerk = {rate.alpha_M, rate.a_W};
        if (with_curvature) sample->jerk.f_curvature = places.ForceCurvature(gp, t_M, p_MI);
      },
      [&](Samples<JointAccelSample> samples) {
        return CreateJointAccelResidual(std::move(samples), rig.q_MI.toRotationMatrix(),
                                        clocks.motions, !estimate_.imus[imu].walk.IsLine());
      },
      [&](int first, int knot) {
        return Blocks({d_ + first, phi_ + first},
                      {q_MI, p_MI, g_W, intrinsics, knot, knot + 1, smoothing, scale, positions},
                      clocks.blocks);
      });
}

}  // namespace

std::unique_ptr<LeastSquares> BuildJointProblem(const CalibrationOptions& options,
                                                const std::vector<PreparedSession>& sessions,
                                                const std::vector<SensorModel>& models,
                                                Estimate* estimate,
                                                std::vector<CorrectionSplines>* splines) {
  auto joint = std::make_unique<LeastSquares>(options, sessions, models, estimate);
  for (CorrectionSplines& own : *splines)
    for (auto* points : {&own.d, &own.phi})
      for (Eigen::Vector3d& point : *points)
        joint->trajectory_blocks.push_back(joint->problem.AddParameters(point.data(), 3));
  joint->AddGyroParameters();
  joint->AddAccelParameters();
  const auto one = [](double sigma) { return Eigen::VectorXd::Constant(1, sigma).eval(); };
  joint->AddOptional(ParameterKind::kClockDrift, one(kDriftPrior));
  joint->AddOptional(ParameterKind::kPoseSmoothing, one(kSmoothingPrior));
  joint->AddOptional(ParameterKind::kPositionSmoothing, one(kSmoothingPrior));
  joint->AddOptional(ParameterKind::kPoseScale, one(kPoseScalePrior), 1.0);
  for (size_t i = 0; i < estimate->imus.size(); ++i) {
    double delay = 0.0;
    for (const PreparedSession& session : sessions)
      if (session.data.imus[i].IsPresent() &&
          std::abs(session.starts[i].accel_delay) > std::abs(delay))
        delay = session.starts[i].accel_delay;
    joint->AddOptional(ParameterKind::kAccelSmoothing,
                       one(kSmoothingSpread * std::max(delay * delay, 1e-12)),
                       kSmoothingPerDelay2 * delay * std::abs(delay), i);
    if (std::abs(delay) <= kLeastFilterDelay)
      joint->problem.SetHeld(&estimate->imus[i].accel_smoothing, true);
  }
  joint->AddOptional(ParameterKind::kGyroIntrinsics, IntrinsicsPrior(true));
  joint->AddOptional(ParameterKind::kAccelIntrinsics, IntrinsicsPrior(false));
  joint->AddOptional(ParameterKind::kAccelPositions, Eigen::VectorXd::Constant(6, kSizePrior));
  for (size_t s = 0; s < sessions.size(); ++s) {
    (*splines)[s].is_with_poses = DoPosesLead((*splines)[s], s, *joint);
    const auto first = [&](const std::vector<Eigen::Vector3d>& points) {
      return joint->problem.Find(points.front().data());
    };
    SessionBuilder builder(s, first((*splines)[s].d), first((*splines)[s].phi), &(*splines)[s],
                           joint.get());
    builder.AddPoses();
    joint->AddRotationErrors(s);
    for (size_t i = 0; i < estimate->imus.size(); ++i) {
      ImuSessionEstimate& imu = estimate->sessions[s].imus[i];
      if (!imu.is_present) continue;
      builder.AddGyro(i);
      builder.AddAccel(i);
      joint->AddBiasWalk(options.gyro_bias_walk, s, i, &imu.gyro_bias);
      joint->AddBiasWalk(options.accel_bias_walk, s, i, &imu.accel_bias);
      joint->AddClockWalk(s, i);
    }
    ShareFreedom((*splines)[s], s, joint.get());
  }
  return joint;
}

void HoldCalibration(LeastSquares* joint) {
  for (const Parameter& p : CalibrationParameters(joint->estimate)) {
    const bool is_clock =
        p.kind == ParameterKind::kTimeShift || p.kind == ParameterKind::kClockDrift;
    if (!is_clock || !joint->options.estimate_clock_drift) joint->problem.SetHeld(p.data, true);
  }
}

}  // namespace imu_pose_calib
