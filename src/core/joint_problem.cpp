#include "imu_pose_calib/core/joint_problem.h"

#include <algorithm>
#include <cmath>

#include "imu_pose_calib/core/allan.h"
#include "imu_pose_calib/core/joint_residuals.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kMinSpans = 4;            // shorter runs say little and are left out
constexpr double kDriftPrior = 1e-2;       // [s/s]
constexpr double kSmoothingPrior = 1e-3;   // [s^2]
constexpr double kLongestAveraging = 1.0;  // [s] beyond it biases and few means blur the noise
constexpr double kIntrinsicsPrior = 0.05;  // [1] sigma of each element of M_g and M_a
/// Knots on either side that act on the trajectory at a sample.
constexpr double kReach = 0.5 * kSplineOrder;

/// Mean squared residual of the samples within `reach` [s] of each, which are in order of time.
template <typename Samples>
std::vector<double> MeanSquareAround(const Samples& samples,
                                     const std::vector<Eigen::Vector3d>& residuals,
                                     double reach) {
  std::vector<double> means;
  size_t begin = 0, end = 0;
  double sum = 0.0;
  for (const auto& sample : samples) {
    for (; end < samples.size() && samples[end].t <= sample.t + reach; ++end)
      sum += residuals[end].squaredNorm();
    for (; samples[begin].t < sample.t - reach; ++begin) sum -= residuals[begin].squaredNorm();
    means.push_back(sum / static_cast<double>(end - begin));
  }
  return means;
}

}  // namespace

CorrectionSplines::CorrectionSplines(const ConditionedData& data,
                                     const Estimate& estimate,
                                     double spacing_s)
    : spacing_(spacing_s) {
  const double imu_begin =
      std::max(data.gyro.front().t + estimate.accel_delay, data.accel.front().t);
  const double imu_end = std::min(data.gyro.back().t + estimate.accel_delay, data.accel.back().t);
  size_t points = 0;
  for (const IndexRange& segment : data.segments) {
    const auto tau = [&](size_t pose) {
      return estimate.ImuTime(data.poses[pose].t) + estimate.accel_delay;
    };
    const double begin = std::max(imu_begin, tau(segment.begin));
    const double end = std::min(imu_end, tau(segment.end - 1));
    if (end - begin < static_cast<double>(kMinSpans) * spacing_s) continue;
    const auto spans = static_cast<size_t>(std::round((end - begin) / spacing_s));
    ranges_.push_back({begin, end, (end - begin) / static_cast<double>(spans), points, spans});
    points += spans + kSplineOrder - 1;
  }
  if (ranges_.empty()) throw DataError("poses and IMU samples have no run without a gap in common");
  d.assign(points, Eigen::Vector3d::Zero());
  phi.assign(points, Eigen::Vector3d::Zero());
}

const CorrectionSplines::Range* CorrectionSplines::Find(double tau) const {
  const auto after =
      std::upper_bound(ranges_.begin(), ranges_.end(), tau, [](double value, const Range& range) {
        return value < range.begin;
      });
  if (after == ranges_.begin()) return nullptr;
  const Range& range = *std::prev(after);
  return tau <= range.end ? &range : nullptr;
}

std::optional<SplinePlace> CorrectionSplines::Locate(double tau) const {
  const Range* range = Find(tau);
  if (range == nullptr) return std::nullopt;
  const double x = (tau - range->begin) / range->spacing;
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
  const bool intrinsics = options_.imu_model == ImuModel::kScaleMisalignment;
  AddOptional(options_.estimate_clock_drift, kDriftPrior, 1, &estimate_->clock_drift);
  AddOptional(options_.estimate_pose_smoothing, kSmoothingPrior, 1, &estimate_->pose_smoothing);
  AddOptional(intrinsics, kIntrinsicsPrior, 6, estimate_->gyro_intrinsics.data());
  AddOptional(intrinsics, kIntrinsicsPrior, 9, estimate_->accel_intrinsics.data());
  AddPoses(weights);
  AddGyro(weights);
  AddAccel(weights);
  AddBiasWalk(options_.gyro_bias_walk, &estimate_->gyro_bias);
  AddBiasWalk(options_.accel_bias_walk, &estimate_->accel_bias);
}

std::optional<TrajectoryPoint> JointProblem::PointAt(double tau, double t_M) const {
  TrajectoryPoint point;
  const auto place = splines_->Locate(tau);
  if (!place || !trajectory_.Evaluate(t_M, &point.gp)) return std::nullopt;
  point.place = *place;
  return point;
}

void JointProblem::AddPoses(const SampleWeights& weights) {
  std::vector<JointPoseSample> positions, rotations;
  std::vector<Sample> position_samples, rotation_samples;
  const auto add_blocks = [&] {
    if (positions.empty()) return;
    const size_t first = positions.front().at.place.first;
    const auto add = [&](std::vector<Eigen::Vector3d>* spline,
                         ceres::CostFunction* residual,
                         std::vector<Sample>* samples,
                         Sensor* sensor) {
      std::vector<double*> blocks = ControlPoints(spline, first);
      blocks.insert(blocks.end(),
                    {&estimate_->time_shift,
                     &estimate_->clock_drift,
                     &estimate_->accel_delay,
                     &estimate_->pose_smoothing});
      sensor->Add(problem_.AddResidualBlock(residual, nullptr, blocks), *samples);
      samples->clear();
    };
    add(&splines_->d, CreateJointPositionResidual(positions), &position_samples, &position_);
    add(&splines_->phi, CreateJointRotationResidual(rotations), &rotation_samples, &rotation_);
    positions.clear();
    rotations.clear();
  };
  for (size_t i = 0; i < data_.poses.size(); ++i) {
    const TimedPose& pose = data_.poses[i];
    const double t = estimate_->ImuTime(pose.t);
    const auto point = PointAt(t + estimate_->accel_delay, pose.t);
    if (!point) continue;
    if (!positions.empty() && positions.front().at.place.first != point->place.first) add_blocks();
    JointPoseSample sample{*point,
                           pose.q_WM,
                           pose.p_WM,
                           estimate_->time_shift,
                           estimate_->clock_drift,
                           estimate_->accel_delay,
                           t - estimate_->clock_reference,
                           noise_.position * pose.position_scale / std::sqrt(weights.position[i])};
    positions.push_back(sample);
    position_samples.push_back({i, t, sample.sigma, 0.0, pose.position_scale});
    sample.sigma = noise_.rotation * pose.rotation_scale / std::sqrt(weights.rotation[i]);
    rotations.push_back(sample);
    rotation_samples.push_back({i, t, sample.sigma, 0.0, pose.rotation_scale});
  }
  add_blocks();
}

template <typename Create>
void JointProblem::AddImu(const std::vector<TimedSample>& samples,
                          const std::vector<double>& weights,
                          double lead,
                          double noise,
                          const BiasKnots& knots,
                          const Create& create,
                          Sensor* sensor) {
  std::vector<JointImuSample> batch;
  std::vector<Sample> batch_samples;
  size_t knot = 0;
  const auto add_block = [&] {
    if (batch.empty()) return;
    const size_t first = batch.front().at.place.first;
    sensor->Add(create(batch, first, knot), batch_samples);
    batch.clear();
    batch_samples.clear();
  };
  for (size_t i = 0; i < samples.size(); ++i) {
    const double tau = samples[i].t + lead;
    const double t_M = estimate_->PoseTime(tau - estimate_->accel_delay);
    const auto point = PointAt(tau, t_M);
    if (!point || !IsOnTrajectory(t_M)) continue;
    const auto [k, u] = knots.Locate(samples[i].t);
    if (!batch.empty() && (batch.front().at.place.first != point->place.first || knot != k))
      add_block();
    knot = k;
    const double sigma = noise / std::sqrt(weights[i]);
    batch.push_back({*point, samples[i].value, u, estimate_->accel_delay, sigma});
    batch_samples.push_back({i, samples[i].t, sigma});
  }
  add_block();
}

void JointProblem::AddGyro(const SampleWeights& weights) {
  BiasKnots& knots = estimate_->gyro_bias;
  const auto create = [&](const std::vector<JointImuSample>& batch, size_t first, size_t knot) {
    std::vector<double*> blocks = ControlPoints(&splines_->phi, first);
    blocks.insert(blocks.end(),
                  {estimate_->q_MI.coeffs().data(),
                   estimate_->gyro_intrinsics.data(),
                   knots.values[knot].data(),
                   knots.values[knot + 1].data(),
                   &estimate_->accel_delay});
    return problem_.AddResidualBlock(CreateJointGyroResidual(batch), nullptr, blocks);
  };
  AddImu(data_.gyro, weights.gyro, estimate_->accel_delay, noise_.gyro, knots, create, &gyro_);
}

void JointProblem::AddAccel(const SampleWeights& weights) {
  BiasKnots& knots = estimate_->accel_bias;
  const auto create = [&](const std::vector<JointImuSample>& batch, size_t first, size_t knot) {
    std::vector<double*> blocks = ControlPoints(&splines_->d, first);
    const std::vector<double*> phi = ControlPoints(&splines_->phi, first);
    blocks.insert(blocks.end(), phi.begin(), phi.end());
    blocks.insert(blocks.end(),
                  {estimate_->q_MI.coeffs().data(),
                   estimate_->p_MI.data(),
                   estimate_->g_W.data(),
                   estimate_->accel_intrinsics.data(),
                   knots.values[knot].data(),
                   knots.values[knot + 1].data()});
    return problem_.AddResidualBlock(CreateJointAccelResidual(batch), nullptr, blocks);
  };
  AddImu(data_.accel, weights.accel, 0.0, noise_.accel, knots, create, &accel_);
}

void JointProblem::HoldCalibration() {
  for (double* parameters : {estimate_->p_MI.data(),
                             estimate_->q_MI.coeffs().data(),
                             &estimate_->time_shift,
                             &estimate_->accel_delay,
                             &estimate_->clock_drift,
                             &estimate_->pose_smoothing,
                             estimate_->gyro_intrinsics.data(),
                             estimate_->accel_intrinsics.data()})
    problem_.SetParameterBlockConstant(parameters);
}

void JointProblem::UpdateWeights(const NoiseStd& noise, SampleWeights* weights) const {
  const auto update = [this](const Sensor& sensor, double sigma, std::vector<double>* weight) {
    const double scale2 = std::pow(sigma * options_.robust_loss_scale, 2);
    for (size_t i = 0; i < sensor.samples.size(); ++i)
      (*weight)[sensor.samples[i].index] = 1.0 / (1.0 + sensor.residuals[i].squaredNorm() / scale2);
  };
  // Where knots do not follow the motion, residuals swing through zero and none of them is right.
  const auto update_imu = [&](const Sensor& sensor, double sigma, std::vector<double>* weight) {
    update(sensor, sigma, weight);
    const std::vector<double> around =
        MeanSquareAround(sensor.samples, sensor.residuals, kReach * splines_->spacing());
    const double scale2 = std::pow(sigma * options_.robust_loss_scale, 2);
    for (size_t i = 0; i < sensor.samples.size(); ++i)
      (*weight)[sensor.samples[i].index] /= 1.0 + std::pow(around[i] / scale2, 2);
  };
  update(position_, noise.position, &weights->position);
  update(rotation_, noise.rotation, &weights->rotation);
  update_imu(gyro_, noise.gyro, &weights->gyro);
  update_imu(accel_, noise.accel, &weights->accel);
}

NoiseStd JointProblem::Densities() const {
  const auto density = [](double std, double rate_hz) { return std * std / rate_hz; };
  return {density(noise_.position, data_.pose_report.rate_hz),
          density(noise_.rotation, data_.pose_report.rate_hz),
          density(noise_.gyro, data_.gyro_report.rate_hz),
          density(noise_.accel, data_.accel_report.rate_hz)};
}

JointProblem::Crossover JointProblem::FindCrossover() const {
  const NoiseStd S = Densities();
  return {std::pow(S.accel / S.position, 0.25) / (2.0 * M_PI),
          std::sqrt(S.gyro / S.rotation) / (2.0 * M_PI)};
}

NoiseStd JointProblem::FittedShare() const {
  // An IMU sensor's share of the information on a spline, in the mean over the spline's band.
  const double band = 0.5 / splines_->spacing();  // [Hz]
  const auto imu_share = [band](double crossover, int order) {
    constexpr int kSteps = 100;
    double sum = 0.0;
    for (int k = 0; k < kSteps; ++k) {
      const double x = std::pow((k + 0.5) / kSteps * band / crossover, order);
      sum += x / (1.0 + x);
    }
    return sum / kSteps;
  };
  const auto points = static_cast<double>(splines_->d.size());
  const auto fitted = [points](double share, const Sensor& sensor) {
    return share * points / std::max(1.0, static_cast<double>(sensor.samples.size()));
  };
  const Crossover crossover = FindCrossover();
  const double accel = imu_share(crossover.accel, 4), gyro = imu_share(crossover.gyro, 2);
  return {fitted(1.0 - accel, position_),
          fitted(1.0 - gyro, rotation_),
          fitted(gyro, gyro_),
          fitted(accel, accel_)};
}

NoiseStd JointProblem::NoiseColor(const NoiseStd& spread) const {
  const Crossover crossover = FindCrossover();
  const auto color = [](const Sensor& sensor, double std, double frequency) {
    std::vector<double> t;
    for (const Sample& sample : sensor.samples) t.push_back(sample.t);
    const double tau = std::min(kLongestAveraging, kAllanBand / frequency);
    return std::max(1.0, AllanNoise(t, sensor.residuals, tau) / std);
  };
  return {color(position_, spread.position, 2.0 * crossover.accel),
          color(rotation_, spread.rotation, 2.0 * crossover.gyro),
          color(gyro_, spread.gyro, 0.5 * crossover.gyro),
          color(accel_, spread.accel, 0.5 * crossover.accel)};
}

double JointProblem::FeignedLeverArmInformation() const {
  double turn2 = 0.0, count = 0.0, spacing = 0.0;
  for (const Sample& s : accel_.samples) {
    const auto point = PointAt(s.t, estimate_->PoseTime(s.t - estimate_->accel_delay));
    if (!point) continue;
    turn2 += point->gp.omega_M.squaredNorm();
    spacing = point->place.spacing;
    count += 1.0;
  }
  const NoiseStd S = Densities();
  constexpr int kSteps = 200;
  const double band = 0.5 / spacing, step = band / kSteps;  // [Hz]
  double density = 0.0;                                     // information per second
  for (int k = 0; k < kSteps; ++k) {
    const double w2 = std::pow(2.0 * M_PI * (k + 0.5) * step, 2);
    const double omega =
        1.0 / (1.0 / S.gyro + 1.0 / (w2 * S.rotation));  // poses and gyroscope add up
    const double lever = LeverArmCoefficientVariance(w2 * omega, omega, turn2 / count);
    density += 2.0 * step * lever / (S.accel + w2 * w2 * S.position);
  }
  return count / data_.accel_report.rate_hz * density;
}

std::vector<double*> JointProblem::ControlPoints(std::vector<Eigen::Vector3d>* spline,
                                                 size_t first) const {
  std::vector<double*> blocks;
  for (size_t j = first; j < first + kSplineOrder; ++j) blocks.push_back((*spline)[j].data());
  return blocks;
}

}  // namespace imu_pose_calib
