#include "imu_pose_calib/core/trajectory/pose_trajectory.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/parallel.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/data/conditioned_data.h"

namespace imu_pose_calib {
namespace {

constexpr double kMedianOfChi3 = 1.5382;  // median norm of a standard normal 3-vector
constexpr int kLikelihoodChunks = 16;
constexpr size_t kChunkPoses = 250;
constexpr int kRounds = 3;               // until none is left, few poses are left of some streams
constexpr double kSpikeThreshold = 2.0;  // times the outlier threshold
constexpr double kSpikeRadius = 10.5;    // poses on either side

/// Positions less `origin_W` [m] or, when that is null, quaternions.
GpData Measurements(const std::vector<TimedPose>& poses, IndexRange range,
                    const Eigen::Vector3d* origin_W) {
  const auto n = static_cast<Eigen::Index>(range.size());
  GpData data{Eigen::VectorXd(n), Eigen::MatrixXd(n, origin_W != nullptr ? 3 : 4)};
  for (Eigen::Index i = 0; i < n; ++i) {
    const TimedPose& pose = poses[range.begin + static_cast<size_t>(i)];
    data.t[i] = pose.t;
    if (origin_W != nullptr)
      data.y.row(i) = pose.p_WM - *origin_W;
    else
      data.y.row(i) = pose.q_WM.coeffs();
  }
  return data;
}

Eigen::Vector3d MeanPosition(const std::vector<TimedPose>& poses) {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  for (const TimedPose& pose : poses) sum += pose.p_WM;
  return sum / static_cast<double>(poses.size());
}

/// Measurements() of up to kLikelihoodChunks pieces of up to kChunkPoses poses, spread over the
/// log.
std::vector<GpData> Chunks(const ConditionedData& data, const Eigen::Vector3d* origin_W) {
  std::vector<IndexRange> chunks;
  for (const IndexRange& s : data.segments) {
    const size_t count = (s.size() + kChunkPoses - 1) / kChunkPoses;
    for (size_t k = 0; k < count; ++k)
      chunks.push_back({s.begin + k * s.size() / count, s.begin + (k + 1) * s.size() / count});
  }
  std::vector<GpData> spread;
  const size_t wanted = std::min<size_t>(chunks.size(), kLikelihoodChunks);
  for (size_t k = 0; k < wanted; ++k)
    spread.push_back(Measurements(data.poses, chunks[k * chunks.size() / wanted], origin_W));
  return spread;
}

GpHyperparameters FitPosition(const CalibrationOptions& o, const ConditionedData& data) {
  const Eigen::Vector3d origin_W = MeanPosition(data.poses);
  return FitHyperparameters(Chunks(data, &origin_W),
                            {o.position_lengthscale_s, o.position_signal_std, o.position_noise_std},
                            o.Threads());
}

/// In [rad]. Rotation noise moves a unit quaternion by half the angle and in three of its four
/// dimensions only, so the noise per component that the likelihood sees is sigma/2 sqrt(3/4).
GpHyperparameters FitRotation(const CalibrationOptions& o, const ConditionedData& data) {
  const double noise_ratio = 0.5 * std::sqrt(0.75);
  const GpHyperparameters h = FitHyperparameters(
      Chunks(data, nullptr),
      {o.rotation_lengthscale_s, 0.5 * o.rotation_signal_std, noise_ratio * o.rotation_noise_std},
      o.Threads());
  return {h.lengthscale_s, 2.0 * h.signal_std, h.noise_std / noise_ratio};
}

/// Norm of the leave-one-out residual in sigma, per pose: (position, rotation).
std::vector<Eigen::Vector2d> LeaveOneOut(const PoseTrajectory& trajectory,
                                         const std::vector<TimedPose>& poses, int threads) {
  // r_loo = r / (1 - h) with variance noise^2 / (1 - h), h = posterior variance / noise^2: of which
  // rounding leaves nothing where the noise is the least that is found.
  const auto normalise = [](double residual, double variance, const GpHyperparameters& h) {
    const double noise2 = std::pow(h.noise_std, 2);
    const double least2 = std::pow(h.signal_std / kMaxSignalToNoise, 2);
    return residual / std::sqrt(std::max({noise2 - variance, least2, 1e-3 * noise2}));
  };
  std::vector<Eigen::Vector2d> normalised(poses.size());
  InPortions(threads, poses.size(), [&](size_t i) {
    const TimedPose& pose = poses[i];
    const MarkerVariance variance = trajectory.Variance(pose.t);
    const Rigid3 smooth = trajectory.PoseAt(pose.t);
    const double position = (pose.p_WM - smooth.p).norm();
    const double rotation = Log(Eigen::Quaterniond(smooth.q.conjugate() * pose.q_WM)).norm();
    normalised[i] << normalise(position, variance.position, trajectory.position_hyperparameters()),
        normalise(rotation, variance.rotation, trajectory.rotation_hyperparameters());
  });
  return normalised;
}

/// Believes in noise that differs between poses only as far as the residuals bear it out: on
/// logarithmic scales they must grow with it, at least at half the rate.
void CheckNoiseScales(const std::vector<Eigen::Vector2d>& residuals,
                      std::vector<TimedPose>* poses) {
  const auto check = [&](int kind, double TimedPose::*scale) {
    const auto count = static_cast<double>(poses->size());
    double mean = 0.0, covariance = 0.0, variance = 0.0;
    for (const TimedPose& pose : *poses) mean += std::log(pose.*scale) / count;
    for (size_t i = 0; i < poses->size(); ++i) {
      const double x = std::log((*poses)[i].*scale) - mean;
      covariance += x * std::log(std::max(residuals[i][kind], 1e-9));
      variance += x * x;
    }
    if (covariance > 0.5 * variance) return;
    for (TimedPose& pose : *poses) pose.*scale = 1.0;
  };
  check(0, &TimedPose::position_scale);
  check(1, &TimedPose::rotation_scale);
}

/// Poses whose residual exceeds `threshold` robust sigma, of the log and of the poses within
/// `radius_s`: where the motion is livelier than the GP, all residuals are large and none is an
/// outlier.
std::vector<bool> FindOutliers(const std::vector<Eigen::Vector2d>& residuals,
                               const std::vector<TimedPose>& poses, double threshold,
                               double radius_s) {
  const auto bound = [&](size_t begin, size_t end) -> Eigen::Array2d {
    const Eigen::Array2d median = MedianOfEach(begin, end, [&](size_t i) { return residuals[i]; });
    return threshold * (median / kMedianOfChi3).max(1e-9);
  };
  const Eigen::Array2d usual = bound(0, poses.size());
  std::vector<bool> outliers(poses.size());
  size_t begin = 0, end = 0;  // of the poses around
  for (size_t i = 0; i < poses.size(); ++i) {
    while (poses[i].t - poses[begin].t >= radius_s) ++begin;
    while (end < poses.size() && poses[end].t - poses[i].t < radius_s) ++end;
    const auto is_beyond = residuals[i].array() > usual;
    outliers[i] = is_beyond.any() && (is_beyond && residuals[i].array() > bound(begin, end)).any();
  }
  return outliers;
}

/// Distance of each pose from the middle of its neighbours: (position [m], rotation [rad]).
std::vector<Eigen::Vector2d> DistanceFromNeighbours(const std::vector<TimedPose>& poses,
                                                    const std::vector<IndexRange>& segments) {
  std::vector<Eigen::Vector2d> distances(poses.size(), Eigen::Vector2d::Zero());
  for (const IndexRange& segment : segments) {
    for (size_t i = segment.begin + 1; i + 1 < segment.end; ++i) {
      const double u = (poses[i].t - poses[i - 1].t) / (poses[i + 1].t - poses[i - 1].t);
      const Rigid3 middle = Interpolate({poses[i - 1].q_WM, poses[i - 1].p_WM},
                                        {poses[i + 1].q_WM, poses[i + 1].p_WM}, u);
      distances[i] << (poses[i].p_WM - middle.p).norm(), poses[i].q_WM.angularDistance(middle.q);
    }
  }
  return distances;
}

/// Removes single poses far off their neighbours before a likelihood sees them: they would make it
/// believe in noise, or in motion at the rate of the samples, and cost it a long search.
void RemoveSpikes(double threshold, ConditionedData* data) {
  for (int round = 0; round < kRounds; ++round) {
    const std::vector<Eigen::Vector2d> distances =
        DistanceFromNeighbours(data->poses, data->segments);
    std::vector<bool> spikes = FindOutliers(distances, data->poses, kSpikeThreshold * threshold,
                                            kSpikeRadius / data->pose_report.rate_hz);
    // On either side of a jump the distances are alike; next to a spike they are half of its own.
    for (size_t i = 1; i + 1 < spikes.size(); ++i) {
      const Eigen::Vector2d next = distances[i - 1].cwiseMax(distances[i + 1]);
      spikes[i] = spikes[i] && (distances[i].array() >= 1.5 * next.array()).any();
    }
    if (std::find(spikes.begin(), spikes.end(), true) == spikes.end()) return;
    data->pose_report.outlier += RemovePoses(spikes, data);
  }
}

/// How the quaternion before projection turns, given with its derivatives in columns, and, unless
/// null, the time derivative of that (of q_WM: of its coefficients).
void FindRotation(const GaussianProcess::Derivatives& q, MarkerRotation<double>* rotation,
                  MarkerRotation<double>* rate) {
  const auto quaternion = [&q](int derivative) {
    return Eigen::Quaterniond(Eigen::Vector4d(q.col(derivative)));
  };
  // With A = q^-1 q', B = q^-1 q'', C = q^-1 q''': omega = 2 Im A, A' = B - A^2, B' = C - A B,
  // whatever the norm of q does.
  const Eigen::Quaterniond q_inv = quaternion(0).inverse();
  const Eigen::Quaterniond A = q_inv * quaternion(1);
  const Eigen::Quaterniond B = q_inv * quaternion(2);
  rotation->q_WM = quaternion(0).normalized();
  rotation->omega_M = 2.0 * A.vec();
  rotation->alpha_M = 2.0 * (B.vec() - (A * A).vec());
  if (rate == nullptr) return;
  const Eigen::Quaterniond C = q_inv * quaternion(3);
  const Eigen::Quaterniond half_omega(0.0, A.x(), A.y(), A.z());
  rate->q_WM = rotation->q_WM * half_omega;
  rate->omega_M = rotation->alpha_M;
  rate->alpha_M = 2.0 * (C.vec() - 2.0 * (A * B).vec() - (B * A).vec() + 2.0 * (A * A * A).vec());
}

}  // namespace

PoseTrajectory::PoseTrajectory(const std::vector<TimedPose>& poses,
                               const std::vector<IndexRange>& segments,
                               const GpHyperparameters& position, const GpHyperparameters& rotation,
                               int threads, bool with_variance)
    : position_(position), rotation_(rotation), origin_W_(MeanPosition(poses)) {
  const GpHyperparameters quaternion{rotation.lengthscale_s, 0.5 * rotation.signal_std,
                                     0.5 * rotation.noise_std};
  segments_.resize(segments.size());
  InParallel(threads, 2 * segments.size(), [&](size_t k) {
    const IndexRange range = segments[k / 2];
    const bool is_position = k % 2 == 0;
    GaussianProcess* const gp =
        is_position ? &segments_[k / 2].position : &segments_[k / 2].quaternion;
    *gp = GaussianProcess(Measurements(poses, range, is_position ? &origin_W_ : nullptr),
                          is_position ? position_ : quaternion, with_variance);
  });
  for (size_t k = 0; k < segments.size(); ++k) {
    Segment& segment = segments_[k];
    segment.begin = poses[segments[k].begin].t;
    segment.end = poses[segments[k].end - 1].t;
    if (k == 0 || segments_[k - 1].end < segment.begin) continue;
    segments_[k - 1].end = segment.begin = 0.5 * (segments_[k - 1].end + segment.begin);
  }
}

const PoseTrajectory::Segment* PoseTrajectory::Find(double t) const {
  const auto after =
      std::upper_bound(segments_.begin(), segments_.end(), t,
                       [](double value, const Segment& segment) { return value < segment.begin; });
  if (after == segments_.begin()) return nullptr;
  const Segment& segment = *std::prev(after);
  return t <= segment.end ? &segment : nullptr;
}

bool PoseTrajectory::Covers(double begin, double end) const {
  const Segment* segment = Find(begin);
  return segment != nullptr && end <= segment->end;
}

bool PoseTrajectory::Evaluate(double t, MarkerState<double>* state,
                              MarkerState<double>* rate) const {
  const Segment* segment = Find(t);
  if (segment == nullptr) return false;
  const GaussianProcess::Derivatives p = segment->position.Evaluate(t);
  FindRotation(segment->quaternion.Evaluate(t), state, rate);
  state->p_WM = origin_W_ + p.col(0).head<3>();
  state->v_W = p.col(1).head<3>();
  state->a_W = p.col(2).head<3>();
  if (rate == nullptr) return true;
  rate->p_WM = state->v_W;
  rate->v_W = state->a_W;
  rate->a_W = p.col(3).head<3>();
  return true;
}

bool PoseTrajectory::EvaluateRotation(double t, MarkerRotation<double>* rotation) const {
  const Segment* segment = Find(t);
  if (segment == nullptr) return false;
  FindRotation(segment->quaternion.Evaluate(t), rotation, nullptr);
  return true;
}

MarkerVariance PoseTrajectory::Variance(double t) const {
  const Segment* segment = Find(t);
  const Eigen::Vector3d p = segment->position.Variance(t);
  const Eigen::Vector3d q = 4.0 * segment->quaternion.Variance(t);  // an angle is twice its half
  return {p[0], q[0], q[1], q[2], p[2]};
}

Eigen::Vector3d PoseTrajectory::PositionAt(double t) const {
  return origin_W_ + Find(t)->position.Value(t).head<3>();
}

Eigen::Quaterniond PoseTrajectory::RotationAt(double t) const {
  return Eigen::Quaterniond(Find(t)->quaternion.Value(t)).normalized();
}

PoseTrajectory FitTrajectory(const CalibrationOptions& options, ConditionedData* data) {
  RemoveSpikes(options.outlier_threshold, data);
  SplitAtJumps(options, data);
  const int threads = options.Threads();
  for (int round = 1;; ++round) {
    const GpHyperparameters position = FitPosition(options, *data);
    const GpHyperparameters rotation = FitRotation(options, *data);
    PoseTrajectory trajectory(data->poses, data->segments, position, rotation, threads);
    const std::vector<Eigen::Vector2d> residuals = LeaveOneOut(trajectory, data->poses, threads);
    const std::vector<bool> outliers =
        FindOutliers(residuals, data->poses, options.outlier_threshold,
                     std::min(position.lengthscale_s, rotation.lengthscale_s));
    const bool has_none = std::find(outliers.begin(), outliers.end(), true) == outliers.end();
    if (has_none || round == kRounds) {
      CheckNoiseScales(residuals, &data->poses);
      return trajectory;
    }
    data->pose_report.outlier += RemovePoses(outliers, data);
  }
}

}  // namespace imu_pose_calib
