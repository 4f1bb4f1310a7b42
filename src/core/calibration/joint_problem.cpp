#include "imu_pose_calib/core/calibration/joint_problem.h"

#include <ceres/normal_prior.h>

#include <cmath>
#include <functional>
#include <optional>
#include <utility>

#include "imu_pose_calib/core/base/parallel.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibration/joint_noise.h"
#include "imu_pose_calib/core/calibration/joint_residuals.h"
#include "imu_pose_calib/core/calibration/residuals.h"

namespace imu_pose_calib {
namespace {

/// Sigma of the step from one control point of the trajectory's corrections to the next [m], [rad]:
/// more than any tracker errs by.
constexpr double kCorrectionStep = 0.1;
/// Of what their acceleration changes by [m/s^2], [rad/s^2] in the first and the last span of a
/// run: no sample is at its end.
constexpr double kEndChange = 1.0;
constexpr double kKeptShare = 0.125;  // of what may be kept, for the samples of one sensor

/// What make(i) returns for i = 0 .. count - 1, on all threads: kept unless that is too much.
template <typename Sample>
Samples<Sample> Collect(const CalibrationOptions& options, size_t count,
                        const std::function<Sample(size_t)>& make) {
  const double mb = 1e-6 * static_cast<double>(count * sizeof(Sample));
  if (mb > kKeptShare * options.max_factor_mb) return {count, make};
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

using Vector3ds = std::vector<Eigen::Vector3d>;

/// Blocks of knots; the number of the first, which the others follow.
int AddKnots(Vector3ds* values, Problem* problem) {
  for (Eigen::Vector3d& value : *values) problem->AddParameters(value.data(), 3);
  return problem->Find(values->front().data());
}
int AddKnots(std::vector<double>* values, Problem* problem) {
  for (double& value : *values) problem->AddParameters(&value, 1);
  return problem->Find(&values->front());
}

/// Where the samples of a session are while its clocks stand as they did when the problem was made.
struct Places {
  static constexpr double kStep = 0.01;  // [s] of differences
  std::shared_ptr<const PoseTrajectory> trajectory;
  CorrectionSplines splines;
  Eigen::Vector3d g_W;

  /// The GP at t [s] on the pose clock.
  MarkerState<double> At(double t, MarkerState<double>* rate = nullptr) const {
    MarkerState<double> state;
    trajectory->Evaluate(t, &state, rate);
    return state;
  }
  /// The first control point's index at t [s], if a spline covers it and IsOnTrajectory().
  std::optional<int> FindSpan(double t) const {
    const auto place = splines.Locate(t);
    if (!place || !IsOnTrajectory(*trajectory, t)) return std::nullopt;
    return static_cast<int>(place->first);
  }
  /// JointPoseSample::higher, by differences: x(time after t) is 0 at 0.
  template <typename Function>
  static Eigen::Matrix<double, 3, 2> Higher(const Function& x) {
    const Eigen::Vector3d a = x(-2.0 * kStep), b = x(-kStep), c = x(kStep), d = x(2.0 * kStep);
    Eigen::Matrix<double, 3, 2> higher;
    higher << (a - 2.0 * b + 2.0 * c - d) / (12.0 * std::pow(kStep, 3)),
        (a - 4.0 * b - 4.0 * c + d) / (24.0 * std::pow(kStep, 4));
    return higher;
  }
  /// Of omega_M.
  Eigen::Vector3d RateCurvature(double t, const MarkerRotation<double>& gp) const {
    MarkerRotation<double> before, after;
    trajectory->EvaluateRotation(t - kStep, &before);
    trajectory->EvaluateRotation(t + kStep, &after);
    return (before.omega_M - 2.0 * gp.omega_M + after.omega_M) / (kStep * kStep);
  }
  /// F = R_WM f_M of p_MI at t.
  Eigen::Vector3d Force(const MarkerState<double>& state, const Eigen::Vector3d& p_MI) const {
    return state.q_WM * SpecificForce(state, g_W, p_MI);
  }
  /// JointImuSample::curvature and JointAccelSample::averaged at t, where the GP is `gp`; of the
  /// first IMU, which averages as the trajectory does.
  void SetCurvatures(double t, const MarkerState<double>& gp, const Eigen::Vector3d& p_MI,
                     bool is_first, JointAccelSample* sample) const {
    const MarkerState<double> before = At(t - kStep), after = At(t + kStep);
    const auto f = [&](const MarkerState<double>& x) { return SpecificForce(x, g_W, p_MI); };
    sample->curvature = (f(before) - 2.0 * f(gp) + f(after)) / (kStep * kStep);
    sample->averaged =
        gp.q_WM.conjugate() * (2.0 * gp.a_W - before.a_W - after.a_W) / (kStep * kStep);
    if (is_first) sample->averaged += sample->curvature;
  }
  /// f_swing of JointAccelSample at t, where it is `gp`: on a spring of this compliance, of the
  /// force that the IMU feels there, which exceeds F by -compliance F'' and so on.
  Eigen::Vector3d Swing(double t, const MarkerState<double>& gp, const Eigen::Vector3d& p_MI,
                        double compliance) const {
    const auto pair = [&](double step) -> Eigen::Vector3d {
      return Force(At(t - step), p_MI) + Force(At(t + step), p_MI);
    };
    const Eigen::Vector3d F = Force(gp, p_MI), near = pair(kStep), far = pair(2.0 * kStep);
    const Eigen::Vector3d second = (16.0 * near - far - 30.0 * F) / (12.0 * kStep * kStep);
    const Eigen::Vector3d fourth = (far - 4.0 * near + 6.0 * F) / std::pow(kStep, 4);
    return gp.q_WM.conjugate() * (second - compliance * fourth);
  }
};

/// Adds the residual blocks of one session.
class SessionBuilder {
 public:
  SessionBuilder(size_t session, CorrectionSplines* splines, LeastSquares* joint)
      : session_(session),
        splines_(splines),
        joint_(joint),
        prepared_(joint->sessions[session]),
        estimate_(joint->estimate->sessions[session]),
        places_(
            std::make_shared<const Places>(Places{prepared_.trajectory, *splines, estimate_.g_W})) {
  }

  void AddPoses();
  void AddGyro(size_t imu);
  void AddAccel(size_t imu);

 private:
  /// How samples move with clocks.
  struct Clocks {
    std::vector<double*> parameters;
    ClockMotions motions;
  };
  Clocks FindClocks(size_t imu, bool is_accel) const;
  bool IsUsed(const double& parameter) const {
    return parameter != 0.0 || joint_->problem.IsEstimated(&parameter);
  }
  /// IMU samples of stamp t at the instant t - delay. `complete(places, t_M, &sample)` does what is
  /// of the sensor, `create(samples, others, motions, has_walk)` makes its cost function, whose
  /// blocks of control points and of parameters after the knots are `points` and `others`.
  template <typename Sample, typename Complete, typename Create>
  void AddImu(size_t imu, Quantity quantity, const std::vector<Vector3ds*>& points,
              std::vector<double*> others, const Complete& complete, const Create& create);
  /// Residual blocks of samples, the blocks of parameters in the order of joint_residuals.h;
  /// `knots` and `walk` may be null.
  void AddBlocks(const std::shared_ptr<const SampledCost>& cost, const std::vector<Run>& runs,
                 const std::vector<Vector3ds*>& points, Vector3ds* knots,
                 const std::vector<double*>& others, std::vector<double>* walk,
                 SensorBlocks* sensor);

  const size_t session_;
  CorrectionSplines* const splines_;
  LeastSquares* const joint_;
  const PreparedSession& prepared_;
  SessionEstimate& estimate_;
  const std::shared_ptr<const Places> places_;
};

SessionBuilder::Clocks SessionBuilder::FindClocks(size_t imu, bool is_accel) const {
  Clocks clocks;
  std::vector<ClockMotion> motions;
  const auto add = [&](double* parameter, double sign, auto factor) {
    clocks.parameters.push_back(parameter);
    motions.push_back({*parameter, sign, factor});
  };
  add(&estimate_.imus[imu].time_shift, 1.0, ClockMotion::kOne);
  add(&estimate_.imus[imu].clock_drift, 1.0, ClockMotion::kOwnTime);
  if (is_accel) add(&joint_->estimate->imus[imu].accel_delay, -1.0, ClockMotion::kOne);
  clocks.motions = std::make_shared<const std::vector<ClockMotion>>(motions);
  return clocks;
}

void SessionBuilder::AddBlocks(const std::shared_ptr<const SampledCost>& cost,
                               const std::vector<Run>& runs, const std::vector<Vector3ds*>& points,
                               Vector3ds* knots, const std::vector<double*>& others,
                               std::vector<double>* walk, SensorBlocks* sensor) {
  Problem& problem = joint_->problem;
  std::vector<int> shared;
  for (double* const parameter : others) shared.push_back(problem.Find(parameter));
  std::vector<int> first_points;
  for (Vector3ds* const spline : points)
    first_points.push_back(problem.Find(spline->front().data()));
  const int first_knot = knots == nullptr ? -1 : AddKnots(knots, &problem);
  const int first_walk = walk == nullptr ? -1 : AddKnots(walk, &problem);
  sensor->first_row = problem.rows();
  std::vector<int> blocks;
  for (size_t begin = 0, end = 0; begin < runs.size(); begin = end) {
    const Run& run = runs[begin];
    while (end < runs.size() && runs[end] == run) ++end;
    blocks.clear();
    for (const int first : first_points)
      for (int j = 0; j < kSplineOrder; ++j) blocks.push_back(first + run.first + j);
    if (first_knot >= 0)
      blocks.insert(blocks.end(), {first_knot + run.knot, first_knot + run.knot + 1});
    blocks.insert(blocks.end(), shared.begin(), shared.end());
    if (first_walk >= 0)
      blocks.insert(blocks.end(), {first_walk + run.walk, first_walk + run.walk + 1});
    joint_->Add(problem.AddResiduals(cost, begin, end, blocks), session_, sensor->samples[begin].t);
  }
}

void SessionBuilder::AddPoses() {
  Estimate& all = *joint_->estimate;
  BiasKnots& position_errors = estimate_.position_errors.knots;
  BiasKnots& rotation_errors = estimate_.rotation_errors.knots;
  const std::vector<TimedPose>& poses = prepared_.data.poses;
  SensorBlocks* const position = joint_->Find(Quantity::kPosition, session_);
  SensorBlocks* const rotation = joint_->Find(Quantity::kRotation, session_);
  std::vector<Run> position_runs, rotation_runs;
  const auto add = [&](size_t i, double delay, const BiasKnots& errors, std::vector<Run>* runs,
                       SensorBlocks* sensor) {
    const double t = poses[i].t - delay;
    const auto span = places_->FindSpan(t);
    if (!span) return;
    runs->push_back({*span, static_cast<int>(errors.Locate(poses[i].t).first)});
    const SensorModel& model = *sensor->model;
    const double sigma =
        model.noise * joint_->At(model, i).scale / std::sqrt(poses[i].count * model.weights[i]);
    sensor->samples.push_back({t, static_cast<uint32_t>(i), static_cast<float>(sigma)});
    sensor->count += poses[i].count;
  };
  for (size_t i = 0; i < poses.size(); ++i) {
    add(i, all.position_delay, position_errors, &position_runs, position);
    add(i, 0.0, rotation_errors, &rotation_runs, rotation);
  }
  const auto complete = [&poses, places = places_](const ProblemSample& at, const BiasKnots& errors,
                                                   JointPoseSample* sample) {
    sample->place = *places->splines.Locate(at.t);
    sample->error_u = errors.Locate(poses[at.index].t).second;
    sample->sigma = at.sigma;
  };
  const auto positions = Collect<JointPoseSample>(
      joint_->options, position_runs.size(),
      [=, places = places_, &poses, &position_errors](size_t k) {
        const ProblemSample& at = position->samples[k];
        const MarkerState<double> gp = places->At(at.t);
        JointPoseSample sample;
        complete(at, position_errors, &sample);
        sample.error = poses[at.index].p_WM - gp.p_WM;
        sample.rate = gp.v_W;
        sample.curvature = gp.a_W;
        sample.higher = Places::Higher([&](double after) -> Eigen::Vector3d {
          return places->trajectory->PositionAt(at.t + after) - gp.p_WM;
        });
        return sample;
      });
  const auto rotations = Collect<JointPoseSample>(
      joint_->options, rotation_runs.size(),
      [=, places = places_, &poses, &rotation_errors](size_t k) {
        const ProblemSample& at = rotation->samples[k];
        MarkerRotation<double> gp;
        places->trajectory->EvaluateRotation(at.t, &gp);
        JointPoseSample sample;
        complete(at, rotation_errors, &sample);
        sample.error = Log(Eigen::Quaterniond(gp.q_WM.conjugate() * poses[at.index].q_WM));
        sample.rate.setZero();
        sample.curvature = gp.alpha_M;
        sample.higher = Places::Higher([&](double after) {
          const Eigen::Quaterniond q_WM = places->trajectory->RotationAt(at.t + after);
          return Log(Eigen::Quaterniond(gp.q_WM.conjugate() * q_WM));
        });
        return sample;
      });
  const auto clocks = std::make_shared<const std::vector<ClockMotion>>(
      1, ClockMotion{all.position_delay, -1.0, ClockMotion::kOne});
  AddBlocks(CreateJointPositionResidual(positions, clocks), position_runs, {&splines_->d},
            &position_errors.values,
            {&all.pose_smoothing, &all.position_smoothing, &all.accel_smoothing,
             all.pose_cumulants.data(), all.position_cumulants.data(), &all.position_delay},
            nullptr, position);
  AddBlocks(CreateJointRotationResidual(rotations), rotation_runs, {&splines_->phi},
            &rotation_errors.values, {&all.pose_smoothing, all.pose_cumulants.data()}, nullptr,
            rotation);
}

template <typename Sample, typename Complete, typename Create>
void SessionBuilder::AddImu(size_t imu, Quantity quantity, const std::vector<Vector3ds*>& points,
                            std::vector<double*> others, const Complete& complete,
                            const Create& create) {
  const bool is_accel = quantity == Quantity::kAccel;
  const ConditionedImu& recorded = prepared_.data.imus[imu];
  const std::vector<TimedSample>& data = is_accel ? recorded.accel : recorded.gyro;
  ImuSessionEstimate& own = estimate_.imus[imu];
  BiasKnots* const knots = is_accel ? &own.accel_bias : &own.gyro_bias;
  const double delay = is_accel ? joint_->estimate->imus[imu].accel_delay : 0.0;
  const ClockWalk walk = own.walk;
  SensorBlocks* const sensor = joint_->Find(quantity, session_, imu);
  const SensorModel& model = *sensor->model;
  std::vector<Run> runs;
  sensor->samples.reserve(data.size());
  for (size_t i = 0; i < data.size(); ++i) {
    const double t_M = own.PoseTime(data[i].t - delay);
    const auto span = places_->FindSpan(t_M);
    if (!span) continue;
    runs.push_back({*span, static_cast<int>(knots->Locate(data[i].t).first)});
    if (!walk.IsLine()) runs.back().walk = static_cast<int>(walk.Locate(data[i].t - delay).first);
    const double sigma = model.noise / std::sqrt(data[i].count * model.weights[i]);
    sensor->samples.push_back({t_M, static_cast<uint32_t>(i), static_cast<float>(sigma)});
    sensor->count += data[i].count;
  }
  const double own_reference = delay + own.clock_reference;
  const std::function<Sample(size_t)> make = [places = places_, sensor, knots, own_reference,
                                              complete, walk, delay, &data](size_t k) {
    const ProblemSample& at = sensor->samples[k];
    const TimedSample& measured = data[at.index];
    Sample sample;
    sample.place = *places->splines.Locate(at.t);
    sample.value = measured.value;
    sample.bias_u = knots->Locate(measured.t).second;
    sample.own_time = measured.t - own_reference;
    sample.sigma = at.sigma;
    if (!walk.IsLine()) {
      sample.walk_u = walk.Locate(measured.t - delay).second;
      sample.walk = walk.At(measured.t - delay);
    }
    complete(*places, at.t, &sample);
    return sample;
  };
  const Clocks clocks = FindClocks(imu, is_accel);
  others.insert(others.end(), clocks.parameters.begin(), clocks.parameters.end());
  AddBlocks(create(Collect(joint_->options, runs.size(), make), others.data(), clocks.motions,
                   !walk.IsLine()),
            runs, points, &knots->values, others, walk.IsLine() ? nullptr : &own.walk.offset,
            sensor);
  if (!walk.IsLine()) joint_->problem.SetHeld(&own.walk.offset[walk.reference], true);
}

void SessionBuilder::AddGyro(size_t imu) {
  ImuEstimate& rig = joint_->estimate->imus[imu];
  AddImu<JointImuSample>(
      imu, Quantity::kGyro, {&splines_->phi},
      {rig.q_MI.coeffs().data(), rig.gyro_intrinsics.data(), &rig.gyro_smoothing,
       &joint_->estimate->gyro_smoothing},
      [with_curvature = IsUsed(rig.gyro_smoothing)](const Places& places, double t_M,
                                                    JointImuSample* sample) {
        MarkerRotation<double> gp;
        places.trajectory->EvaluateRotation(t_M, &gp);
        sample->omega_M = gp.omega_M;
        sample->alpha_M = gp.alpha_M;
        sample->cone = RateCone(gp);
        if (with_curvature) sample->curvature = places.RateCurvature(t_M, gp);
      },
      &CreateJointGyroResidual);
}

void SessionBuilder::AddAccel(size_t imu) {
  Estimate& all = *joint_->estimate;
  ImuEstimate& rig = all.imus[imu];
  const bool is_first = imu == 0;
  const bool with_curvatures =
      IsUsed(all.accel_smoothing) || IsUsed(all.AccelSmoothing(imu)) || IsUsed(rig.gyro_smoothing);
  const bool with_swing = IsUsed(rig.mount_compliance);
  AddImu<JointAccelSample>(
      imu, Quantity::kAccel, {&splines_->d, &splines_->phi},
      {rig.q_MI.coeffs().data(), rig.accel_intrinsics.data(), rig.p_MI.data(), estimate_.g_W.data(),
       &rig.accel_smoothing, &rig.mount_compliance, &all.pose_scale, rig.accel_positions.data(),
       &rig.gyro_smoothing, &all.gyro_smoothing, &all.accel_smoothing},
      [=, p_MI = Eigen::Vector3d(rig.p_MI), compliance = rig.mount_compliance](
          const Places& places, double t_M, JointAccelSample* sample) {
        MarkerState<double> rate;
        const MarkerState<double> gp = places.At(t_M, &rate);
        sample->q_WM = gp.q_WM;
        sample->omega_M = gp.omega_M;
        sample->alpha_M = gp.alpha_M;
        sample->a_W = gp.a_W;
        sample->alpha_rate = rate.alpha_M;
        sample->jerk_W = rate.a_W;
        sample->cone = ForceCone(gp, rate, places.g_W, p_MI);
        if (with_swing) sample->f_swing = places.Swing(t_M, gp, p_MI, compliance);
        if (with_curvatures) places.SetCurvatures(t_M, gp, p_MI, is_first, sample);
      },
      &CreateJointAccelResidual);
}

/// Control points that samples leave open stay near their neighbours, the first of a run near 0.
void AddCorrectionPriors(CorrectionSplines* splines, size_t session, LeastSquares* joint) {
  const auto prior = std::make_shared<const ceres::NormalPrior>(Eigen::Matrix3d::Identity(),
                                                                Eigen::Vector3d::Zero());
  const std::shared_ptr<const ceres::CostFunction> walk = WalkResidual<3>{kCorrectionStep}.Create();
  const std::shared_ptr<const ceres::CostFunction> jerk =
      JerkResidual{kEndChange * splines->spacing() * splines->spacing()}.Create();
  for (const CorrectionSplines::Run& run : splines->Runs()) {
    for (Vector3ds* const points : {&splines->d, &splines->phi}) {
      int block = joint->problem.Find((*points)[run.first].data());
      joint->Add(joint->problem.AddResiduals(prior, {block}), session, run.begin);
      const auto add_end = [&](int span, double t) {
        joint->Add(joint->problem.AddResiduals(jerk, {span, span + 1, span + 2, span + 3}), session,
                   t);
      };
      add_end(block, run.begin);
      add_end(block + static_cast<int>(run.spans) - 1, run.end);
      for (size_t k = 0; k + 2 < run.spans + kSplineOrder; ++k, ++block)
        joint->Add(joint->problem.AddResiduals(walk, {block, block + 1}), session,
                   run.begin + run.spacing * (static_cast<double>(k) - 1.0));
    }
  }
}

}  // namespace

std::unique_ptr<LeastSquares> BuildJointProblem(const CalibrationOptions& options,
                                                const std::vector<PreparedSession>& sessions,
                                                const std::vector<SensorModel>& models,
                                                Estimate* estimate,
                                                std::vector<CorrectionSplines>* splines) {
  auto joint = std::make_unique<LeastSquares>(options, sessions, models, estimate);
  for (CorrectionSplines& own : *splines)
    for (Vector3ds* const points : {&own.d, &own.phi})
      for (Eigen::Vector3d& point : *points)
        joint->trajectory_blocks.push_back(joint->problem.AddParameters(point.data(), 3));
  joint->AddCalibration(true);
  // Of the first IMU, less what the trajectory has of it: none.
  ImuEstimate& first = estimate->imus[0];
  for (double* const none : {&first.gyro_smoothing, &first.accel_smoothing}) {
    joint->problem.AddParameters(none, 1);
    joint->problem.SetHeld(none, true);
  }
  for (size_t s = 0; s < sessions.size(); ++s) {
    AddCorrectionPriors(&(*splines)[s], s, joint.get());
    SessionBuilder builder(s, &(*splines)[s], joint.get());
    builder.AddPoses();
    for (SlowErrors* const errors : joint->estimate->sessions[s].AllErrors())
      joint->AddSlowErrors(s, errors);
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

}  // namespace imu_pose_calib
