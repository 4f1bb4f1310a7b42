#include "imu_pose_calib/core/joint_problem.h"

#include <algorithm>
#include <cmath>
#include <optional>
#include <utility>

#include "imu_pose_calib/core/joint_noise.h"
#include "imu_pose_calib/core/joint_residuals.h"

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

/// Of the elements of a matrix in rows, or of its lower triangle.
Eigen::VectorXd IntrinsicsPrior(bool is_triangle) {
  std::vector<double> sigmas;
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < (is_triangle ? row + 1 : 3); ++column)
      sigmas.push_back(row == column ? kScalePrior : kAlignmentPrior);
  return Eigen::Map<Eigen::VectorXd>(sigmas.data(), static_cast<Eigen::Index>(sigmas.size()));
}

/// Adds the residual blocks of one session.
class SessionBuilder {
 public:
  SessionBuilder(size_t session, CorrectionSplines* splines, LeastSquares* joint);

  void AddPoses();
  void AddGyro(size_t imu);
  void AddAccel(size_t imu);

 private:
  /// A parameter of the clocks with how samples move with it.
  struct Clock {
    double* parameter;
    ClockMotion motion;
  };
  /// How the samples of an IMU's sensor move along the trajectory, of which the splines go along
  /// with the accelerometer of the reference IMU; of poses when `imu` is null.
  std::vector<Clock> Clocks(const size_t* imu, bool is_accel);
  /// IMU samples of stamp t at the instant t - delay: consecutive ones that share a span and a pair
  /// of bias knots are handed to `create(batch, jerks, control points' index, knot)`, which returns
  /// their block.
  template <typename Create>
  void AddImu(size_t imu,
              Quantity quantity,
              const std::vector<TimedSample>& samples,
              double delay,
              bool with_jerks,
              const BiasKnots& knots,
              const Create& create);
  /// The trajectory at t [s]; nothing when it is not on a spline.
  std::optional<TrajectoryPoint> PointAt(double t, MarkerJerk* jerk = nullptr) const;
  /// f_M'' of the GP at t [s], where it moves as `middle`; [m/s^4], components in M.
  Eigen::Vector3d ForceCurvature(const MarkerState<double>& middle,
                                 double t,
                                 const Eigen::Vector3d& p_MI) const;
  std::vector<double*> ControlPoints(std::vector<Eigen::Vector3d>* spline, size_t first) const;
  double ReferenceTime(double t_M) const {
    return reference_.ImuTime(t_M) - reference_.clock_reference;
  }

  const size_t session_;
  CorrectionSplines* const splines_;
  LeastSquares* const joint_;
  const PreparedSession& prepared_;
  SessionEstimate& estimate_;
  const size_t first_imu_;
  ImuSessionEstimate& reference_;  ///< clock of the first IMU
};

SessionBuilder::SessionBuilder(size_t session, CorrectionSplines* splines, LeastSquares* joint)
    : session_(session),
      splines_(splines),
      joint_(joint),
      prepared_(joint->sessions[session]),
      estimate_(joint->estimate->sessions[session]),
      first_imu_(estimate_.FirstImu()),
      reference_(estimate_.imus[first_imu_]) {}

std::optional<TrajectoryPoint> SessionBuilder::PointAt(double t, MarkerJerk* jerk) const {
  TrajectoryPoint point;
  MarkerState<double> rate;
  const auto place = splines_->Locate(t);
  if (!place || !prepared_.trajectory->Evaluate(t, &point.gp, jerk == nullptr ? nullptr : &rate))
    return std::nullopt;
  if (jerk != nullptr) *jerk = {rate.alpha_M, rate.a_W};
  point.place = *place;
  return point;
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

std::vector<double*> SessionBuilder::ControlPoints(std::vector<Eigen::Vector3d>* spline,
                                                   size_t first) const {
  std::vector<double*> blocks;
  for (size_t j = first; j < first + kSplineOrder; ++j) blocks.push_back((*spline)[j].data());
  return blocks;
}

std::vector<SessionBuilder::Clock> SessionBuilder::Clocks(const size_t* imu, bool is_accel) {
  std::vector<Clock> clocks;
  const auto add = [&](double* parameter, double on_gp, double on_spline, auto factor) {
    clocks.push_back({parameter, {*parameter, on_gp, on_spline, factor}});
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
  if (imu == nullptr) return clocks;
  const double on_spline = is_reference ? 0.0 : 1.0;
  add(&estimate_.imus[*imu].time_shift, 1.0, on_spline, ClockMotion::kOne);
  add(&estimate_.imus[*imu].clock_drift, 1.0, on_spline, ClockMotion::kOwnTime);
  if (is_accel) add(&joint_->estimate->imus[*imu].accel_delay, -1.0, -on_spline, ClockMotion::kOne);
  return clocks;
}

/// The motions of clocks, for residuals, and their parameters, for the problem.
template <typename Clocks>
std::pair<ClockMotions, std::vector<double*>> Split(const Clocks& clocks) {
  auto motions = std::make_shared<std::vector<ClockMotion>>();
  std::vector<double*> parameters;
  for (const auto& clock : clocks) {
    motions->push_back(clock.motion);
    parameters.push_back(clock.parameter);
  }
  return {motions, parameters};
}

void SessionBuilder::AddPoses() {
  const auto [motions, clocks] = Split(Clocks(nullptr, false));
  SensorBlocks* position = joint_->Find(Quantity::kPosition, session_);
  SensorBlocks* rotation = joint_->Find(Quantity::kRotation, session_);
  std::vector<JointPoseSample> positions, rotations;
  std::vector<ProblemSample> position_samples, rotation_samples;
  const auto add_blocks = [&, &motions = motions, &clocks = clocks] {
    if (positions.empty()) return;
    const size_t first = positions.front().at.place.first;
    const auto add = [&](std::vector<Eigen::Vector3d>* spline,
                         const std::vector<double*>& smoothing,
                         ceres::CostFunction* residual,
                         std::vector<ProblemSample>* samples,
                         SensorBlocks* sensor) {
      std::vector<double*> blocks = ControlPoints(spline, first);
      blocks.insert(blocks.end(), smoothing.begin(), smoothing.end());
      blocks.insert(blocks.end(), clocks.begin(), clocks.end());
      sensor->Add(joint_->problem.AddResidualBlock(residual, nullptr, blocks), *samples);
      samples->clear();
    };
    Estimate& estimate = *joint_->estimate;
    add(&splines_->d,
        {&estimate.pose_smoothing, &estimate.position_smoothing},
        CreateJointPositionResidual(positions, motions),
        &position_samples,
        position);
    add(&splines_->phi,
        {&estimate.pose_smoothing},
        CreateJointRotationResidual(rotations, motions),
        &rotation_samples,
        rotation);
    positions.clear();
    rotations.clear();
  };
  for (size_t i = 0; i < prepared_.data.poses.size(); ++i) {
    const TimedPose& pose = prepared_.data.poses[i];
    const auto point = PointAt(pose.t);
    if (!point) continue;
    if (!positions.empty() && positions.front().at.place.first != point->place.first) add_blocks();
    const auto sigma = [i](const SensorBlocks& sensor, double scale) {
      return sensor.model->noise * scale / std::sqrt(sensor.model->weights[i]);
    };
    JointPoseSample sample{
        *point, pose.q_WM, pose.p_WM, ReferenceTime(pose.t), sigma(*position, pose.position_scale)};
    positions.push_back(sample);
    position_samples.push_back(
        {i, pose.t, sample.sigma, 0.0, pose.position_scale, pose.position_rest});
    sample.sigma = sigma(*rotation, pose.rotation_scale);
    rotations.push_back(sample);
    rotation_samples.push_back(
        {i, pose.t, sample.sigma, 0.0, pose.rotation_scale, pose.rotation_rest});
  }
  add_blocks();
}

template <typename Create>
void SessionBuilder::AddImu(size_t imu,
                            Quantity quantity,
                            const std::vector<TimedSample>& samples,
                            double delay,
                            bool with_jerks,
                            const BiasKnots& knots,
                            const Create& create) {
  const ImuSessionEstimate& clock = estimate_.imus[imu];
  SensorBlocks* sensor = joint_->Find(quantity, session_, imu);
  std::vector<JointImuSample> batch;
  std::vector<MarkerJerk> jerks;
  std::vector<ProblemSample> batch_samples;
  size_t knot = 0;
  ImuEstimate& rig = joint_->estimate->imus[imu];
  const bool with_curvature =
      with_jerks && (rig.accel_smoothing != 0.0 ||
                     !joint_->problem.IsParameterBlockConstant(&rig.accel_smoothing));
  const auto add_block = [&] {
    if (batch.empty()) return;
    const size_t first = batch.front().at.place.first;
    sensor->Add(create(batch, jerks, first, knot), batch_samples);
    batch.clear();
    jerks.clear();
    batch_samples.clear();
  };
  for (size_t i = 0; i < samples.size(); ++i) {
    const double t_M = clock.PoseTime(samples[i].t - delay);
    MarkerJerk jerk;
    const auto point = PointAt(t_M, with_jerks ? &jerk : nullptr);
    if (!point || !IsOnTrajectory(*prepared_.trajectory, t_M)) continue;
    if (with_curvature) jerk.f_curvature = ForceCurvature(point->gp, t_M, rig.p_MI);
    const auto [k, u] = knots.Locate(samples[i].t);
    if (!batch.empty() && (batch.front().at.place.first != point->place.first || knot != k))
      add_block();
    knot = k;
    const double sigma = sensor->model->noise / std::sqrt(sensor->model->weights[i]);
    batch.push_back({*point,
                     samples[i].value,
                     u,
                     samples[i].t - delay - clock.clock_reference,
                     ReferenceTime(t_M),
                     sigma});
    if (with_jerks) jerks.push_back(jerk);
    batch_samples.push_back({i, t_M, sigma, 0.0, 1.0, samples[i].rest});
  }
  add_block();
}

void SessionBuilder::AddGyro(size_t imu) {
  const auto [motions, clocks] = Split(Clocks(&imu, false));
  ImuEstimate& rig = joint_->estimate->imus[imu];
  BiasKnots& knots = estimate_.imus[imu].gyro_bias;
  const auto create = [&, &motions = motions, &clocks = clocks](
                          const std::vector<JointImuSample>& batch,
                          const std::vector<MarkerJerk>&,
                          size_t first,
                          size_t knot) {
    std::vector<double*> blocks = ControlPoints(&splines_->phi, first);
    blocks.insert(blocks.end(),
                  {rig.q_MI.coeffs().data(),
                   rig.gyro_intrinsics.data(),
                   knots.values[knot].data(),
                   knots.values[knot + 1].data()});
    blocks.insert(blocks.end(), clocks.begin(), clocks.end());
    return joint_->problem.AddResidualBlock(
        CreateJointGyroResidual(batch, motions), nullptr, blocks);
  };
  AddImu(imu, Quantity::kGyro, prepared_.data.imus[imu].gyro, 0.0, false, knots, create);
}

void SessionBuilder::AddAccel(size_t imu) {
  const auto [motions, clocks] = Split(Clocks(&imu, true));
  ImuEstimate& rig = joint_->estimate->imus[imu];
  BiasKnots& knots = estimate_.imus[imu].accel_bias;
  const Eigen::Matrix3d R_MA = rig.q_MI.toRotationMatrix();
  const auto create = [&, &motions = motions, &clocks = clocks](
                          const std::vector<JointImuSample>& batch,
                          const std::vector<MarkerJerk>& jerks,
                          size_t first,
                          size_t knot) {
    std::vector<double*> blocks = ControlPoints(&splines_->d, first);
    const std::vector<double*> phi = ControlPoints(&splines_->phi, first);
    blocks.insert(blocks.end(), phi.begin(), phi.end());
    blocks.insert(blocks.end(),
                  {rig.q_MI.coeffs().data(),
                   rig.p_MI.data(),
                   estimate_.g_W.data(),
                   rig.accel_intrinsics.data(),
                   knots.values[knot].data(),
                   knots.values[knot + 1].data(),
                   &rig.accel_smoothing,
                   &joint_->estimate->pose_scale,
                   rig.accel_positions.data()});
    blocks.insert(blocks.end(), clocks.begin(), clocks.end());
    return joint_->problem.AddResidualBlock(
        CreateJointAccelResidual(batch, jerks, R_MA, motions), nullptr, blocks);
  };
  AddImu(
      imu, Quantity::kAccel, prepared_.data.imus[imu].accel, rig.accel_delay, true, knots, create);
}

}  // namespace

std::unique_ptr<LeastSquares> BuildJointProblem(const CalibrationOptions& options,
                                                const std::vector<PreparedSession>& sessions,
                                                const std::vector<SensorModel>& models,
                                                Estimate* estimate,
                                                std::vector<CorrectionSplines>* splines) {
  auto joint = std::make_unique<LeastSquares>(options, sessions, models, estimate);
  for (CorrectionSplines& own : *splines) {
    for (auto* points : {&own.d, &own.phi}) {
      for (Eigen::Vector3d& point : *points) {
        joint->problem.AddParameterBlock(point.data(), 3);
        joint->trajectory_blocks.push_back(point.data());
      }
    }
  }
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
      joint->problem.SetParameterBlockConstant(&estimate->imus[i].accel_smoothing);
  }
  joint->AddOptional(ParameterKind::kGyroIntrinsics, IntrinsicsPrior(true));
  joint->AddOptional(ParameterKind::kAccelIntrinsics, IntrinsicsPrior(false));
  joint->AddOptional(ParameterKind::kAccelPositions, Eigen::VectorXd::Constant(6, kSizePrior));
  for (size_t s = 0; s < sessions.size(); ++s) {
    (*splines)[s].is_with_poses = DoPosesLead((*splines)[s], s, *joint);
    SessionBuilder builder(s, &(*splines)[s], joint.get());
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
    if (!is_clock || !joint->options.estimate_clock_drift)
      joint->problem.SetParameterBlockConstant(p.data);
  }
}

}  // namespace imu_pose_calib
