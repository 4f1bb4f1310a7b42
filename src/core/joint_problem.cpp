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

std::optional<SplinePlace> CorrectionSplines::Locate(double t) const {
  const Range* range = Find(t);
  if (range == nullptr) return std::nullopt;
  const double x = (t - range->begin) / range->spacing;
  const size_t span = std::min(range->spans - 1, static_cast<size_t>(x));
  return SplinePlace{range->first + span, x - static_cast<double>(span), range->spacing};
}

JointProblem::JointProblem(const CalibrationOptions& options,
                           const PoseTrajectory& trajectory,
                           const ConditionedData& data,
                           const NoiseStd& noise,
                           const SampleWeights& weights,
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
  AddPoses(weights);
  AddGyro(weights);
  AddAccel(weights);
  AddBiasWalk(options_.gyro_bias_walk, &estimate_->gyro_bias);
  AddBiasWalk(options_.accel_bias_walk, &estimate_->accel_bias);
}

void JointProblem::AddPoses(const SampleWeights& weights) {
  for (size_t i = 0; i < data_.poses.size(); ++i) {
    const TimedPose& pose = data_.poses[i];
    const auto place = splines_->Locate(pose.t);
    if (!place) continue;
    const PoseTrajectory::Pose gp = trajectory_.PoseAt(pose.t);
    const SplineWeights spline = CubicWeights(place->u, place->spacing);
    const double t_imu = pose.t - estimate_->time_shift;
    const double position_sigma = noise_.position / std::sqrt(weights.position[i]);
    const double rotation_sigma = noise_.rotation / std::sqrt(weights.rotation[i]);
    position_terms_.push_back(
        {problem_.AddResidualBlock(
             CreatePositionResidual(pose.p_WM - gp.p_WM, spline, position_sigma),
             nullptr,
             ControlPoints({&splines_->d}, *place)),
         i,
         t_imu,
         position_sigma});
    rotation_terms_.push_back(
        {problem_.AddResidualBlock(
             CreateRotationResidual(gp.q_WM.conjugate() * pose.q_WM, spline, rotation_sigma),
             nullptr,
             ControlPoints({&splines_->phi}, *place)),
         i,
         t_imu,
         rotation_sigma});
  }
}

std::optional<JointImuSample> JointProblem::Sample(const TimedSample& sample,
                                                   double delay,
                                                   double sigma) const {
  const double t_M = sample.t + estimate_->time_shift - delay;
  const auto place = splines_->Locate(t_M);
  JointImuSample s;
  if (!place || !IsOnTrajectory(t_M) || !trajectory_.Evaluate(t_M, &s.gp, &s.gp_rate))
    return std::nullopt;
  s.place = *place;
  s.t_M = t_M;
  s.t = sample.t;
  s.value = sample.value;
  s.sigma = sigma;
  return s;
}

void JointProblem::AddGyro(const SampleWeights& weights) {
  BiasKnots& knots = estimate_->gyro_bias;
  for (size_t i = 0; i < data_.gyro.size(); ++i) {
    auto sample = Sample(data_.gyro[i], 0.0, noise_.gyro / std::sqrt(weights.gyro[i]));
    if (!sample) continue;
    const auto [k, u] = knots.Locate(sample->t);
    sample->bias_u = u;
    std::vector<double*> blocks = ControlPoints({&splines_->phi}, sample->place);
    blocks.insert(blocks.end(),
                  {estimate_->q_MI.coeffs().data(),
                   knots.values[k].data(),
                   knots.values[k + 1].data(),
                   &estimate_->time_shift});
    gyro_terms_.push_back(
        {problem_.AddResidualBlock(CreateJointGyroResidual(*sample), nullptr, blocks),
         i,
         sample->t,
         sample->sigma});
  }
}

void JointProblem::AddAccel(const SampleWeights& weights) {
  BiasKnots& knots = estimate_->accel_bias;
  for (size_t i = 0; i < data_.accel.size(); ++i) {
    auto sample =
        Sample(data_.accel[i], estimate_->accel_delay, noise_.accel / std::sqrt(weights.accel[i]));
    if (!sample) continue;
    const auto [k, u] = knots.Locate(sample->t);
    sample->bias_u = u;
    feigned_information_ += LeverArmErrors(*sample) / (sample->sigma * sample->sigma);
    std::vector<double*> blocks = ControlPoints({&splines_->d, &splines_->phi}, sample->place);
    blocks.insert(blocks.end(),
                  {estimate_->q_MI.coeffs().data(),
                   estimate_->p_MI.data(),
                   estimate_->g_W.data(),
                   knots.values[k].data(),
                   knots.values[k + 1].data(),
                   &estimate_->time_shift,
                   &estimate_->accel_delay});
    accel_terms_.push_back(
        {problem_.AddResidualBlock(CreateJointAccelResidual(*sample), nullptr, blocks),
         i,
         sample->t,
         sample->sigma});
  }
}

void JointProblem::UpdateWeights(const NoiseStd& noise, SampleWeights* weights) {
  const auto update =
      [this](const std::vector<Term>& terms, double sigma, std::vector<double>* sample_weights) {
        ceres::Problem::EvaluateOptions evaluate;
        for (const Term& term : terms) evaluate.residual_blocks.push_back(term.id);
        std::vector<double> residuals;
        problem_.Evaluate(evaluate, nullptr, &residuals, nullptr, nullptr);
        for (size_t i = 0; i < terms.size(); ++i) {
          const double r =
              Eigen::Map<const Eigen::Vector3d>(&residuals[3 * i]).norm() * terms[i].sigma / sigma;
          (*sample_weights)[terms[i].sample] =
              1.0 / (1.0 + std::pow(r / options_.robust_loss_scale, 2));
        }
      };
  update(position_terms_, noise.position, &weights->position);
  update(rotation_terms_, noise.rotation, &weights->rotation);
  update(gyro_terms_, noise.gyro, &weights->gyro);
  update(accel_terms_, noise.accel, &weights->accel);
}

double JointProblem::LeverArmErrors(const JointImuSample& sample) const {
  // What the gyroscope leaves of white noise in the splines' band B = 1 / (2 spacing): the share
  // 2 B / rate in omega, and (2 pi B)^2 / 3 times that in alpha. Poses and gyroscope add up.
  const double spacing = sample.place.spacing;
  const double gyro_omega =
      noise_.gyro * noise_.gyro / std::max(1.0, spacing * data_.gyro_report.rate_hz);
  const double gyro_alpha = std::pow(M_PI / spacing, 2) / 3.0 * gyro_omega;
  const MarkerVariance gp = trajectory_.Variance(sample.t_M);
  const double omega = 1.0 / (1.0 / gyro_omega + 1.0 / gp.omega);
  const double alpha = 1.0 / (1.0 / gyro_alpha + 1.0 / gp.alpha);
  return LeverArmCoefficientVariance(alpha, omega, sample.gp.omega_M.squaredNorm());
}

std::vector<double*> JointProblem::ControlPoints(
    const std::vector<std::vector<Eigen::Vector3d>*>& splines,
    const SplinePlace& place) const {
  std::vector<double*> blocks;
  for (auto* points : splines)
    for (int j = 0; j < kSplineOrder; ++j)
      blocks.push_back((*points)[place.first + static_cast<size_t>(j)].data());
  return blocks;
}

}  // namespace imu_pose_calib
