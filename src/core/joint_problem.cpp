#include "imu_pose_calib/core/joint_problem.h"

#include <algorithm>
#include <cmath>

#include "imu_pose_calib/core/joint_residuals.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kMinSpans = 4;  // shorter runs say little and are left out

}  // namespace

CorrectionSplines::CorrectionSplines(const ConditionedData& data,
                                     const Estimate& estimate,
                                     double spacing_s) {
  const double imu_begin =
      std::max(data.gyro.front().t, data.accel.front().t) + estimate.time_shift;
  const double imu_end = std::min(data.gyro.back().t, data.accel.back().t) + estimate.time_shift;
  size_t points = 0;
  for (const IndexRange& segment : data.segments) {
    const double begin = std::max(imu_begin, data.poses[segment.begin].t);
    const double end = std::min(imu_end, data.poses[segment.end - 1].t);
    if (end - begin < static_cast<double>(kMinSpans) * spacing_s) continue;
    const auto spans = static_cast<size_t>(std::round((end - begin) / spacing_s));
    ranges_.push_back({begin, end, (end - begin) / static_cast<double>(spans), points, spans});
    points += spans + kSplineOrder - 1;
  }
  if (ranges_.empty()) throw DataError("poses and IMU samples have no run without a gap in common");
  d.assign(points, Eigen::Vector3d::Zero());
  phi.assign(points, Eigen::Vector3d::Zero());
}

const CorrectionSplines::Range* CorrectionSplines::Find(double t) const {
  const auto after =
      std::upper_bound(ranges_.begin(), ranges_.end(), t, [](double value, const Range& range) {
        return value < range.begin;
      });
  if (after == ranges_.begin()) return nullptr;
  const Range& range = *std::prev(after);
  return t <= range.end ? &range : nullptr;
}

std::optional<CorrectionSplines::Place> CorrectionSplines::Locate(double t) const {
  const Range* range = Find(t);
  if (range == nullptr) return std::nullopt;
  const double x = (t - range->begin) / range->spacing;
  const size_t span = std::min(range->spans - 1, static_cast<size_t>(x));
  return Place{range->first + span, x - static_cast<double>(span), range->spacing};
}

JointProblem::JointProblem(const CalibrationOptions& options,
                           const PoseTrajectory& trajectory,
                           const ConditionedData& data,
                           const NoiseStd& noise,
                           Estimate* estimate,
                           CorrectionSplines* splines)
    : CalibrationProblem(options, trajectory, data, noise, estimate), splines_(splines) {
  for (auto* points : {&splines_->d, &splines_->phi}) {
    for (Eigen::Vector3d& point : *points) {
      problem_.AddParameterBlock(point.data(), 3);
      trajectory_blocks_.push_back(point.data());
    }
  }
  AddRotation();
  AddGravityAndDelay();
  AddPoses();
  AddGyro();
  AddAccel();
  AddBiasWalk(options_.gyro_bias_walk, &estimate_->gyro_bias);
  AddBiasWalk(options_.accel_bias_walk, &estimate_->accel_bias);
}

void JointProblem::AddPoses() {
  for (const TimedPose& pose : data_.poses) {
    const auto place = splines_->Locate(pose.t);
    if (!place) continue;
    const PoseTrajectory::Pose gp = trajectory_.PoseAt(pose.t);
    const SplineWeights weights = CubicWeights(place->u, place->spacing);
    const double t_imu = pose.t - estimate_->time_shift;
    position_terms_.push_back(
        {problem_.AddResidualBlock(
             CreatePositionResidual(pose.p_WM - gp.p_WM, weights, noise_.position),
             Loss(),
             ControlPoints({&splines_->d}, *place)),
         t_imu,
         noise_.position});
    rotation_terms_.push_back(
        {problem_.AddResidualBlock(
             CreateRotationResidual(gp.q_WM.conjugate() * pose.q_WM, weights, noise_.rotation),
             Loss(),
             ControlPoints({&splines_->phi}, *place)),
         t_imu,
         noise_.rotation});
  }
}

void JointProblem::AddGyro() {
  BiasKnots& knots = estimate_->gyro_bias;
  for (const TimedSample& s : data_.gyro) {
    const double t_M = s.t + estimate_->time_shift;
    const auto place = splines_->Locate(t_M);
    if (!place || !IsOnTrajectory(t_M)) continue;
    const auto [k, u] = knots.Locate(s.t);
    const double span_begin = t_M - place->u * place->spacing;
    std::vector<double*> blocks = ControlPoints({&splines_->phi}, *place);
    blocks.insert(blocks.end(),
                  {estimate_->q_MI.coeffs().data(),
                   knots.values[k].data(),
                   knots.values[k + 1].data(),
                   &estimate_->time_shift});
    gyro_terms_.push_back(
        {problem_.AddResidualBlock(
             CreateJointGyroResidual(
                 {&trajectory_, s.t, s.value, u, noise_.gyro, span_begin, place->spacing}),
             Loss(),
             blocks),
         s.t,
         noise_.gyro});
  }
}

void JointProblem::AddAccel() {
  BiasKnots& knots = estimate_->accel_bias;
  const double accel_variance = noise_.accel * noise_.accel;
  for (const TimedSample& s : data_.accel) {
    const double t_M = s.t + estimate_->time_shift - estimate_->accel_delay;
    const auto place = splines_->Locate(t_M);
    if (!place || !IsOnTrajectory(t_M)) continue;
    const auto [k, u] = knots.Locate(s.t);
    feigned_information_ += LeverArmErrors(t_M, place->spacing) / accel_variance;
    const double span_begin = t_M - place->u * place->spacing;
    std::vector<double*> blocks = ControlPoints({&splines_->d, &splines_->phi}, *place);
    blocks.insert(blocks.end(),
                  {estimate_->q_MI.coeffs().data(),
                   estimate_->p_MI.data(),
                   estimate_->g_W.data(),
                   knots.values[k].data(),
                   knots.values[k + 1].data(),
                   &estimate_->time_shift,
                   &estimate_->accel_delay});
    accel_terms_.push_back(
        {problem_.AddResidualBlock(
             CreateJointAccelResidual(
                 {&trajectory_, s.t, s.value, u, noise_.accel, span_begin, place->spacing}),
             Loss(),
             blocks),
         s.t,
         noise_.accel});
  }
}

double JointProblem::LeverArmErrors(double t_M, double spacing) const {
  // What the gyroscope leaves of white noise in the splines' band B = 1 / (2 spacing): the share
  // 2 B / rate in omega, and (2 pi B)^2 / 3 times that in alpha. Poses and gyroscope add up.
  const double gyro_omega =
      noise_.gyro * noise_.gyro / std::max(1.0, spacing * data_.gyro_report.rate_hz);
  const double gyro_alpha = std::pow(M_PI / spacing, 2) / 3.0 * gyro_omega;
  const MarkerVariance gp = trajectory_.Variance(t_M);
  MarkerState<double> state;
  trajectory_.Evaluate(t_M, &state);
  const double omega = 1.0 / (1.0 / gyro_omega + 1.0 / gp.omega);
  const double alpha = 1.0 / (1.0 / gyro_alpha + 1.0 / gp.alpha);
  return LeverArmCoefficientVariance(alpha, omega, state.omega_M.squaredNorm());
}

std::vector<double*> JointProblem::ControlPoints(
    const std::vector<std::vector<Eigen::Vector3d>*>& splines,
    const CorrectionSplines::Place& place) const {
  std::vector<double*> blocks;
  for (auto* points : splines)
    for (int j = 0; j < kSplineOrder; ++j)
      blocks.push_back((*points)[place.first + static_cast<size_t>(j)].data());
  return blocks;
}

}  // namespace imu_pose_calib
