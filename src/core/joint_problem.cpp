#include "imu_pose_calib/core/joint_problem.h"

#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <utility>

#include "imu_pose_calib/core/joint_noise.h"
#include "imu_pose_calib/core/joint_residuals.h"
#include "imu_pose_calib/core/parallel.h"

namespace imu_pose_calib {
namespace {

// Sigmas of ordinary clocks, trackers and IMUs.
constexpr double kDriftPrior = 1e-4;      // [s/s]
constexpr double kSmoothingPrior = 1e-3;  // [s^2]
constexpr double kPoseScalePrior = 3e-3;  // [1]
// A filter that spreads samples over time delays them, too. Where the delay is small, so is the
// smoothing, and errors of the poses would take its place.
// For a filter of first order, the squared delay; for a plain delay, nothing.
constexpr double kSmoothingPerDelay2 = 0.5, kSmoothingSpread = 1.0;
constexpr double kLeastFilterDelay = 0.01;        // [s]
constexpr double kScalePrior = 0.01;              // [1] diagonal of K_g and K_a
constexpr double kAlignmentPrior = M_PI / 360.0;  // [rad] their other elements: 0.5 deg
constexpr double kSizePrior = 3e-3;               // [m] places of the accelerometer's axes

constexpr double kCurvatureStep = 0.01;  // [s] of differences
/// Samples that a thread takes at a time.
constexpr size_t kPortion = 256;

/// Of the elements of a matrix in rows, or of its lower triangle.
Eigen::VectorXd IntrinsicsPrior(bool is_triangle) {
  std::vector<double> sigmas;
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < (is_triangle ? row + 1 : 3); ++column)
      sigmas.push_back(row == column ? kScalePrior : kAlignmentPrior);
  return Eigen::Map<Eigen::VectorXd>(sigmas.data(), static_cast<Eigen::Index>(sigmas.size()));
}

/// make(i, &sample) for i = 0 .. count - 1 on all threads; keeps the samples for which it is true,
/// in order, and returns their i.
template <typename Sample, typename Make>
std::vector<size_t> Collect(int threads,
                            size_t count,
                            std::vector<Sample>* samples,
                            const Make& make) {
  samples->resize(count);
  std::vector<char> is_kept(count);
  InParallel(threads, (count + kPortion - 1) / kPortion, [&](size_t p) {
    for (size_t i = p * kPortion; i < std::min(count, (p + 1) * kPortion); ++i)
      is_kept[i] = make(i, &(*samples)[i]) ? 1 : 0;
  });
  std::vector<size_t> kept;
  for (size_t i = 0; i < count; ++i) {
    if (is_kept[i] == 0) continue;
    (*samples)[kept.size()] = (*samples)[i];
    kept.push_back(i);
  }
  samples->resize(kept.size());
  return kept;
}

/// Calls add(begin, end) for runs of `count` samples of which all are like the first.
template <typename IsLike, typename Add>
void ForRuns(size_t count, const IsLike& is_like, const Add& add) {
  for (size_t begin = 0, end = 0; begin < count; begin = end) {
    while (end < count && is_like(begin, end)) ++end;
    add(begin, end);
  }
}

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
  /// IMU samples of stamp t at the instant t - delay: consecutive ones that share a span and a pair
  /// of bias knots are handed to `add(samples, control points' index, block of the first bias
  /// knot)`, which returns their block. `complete(t_M, &sample)` does what is of the sensor.
  template <typename Sample, typename Complete, typename Add>
  void AddImu(size_t imu,
              Quantity quantity,
              const std::vector<TimedSample>& data,
              double delay,
              BiasKnots* knots,
              const Complete& complete,
              const Add& add);
  /// The GP at t [s] and the place there; false when it is not on a spline.
  bool FindPoint(double t,
                 SplinePlace* place,
                 MarkerState<double>* gp,
                 MarkerState<double>* rate = nullptr) const;
  /// f_M'' of the GP at t [s], where it moves as `middle`; [m/s^4], components in M.
  Eigen::Vector3d ForceCurvature(const MarkerState<double>& middle,
                                 double t,
                                 const Eigen::Vector3d& p_MI) const;
  double ReferenceTime(double t_M) const {
    return reference_.ImuTime(t_M) - reference_.clock_reference;
  }

  const size_t session_;
  const int d_, phi_;
  CorrectionSplines* const splines_;
  LeastSquares* const joint_;
  const PreparedSession& prepared_;
  SessionEstimate& estimate_;
  const size_t first_imu_;
  ImuSessionEstimate& reference_;  ///< clock of the first IMU
};

SessionBuilder::SessionBuilder(size_t session,
                               int d,
                               int phi,
                               CorrectionSplines* splines,
                               LeastSquares* joint)
    : session_(session),
      d_(d),
      phi_(phi),
      splines_(splines),
      joint_(joint),
      prepared_(joint->sessions[session]),
      estimate_(joint->estimate->sessions[session]),
      first_imu_(estimate_.FirstImu()),
      reference_(estimate_.imus[first_imu_]) {}

bool SessionBuilder::FindPoint(double t,
                               SplinePlace* place,
                               MarkerState<double>* gp,
                               MarkerState<double>* rate) const {
  const auto found = splines_->Locate(t);
  if (!found || !prepared_.trajectory->Evaluate(t, gp, rate)) return false;
  *place = *found;
  return true;
}

Eigen::Vector3d SessionBuilder::ForceCurvature(const MarkerState<double>& middle,
                                               double t,
                                               const Eigen::Vector3d& p_MI) const {
  const auto force = [&](const MarkerState<double>& state) {
    return SpecificForce(state, estimate_.g_W, p_MI);
  };
  MarkerState<double> before, after;
  if (!prepared_.trajectory->Evaluate(t - kCurvatureStep, &before) ||
      !prepared_.trajectory->Evaluate(t + kCurvatureStep, &after))
    return Eigen::Vector3d::Zero();
  return (force(before) - 2.0 * force(middle) + force(after)) / (kCurvatureStep * kCurvatureStep);
}

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
std::vector<int> Blocks(std::initializer_list<int> splines,
                        std::initializer_list<int> shared,
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
  SensorBlocks* position = joint_->Find(Quantity::kPosition, session_);
  SensorBlocks* rotation = joint_->Find(Quantity::kRotation, session_);
  const std::vector<TimedPose>& poses = prepared_.data.poses;
  std::vector<JointPoseSample> all;
  const std::vector<size_t> kept = Collect(
      joint_->options.Threads(), poses.size(), &all, [&](size_t i, JointPoseSample* sample) {
        const TimedPose& pose = poses[i];
        const auto sigma = [i](const SensorBlocks& sensor, double scale) {
          return sensor.model->noise * scale / std::sqrt(sensor.model->weights[i]);
        };
        MarkerState<double> gp;
        if (!FindPoint(pose.t, &sample->place, &gp)) return false;
        sample->q_error = gp.q_WM.conjugate() * pose.q_WM;
        sample->p_error = pose.p_WM - gp.p_WM;
        sample->alpha_M = gp.alpha_M;
        sample->a_W = gp.a_W;
        sample->reference_time = ReferenceTime(pose.t);
        sample->position_sigma = sigma(*position, pose.position_scale);
        sample->rotation_sigma = sigma(*rotation, pose.rotation_scale);
        return true;
      });
  position->samples.reserve(kept.size());
  rotation->samples.reserve(kept.size());
  for (size_t k = 0; k < kept.size(); ++k) {
    position->samples.push_back({kept[k], poses[kept[k]].t, all[k].position_sigma});
    rotation->samples.push_back({kept[k], poses[kept[k]].t, all[k].rotation_sigma});
  }
  const size_t count = all.size();
  const Samples<JointPoseSample> samples(std::move(all));
  const auto share_span = [&](size_t i, size_t j) {
    return samples[i].place.first == samples[j].place.first;
  };
  const int pose_smoothing = problem.Find(&joint_->estimate->pose_smoothing);
  const int position_smoothing = problem.Find(&joint_->estimate->position_smoothing);
  ForRuns(count, share_span, [&](size_t begin, size_t end) {
    const auto first = static_cast<int>(samples[begin].place.first);
    position->Add(problem.AddResiduals(
                      CreateJointPositionResidual(samples.Part(begin, end), clocks.motions),
                      Blocks({d_ + first}, {pose_smoothing, position_smoothing}, clocks.blocks)),
                  position->samples[begin].t);
  });
  ForRuns(count, share_span, [&](size_t begin, size_t end) {
    const auto first = static_cast<int>(samples[begin].place.first);
    rotation->Add(
        problem.AddResiduals(CreateJointRotationResidual(samples.Part(begin, end), clocks.motions),
                             Blocks({phi_ + first}, {pose_smoothing}, clocks.blocks)),
        rotation->samples[begin].t);
  });
}

template <typename Sample, typename Complete, typename Add>
void SessionBuilder::AddImu(size_t imu,
                            Quantity quantity,
                            const std::vector<TimedSample>& data,
                            double delay,
                            BiasKnots* knots,
                            const Complete& complete,
                            const Add& add) {
  const ImuSessionEstimate& clock = estimate_.imus[imu];
  SensorBlocks* sensor = joint_->Find(quantity, session_, imu);
  std::vector<Sample> all;
  std::vector<int> knot(data.size());
  const std::vector<size_t> kept =
      Collect(joint_->options.Threads(), data.size(), &all, [&](size_t i, Sample* sample) {
        const double t_M = clock.PoseTime(data[i].t - delay);
        const auto [k, u] = knots->Locate(data[i].t);
        knot[i] = static_cast<int>(k);
        sample->value = data[i].value;
        sample->bias_u = u;
        sample->own_time = data[i].t - delay - clock.clock_reference;
        sample->reference_time = ReferenceTime(t_M);
        sample->sigma = sensor->model->noise / std::sqrt(sensor->model->weights[i]);
        return complete(t_M, sample) && IsOnTrajectory(*prepared_.trajectory, t_M);
      });
  sensor->samples.reserve(kept.size());
  for (size_t k = 0; k < kept.size(); ++k)
    sensor->samples.push_back({kept[k], clock.PoseTime(data[kept[k]].t - delay), all[k].sigma});
  const size_t count = all.size();
  const Samples<Sample> samples(std::move(all));
  int first_knot = -1;  // the others follow
  for (Eigen::Vector3d& value : knots->values) {
    const int block = joint_->problem.AddParameters(value.data(), 3);
    if (first_knot < 0) first_knot = block;
  }
  const auto are_alike = [&](size_t i, size_t j) {
    return samples[i].place.first == samples[j].place.first && knot[kept[i]] == knot[kept[j]];
  };
  ForRuns(count, are_alike, [&](size_t begin, size_t end) {
    sensor->Add(add(samples.Part(begin, end),
                    static_cast<int>(samples[begin].place.first),
                    first_knot + knot[kept[begin]]),
                sensor->samples[begin].t);
  });
}

void SessionBuilder::AddGyro(size_t imu) {
  const Clocks clocks = FindClocks(&imu, false);
  Problem& problem = joint_->problem;
  ImuEstimate& rig = joint_->estimate->imus[imu];
  const int q_MI = problem.Find(rig.q_MI.coeffs().data());
  const int intrinsics = problem.Find(rig.gyro_intrinsics.data());
  AddImu<JointImuSample>(
      imu,
      Quantity::kGyro,
      prepared_.data.imus[imu].gyro,
      0.0,
      &estimate_.imus[imu].gyro_bias,
      [&](double t_M, JointImuSample* sample) {
        MarkerState<double> gp;
        if (!FindPoint(t_M, &sample->place, &gp)) return false;
        sample->omega_M = gp.omega_M;
        sample->alpha_M = gp.alpha_M;
        return true;
      },
      [&](const Samples<JointImuSample>& samples, int first, int knot) {
        return problem.AddResiduals(
            CreateJointGyroResidual(samples, clocks.motions),
            Blocks({phi_ + first}, {q_MI, intrinsics, knot, knot + 1}, clocks.blocks));
      });
}

void SessionBuilder::AddAccel(size_t imu) {
  const Clocks clocks = FindClocks(&imu, true);
  Problem& problem = joint_->problem;
  ImuEstimate& rig = joint_->estimate->imus[imu];
  const Eigen::Matrix3d R_MA = rig.q_MI.toRotationMatrix();
  const bool with_curvature =
      rig.accel_smoothing != 0.0 || problem.IsEstimated(&rig.accel_smoothing);
  const auto complete = [&](double t_M, JointAccelSample* sample) {
    MarkerState<double> gp, rate;
    if (!FindPoint(t_M, &sample->place, &gp, &rate)) return false;
    sample->q_WM = gp.q_WM;
    sample->omega_M = gp.omega_M;
    sample->alpha_M = gp.alpha_M;
    sample->a_W = gp.a_W;
    sample->jerk = {rate.alpha_M, rate.a_W};
    if (with_curvature) sample->jerk.f_curvature = ForceCurvature(gp, t_M, rig.p_MI);
    return true;
  };
  const int q_MI = problem.Find(rig.q_MI.coeffs().data());
  const int p_MI = problem.Find(rig.p_MI.data());
  const int g_W = problem.Find(estimate_.g_W.data());
  const int intrinsics = problem.Find(rig.accel_intrinsics.data());
  const int smoothing = problem.Find(&rig.accel_smoothing);
  const int scale = problem.Find(&joint_->estimate->pose_scale);
  const int positions = problem.Find(rig.accel_positions.data());
  AddImu<JointAccelSample>(
      imu,
      Quantity::kAccel,
      prepared_.data.imus[imu].accel,
      rig.accel_delay,
      &estimate_.imus[imu].accel_bias,
      complete,
      [&](const Samples<JointAccelSample>& samples, int first, int knot) {
        return problem.AddResiduals(
            CreateJointAccelResidual(samples, R_MA, clocks.motions),
            Blocks({d_ + first, phi_ + first},
                   {q_MI, p_MI, g_W, intrinsics, knot, knot + 1, smoothing, scale, positions},
                   clocks.blocks));
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
                       kSmoothingPerDelay2 * delay * std::abs(delay),
                       i);
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
    SessionBuilder builder(
        s, first((*splines)[s].d), first((*splines)[s].phi), &(*splines)[s], joint.get());
    builder.AddPoses();
    for (size_t i = 0; i < estimate->imus.size(); ++i) {
      ImuSessionEstimate& imu = estimate->sessions[s].imus[i];
      if (!imu.is_present) continue;
      builder.AddGyro(i);
      builder.AddAccel(i);
      joint->AddBiasWalk(options.gyro_bias_walk, s, i, &imu.gyro_bias);
      joint->AddBiasWalk(options.accel_bias_walk, s, i, &imu.accel_bias);
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
