#include "imu_pose_calib/core/joint_problem.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "imu_pose_calib/core/joint_residuals.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kMinSpans = 4;            // shorter runs say little and are left out
constexpr double kIntrinsicsPrior = 0.05;  // [1] sigma of each element of M_g and M_a

}  // namespace

CorrectionSplines::CorrectionSplines(const ConditionedData& data,
                                     const Estimate& estimate,
                                     double spacing_s) {
  const double imu_begin = estimate.PoseTime(std::max(data.gyro.front().t, data.accel.front().t));
  const double imu_end = estimate.PoseTime(std::min(data.gyro.back().t, data.accel.back().t));
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
  AddGyroParameters();
  AddAccelParameters();
  problem_.AddParameterBlock(&estimate_->clock_drift, 1);
  SetConstantUnless(options_.estimate_clock_drift, &estimate_->clock_drift);
  const bool intrinsics = options_.imu_model == ImuModel::kScaleMisalignment;
  problem_.AddParameterBlock(estimate_->gyro_intrinsics.data(), 6);
  problem_.AddParameterBlock(estimate_->accel_intrinsics.data(), 9);
  SetConstantUnless(intrinsics, estimate_->gyro_intrinsics.data());
  SetConstantUnless(intrinsics, estimate_->accel_intrinsics.data());
  if (intrinsics) {
    AddPrior(estimate_->gyro_intrinsics.data(), 6, kIntrinsicsPrior);
    AddPrior(estimate_->accel_intrinsics.data(), 9, kIntrinsicsPrior);
  }
  AddPoses(weights);
  AddGyro(weights);
  AddAccel(weights);
  AddBiasWalk(options_.gyro_bias_walk, &estimate_->gyro_bias);
  AddBiasWalk(options_.accel_bias_walk, &estimate_->accel_bias);
}

void JointProblem::AddPoses(const SampleWeights& weights) {
  std::vector<JointPositionSample> positions;
  std::vector<JointRotationSample> rotations;
  std::vector<Sample> position_samples, rotation_samples;
  size_t first = 0;
  const auto add_blocks = [&] {
    if (positions.empty()) return;
    position_.Add(problem_.AddResidualBlock(CreatePositionResidual(std::move(positions)),
                                            nullptr,
                                            ControlPoints(&splines_->d, first)),
                  position_samples);
    rotation_.Add(problem_.AddResidualBlock(CreateRotationResidual(std::move(rotations)),
                                            nullptr,
                                            ControlPoints(&splines_->phi, first)),
                  rotation_samples);
    positions.clear();
    rotations.clear();
    position_samples.clear();
    rotation_samples.clear();
  };
  for (size_t i = 0; i < data_.poses.size(); ++i) {
    const TimedPose& pose = data_.poses[i];
    const auto place = splines_->Locate(pose.t);
    if (!place) continue;
    if (place->first != first) add_blocks();
    first = place->first;
    const PoseTrajectory::Pose gp = trajectory_.PoseAt(pose.t);
    const Eigen::Matrix<double, 1, kSplineOrder> spline =
        CubicWeights(place->u, place->spacing).row(0);
    const double t_imu = pose.t - estimate_->time_shift;
    const double position_sigma = noise_.position / std::sqrt(weights.position[i]);
    const double rotation_sigma = noise_.rotation / std::sqrt(weights.rotation[i]);
    positions.push_back({pose.p_WM - gp.p_WM, spline, position_sigma});
    rotations.push_back({gp.q_WM.conjugate() * pose.q_WM, spline, rotation_sigma});
    position_samples.push_back({i, t_imu, position_sigma});
    rotation_samples.push_back({i, t_imu, rotation_sigma});
  }
  add_blocks();
}

std::optional<JointImuSample> JointProblem::Locate(const TimedSample& sample,
                                                   double t_M,
                                                   double sigma,
                                                   double bias_u) const {
  const auto place = splines_->Locate(t_M);
  JointImuSample s;
  if (!place || !IsOnTrajectory(t_M) || !trajectory_.Evaluate(t_M, &s.gp, &s.gp_rate))
    return std::nullopt;
  s.t_M = t_M;
  s.t = sample.t;
  s.t_drift = sample.t - estimate_->clock_reference;
  s.value = sample.value;
  s.bias_u = bias_u;
  s.sigma = sigma;
  s.place = *place;
  return s;
}

void JointProblem::AddGyro(const SampleWeights& weights) {
  BiasKnots& knots = estimate_->gyro_bias;
  std::vector<JointImuSample> batch;
  std::vector<Sample> batch_samples;
  size_t knot = 0;
  const auto add_block = [&] {
    if (batch.empty()) return;
    std::vector<double*> blocks = ControlPoints(&splines_->phi, batch.front().place.first);
    blocks.insert(blocks.end(),
                  {estimate_->q_MI.coeffs().data(),
                   estimate_->gyro_intrinsics.data(),
                   knots.values[knot].data(),
                   knots.values[knot + 1].data(),
                   &estimate_->time_shift,
                   &estimate_->clock_drift});
    gyro_.Add(problem_.AddResidualBlock(CreateJointGyroResidual(std::move(batch)), nullptr, blocks),
              batch_samples);
    batch.clear();
    batch_samples.clear();
  };
  for (size_t i = 0; i < data_.gyro.size(); ++i) {
    const TimedSample& s = data_.gyro[i];
    const double sigma = noise_.gyro / std::sqrt(weights.gyro[i]);
    const auto [k, u] = knots.Locate(s.t);
    const auto sample = Locate(s, estimate_->PoseTime(s.t), sigma, u);
    if (!sample) continue;
    if (!batch.empty() && (batch.front().place.first != sample->place.first || knot != k))
      add_block();
    knot = k;
    batch.push_back(*sample);
    batch_samples.push_back({i, s.t, sigma});
  }
  add_block();
}

void JointProblem::AddAccel(const SampleWeights& weights) {
  BiasKnots& knots = estimate_->accel_bias;
  std::vector<JointImuSample> batch;
  std::vector<Sample> batch_samples;
  size_t knot = 0;
  const auto add_block = [&] {
    if (batch.empty()) return;
    std::vector<double*> blocks = ControlPoints(&splines_->d, batch.front().place.first);
    const auto phi = ControlPoints(&splines_->phi, batch.front().place.first);
    blocks.insert(blocks.end(), phi.begin(), phi.end());
    blocks.insert(blocks.end(),
                  {estimate_->q_MI.coeffs().data(),
                   estimate_->p_MI.data(),
                   estimate_->g_W.data(),
                   estimate_->accel_intrinsics.data(),
                   knots.values[knot].data(),
                   knots.values[knot + 1].data(),
                   &estimate_->time_shift,
                   &estimate_->clock_drift,
                   &estimate_->accel_delay});
    accel_.Add(
        problem_.AddResidualBlock(CreateJointAccelResidual(std::move(batch)), nullptr, blocks),
        batch_samples);
    batch.clear();
    batch_samples.clear();
  };
  for (size_t i = 0; i < data_.accel.size(); ++i) {
    const TimedSample& s = data_.accel[i];
    const double sigma = noise_.accel / std::sqrt(weights.accel[i]);
    const auto [k, u] = knots.Locate(s.t);
    const auto sample = Locate(s, estimate_->PoseTime(s.t) - estimate_->accel_delay, sigma, u);
    if (!sample) continue;
    if (!batch.empty() && (batch.front().place.first != sample->place.first || knot != k))
      add_block();
    knot = k;
    batch.push_back(*sample);
    batch_samples.push_back({i, s.t, sigma});
  }
  add_block();
}

void JointProblem::UpdateWeights(const NoiseStd& noise, SampleWeights* weights) const {
  const auto update = [this](const Sensor& sensor, double sigma, std::vector<double>* weight) {
    for (size_t i = 0; i < sensor.samples.size(); ++i)
      (*weight)[sensor.samples[i].index] =
          1.0 /
          (1.0 + std::pow(sensor.residual_norms[i] / (sigma * options_.robust_loss_scale), 2));
  };
  update(position_, noise.position, &weights->position);
  update(rotation_, noise.rotation, &weights->rotation);
  update(gyro_, noise.gyro, &weights->gyro);
  update(accel_, noise.accel, &weights->accel);
}

double JointProblem::LeverArmErrors(double t_M) const {
  const auto place = splines_->Locate(t_M);
  MarkerState<double> state;
  if (!place || !trajectory_.Evaluate(t_M, &state)) return 0.0;
  // What the gyroscope leaves of white noise in the splines' band B = 1 / (2 spacing): the share
  // 2 B / rate in omega, and (2 pi B)^2 / 3 times that in alpha. Poses and gyroscope add up.
  const double gyro_omega =
      noise_.gyro * noise_.gyro / std::max(1.0, place->spacing * data_.gyro_report.rate_hz);
  const double gyro_alpha = std::pow(M_PI / place->spacing, 2) / 3.0 * gyro_omega;
  const MarkerVariance gp = trajectory_.Variance(t_M);
  const double omega = 1.0 / (1.0 / gyro_omega + 1.0 / gp.omega);
  const double alpha = 1.0 / (1.0 / gyro_alpha + 1.0 / gp.alpha);
  return LeverArmCoefficientVariance(alpha, omega, state.omega_M.squaredNorm());
}

double JointProblem::FeignedLeverArmInformation() const {
  double information = 0.0;
  for (const Sample& s : accel_.samples)
    information +=
        LeverArmErrors(estimate_->PoseTime(s.t) - estimate_->accel_delay) / (s.sigma * s.sigma);
  return information;
}

std::vector<double*> JointProblem::ControlPoints(std::vector<Eigen::Vector3d>* spline,
                                                 size_t first) const {
  std::vector<double*> blocks;
  for (size_t j = first; j < first + kSplineOrder; ++j) blocks.push_back((*spline)[j].data());
  return blocks;
}

}  // namespace imu_pose_calib
