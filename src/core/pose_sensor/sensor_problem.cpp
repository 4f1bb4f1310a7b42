#include "imu_pose_calib/core/pose_sensor/sensor_problem.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/base/student_t.h"
#include "imu_pose_calib/core/calibration/marginals.h"

namespace imu_pose_calib {
namespace {

using Eigen::Matrix3d;
using Eigen::Quaterniond;
using Eigen::Vector3d;

/// Of positions whose scale is not estimated as free [1]: boards and rooms are measured so well.
constexpr double kMetricScale = 2e-3;
constexpr double kHeldDrift = 1e-12;   // [s/s] sigma of a clock's drift that is not estimated
constexpr double kLeastDrift = 3e-4;   // [1/sqrt(s)] over noise
constexpr double kLongestStep = 20.0;  // of the squared drift in a round, up or down
/// Noise and drift have settled when what they are together, from one pose to the next and over the
/// session, changes by a smaller share.
constexpr double kSettled = 0.02;
constexpr double kConverged = 1e-3;  // [sigma] of the last step
constexpr int kCalibrated = 9;       // p_MS, turn of R_MS, time shift, drift of the clock, scale

using Gradient = Eigen::Matrix<double, kCalibrated, 1>;
using Information = Eigen::Matrix<double, kCalibrated, kCalibrated>;
using ByCalibrated = Eigen::Matrix<double, 6, kCalibrated>;

/// From one world to another where the sensor is the same [m, rad].
Vector6d Difference(const Rigid3& from, const Rigid3& to) {
  Vector6d difference;
  difference << to.p - from.p, Log(Quaterniond(to.q * from.q.conjugate()));
  return difference;
}

Rigid3 Moved(const Rigid3& world, const Vector6d& difference) {
  return {(Exp<double>(difference.tail<3>()) * world.q).normalized(),
          world.p + difference.head<3>()};
}

/// Derivative of FindResidual() by what is calibrated, where V is T_VW.
ByCalibrated Jacobian(const Rigid3& T_MS, const SensorSession& session, const SensorPose& sample,
                      const Quaterniond& q_VW) {
  const BodyState& S = sample.sensor;
  const Matrix3d R_VS = (q_VW * S.q_WB).toRotationMatrix();
  ByCalibrated J = ByCalibrated::Zero();
  J.block<3, 3>(0, 0) = -session.scale * R_VS * T_MS.q.toRotationMatrix().transpose();
  J.block<3, 3>(3, 3) = -R_VS;
  J.col(6) << -session.scale * (q_VW * S.v_W), -R_VS * S.omega_B;
  J.col(7) = (sample.measured.t - session.clock.clock_reference) * J.col(6);
  J.col(8).head<3>() = -(q_VW * S.p_WB);
  return J;
}

/// Of three axes each.
Vector6d PerAxis(const Eigen::Array2d& position_rotation) {
  Vector6d axes;
  axes << Vector3d::Constant(position_rotation[0]), Vector3d::Constant(position_rotation[1]);
  return axes;
}

Vector6d NoiseVariance(const SensorSession& session, const SensorPose& sample) {
  const Eigen::Array2d scale(sample.measured.position_scale, sample.measured.rotation_scale);
  return PerAxis((session.noise * scale).square() / sample.weight);
}

/// V at the next pose by what is known of it at the last one, an error of which F carries on.
struct Prediction {
  Rigid3 world;
  Matrix6d F = Matrix6d::Identity(), covariance;
  Vector6d step;  ///< variances of the walk in between

  Prediction(const SensorSession& session, const SensorPose& last, const SensorPose& sample)
      : world(Carried(session, last, sample, last.world)),
        step((sample.measured.t - last.measured.t) * PerAxis(session.drift.square())) {
    F.topRightCorner<3, 3>() = -Hat<double>(world.p - last.world.p);
    covariance = F * last.covariance * F.transpose() + Matrix6d(step.asDiagonal());
  }
};

/// What innovations and priors tell of what is calibrated: H, and scores in columns, of time blocks
/// and, last, of priors, whose sum is the gradient of the cost.
struct Equations {
  Eigen::MatrixXd H, scores;
};

/// Kalman filter of V along a session, with the derivatives of its state by what is calibrated: the
/// innovations are white, and their least squares are those of poses and walk.
Equations Filter(const Rigid3& T_MS, double block_s, SensorSession* session) {
  Information H = Information::Zero();
  Eigen::Matrix<double, kCalibrated, kWindows + 2> scores;
  scores.setZero();
  const double begin = session->samples.front().measured.t;
  ByCalibrated by_calibrated;
  for (SensorPose& sample : session->samples) {
    const Matrix6d noise = NoiseVariance(*session, sample).asDiagonal();
    if (sample.begins_piece) {
      sample.world = ImpliedWorld(sample);
      sample.covariance = noise;
      by_calibrated = Jacobian(T_MS, *session, sample, sample.world.q);
      continue;
    }
    const Prediction predicted(*session, *(&sample - 1), sample);
    by_calibrated = (predicted.F * by_calibrated).eval();
    const ByCalibrated J = Jacobian(T_MS, *session, sample, predicted.world.q) - by_calibrated;
    const Matrix6d inverse = Inverse(predicted.covariance + noise);
    const Vector6d innovation = FindResidual(sample, predicted.world);
    H += J.transpose().lazyProduct(inverse.lazyProduct(J).eval());
    scores.col(static_cast<int>((sample.measured.t - begin) / block_s)) +=
        J.transpose() * (inverse * innovation);
    const Matrix6d gain = predicted.covariance * inverse;
    sample.world = Moved(predicted.world, gain * innovation);
    sample.covariance = predicted.covariance - gain * predicted.covariance;
    by_calibrated += gain * J;
  }
  return {H, scores};
}

/// Steps of V, positions and rotations: their squares over their variances, summed up; as many as
/// there would be with these variances, of what the poses tell of them; and their number.
struct Walk {
  Vector6d found = Vector6d::Zero(), expected = Vector6d::Zero();
  double count = 0.0;
};

/// V by all poses, where the filter has it by those so far (Rauch-Tung-Striebel).
Walk Smooth(SensorSession* session) {
  Walk walk;
  for (size_t i = session->samples.size(); i-- > 1;) {
    const SensorPose& next = session->samples[i];
    SensorPose& sample = session->samples[i - 1];
    if (next.begins_piece) continue;
    const Prediction predicted(*session, sample, next);
    const Matrix6d inverse = Inverse(predicted.covariance);
    const Matrix6d gain = sample.covariance * predicted.F.transpose() * inverse;
    const Matrix6d told = predicted.covariance - next.covariance;
    const Vector6d moved = Difference(predicted.world, next.world);
    walk.found += predicted.step.cwiseProduct((inverse * moved).cwiseAbs2());
    walk.expected += predicted.step.cwiseProduct((inverse * told * inverse).diagonal());
    walk.count += 1.0;
    sample.covariance -= gain * told * gain.transpose();
    sample.world = Moved(sample.world, gain * moved);
  }
  return walk;
}

/// H of all that is calibrated, in the order of FindSensorCovariance(), and scores. Finds V, too,
/// by the poses so far.
Equations FindEquations(const CalibrationOptions& options, SensorEstimate* estimate) {
  double duration = 0.0;
  for (const SensorSession& session : estimate->sessions) duration += session.report.duration_s;
  const double drift_std = options.estimate_clock_drift ? kDriftPrior : kHeldDrift;
  Gradient known = Gradient::Zero(), off = Gradient::Zero();  // beforehand
  known[7] = 1.0 / (drift_std * drift_std);
  known[8] = options.estimate_sensor_scale ? 0.0 : 1.0 / (kMetricScale * kMetricScale);
  const Eigen::Index size = 6 + 3 * static_cast<Eigen::Index>(estimate->sessions.size());
  Equations all{Eigen::MatrixXd::Zero(size, size), Eigen::MatrixXd(size, 0)};
  Eigen::Index own = 3;
  for (SensorSession& session : estimate->sessions) {
    own += 3;
    if (session.samples.empty()) {
      all.H.diagonal().segment<3>(own).setOnes();
      continue;
    }
    Equations told =
        Filter(estimate->T_MS, std::max(duration / kWindows, kShortestWindow), &session);
    off[7] = session.clock.clock_drift;
    off[8] = session.scale - 1.0;
    told.H.diagonal() += known;
    told.scores.rightCols<1>() = known.cwiseProduct(off);
    Eigen::MatrixXd place = Eigen::MatrixXd::Zero(size, kCalibrated);
    place.topLeftCorner<6, 6>().setIdentity();
    place.block<3, 3>(own, 6).setIdentity();
    all.H += Propagate(place, told.H);
    const Eigen::MatrixXd scores = all.scores;
    all.scores.resize(size, scores.cols() + told.scores.cols());
    all.scores << scores, place * told.scores;
  }
  return all;
}

/// Sets weights and noise of positions, or of rotations, and the drift of V.
void FindNoise(const Walk& walk, int kind, SensorSession* session) {
  double &noise = session->noise[kind], &drift = session->drift[kind];
  const int row = 3 * kind;
  std::vector<Vector3d> residuals;
  for (const SensorPose& sample : session->samples) {
    const double variance = NoiseVariance(*session, sample)[row];
    // V follows the pose by that share: the rest, as if it did not.
    const double followed = std::min(0.99, sample.covariance(row, row) / variance);
    residuals.push_back(FindResidual(sample, sample.world).segment<3>(row) /
                        std::sqrt(sample.weight[kind] * variance * (1.0 - followed)));
  }
  const StudentT spread = FitStudentT(residuals);
  for (size_t i = 0; i < residuals.size(); ++i)
    session->samples[i].weight[kind] = spread.Weight(residuals[i].squaredNorm());
  noise *= spread.scale * std::sqrt((spread.dof + 5.0) / (spread.dof + 3.0));
  // The less the poses tell of a step, the less the ratio moves with the variance that is sought.
  const double expected = walk.expected.segment<3>(row).sum();
  const double ratio = walk.found.segment<3>(row).sum() / expected;
  const double stride = 2.0 - expected / (3.0 * walk.count);
  drift *= std::sqrt(std::clamp(1.0 + stride * (ratio - 1.0), 1.0 / kLongestStep, kLongestStep));
  drift = std::max(drift, kLeastDrift * noise);
}

}  // namespace

Rigid3 ImpliedWorld(const SensorPose& sample) {
  return {(sample.measured.q_WM * sample.sensor.q_WB.conjugate()).normalized(),
          sample.measured.p_WM};
}

Rigid3 Carried(const SensorSession& session, const SensorPose& from, const SensorPose& to,
               const Rigid3& world) {
  return {world.q, world.p + session.scale * (world.q * (to.sensor.p_WB - from.sensor.p_WB))};
}

Vector6d FindResidual(const SensorPose& sample, const Rigid3& world) {
  return Difference(world, ImpliedWorld(sample));
}

void PlaceSamples(const Rigid3& T_MS, SensorSession* session) {
  std::vector<SensorPose> placed;
  bool begins_piece = true;
  for (SensorPose& sample : session->samples) {
    const auto state = session->marker->Body(T_MS, session->clock.PoseTime(sample.measured.t));
    begins_piece = begins_piece || sample.begins_piece;
    if (!state) continue;
    sample.sensor = *state;
    sample.begins_piece = std::exchange(begins_piece, false);
    placed.push_back(sample);
  }
  session->samples = std::move(placed);
}

bool SolveSensor(const CalibrationOptions& options, SensorEstimate* estimate) {
  for (int iteration = 0; iteration < options.max_iterations; ++iteration) {
    const Equations equations = FindEquations(options, estimate);
    const Eigen::VectorXd gradient = equations.scores.rowwise().sum();
    const Eigen::VectorXd step = -Solve(equations.H, gradient);
    if (!step.allFinite()) return false;
    estimate->T_MS.p += step.head<3>();
    estimate->T_MS.q = (estimate->T_MS.q * Exp<double>(Vector3d(step.segment<3>(3)))).normalized();
    Eigen::Index own = 6;
    for (SensorSession& session : estimate->sessions) {
      session.clock.time_shift += step[own];
      session.clock.clock_drift += step[own + 1];
      session.scale += step[own + 2];
      own += 3;
      PlaceSamples(estimate->T_MS, &session);
    }
    if (std::abs(step.dot(gradient)) < kConverged * kConverged) return true;
  }
  return false;
}

bool FindNoise(SensorEstimate* estimate) {
  bool has_settled = true;
  for (SensorSession& session : estimate->sessions) {
    if (session.samples.empty()) continue;
    const auto both = [&](double t) -> Eigen::Array2d {
      return (session.noise.square() + t * session.drift.square()).sqrt();
    };
    const double period = 1.0 / session.report.rate_hz, duration = session.report.duration_s;
    const Eigen::Array2d soon = both(period), late = both(duration);
    const Walk walk = Smooth(&session);
    for (const int kind : {0, 1}) FindNoise(walk, kind, &session);
    const Eigen::Array2d changes[] = {both(period) / soon, both(duration) / late};
    for (const Eigen::Array2d& change : changes)
      has_settled = has_settled && (change.log().abs() <= kSettled).all();
  }
  return has_settled;
}

Eigen::MatrixXd FindSensorCovariance(const CalibrationOptions& options, SensorEstimate* estimate) {
  const Equations equations = FindEquations(options, estimate);
  for (SensorSession& session : estimate->sessions) Smooth(&session);
  const Eigen::Index size = equations.H.rows();
  const Eigen::MatrixXd model = Solve(equations.H, Eigen::MatrixXd::Identity(size, size));
  const Eigen::MatrixXd sandwich =
      Propagate(model, equations.scores * equations.scores.transpose());
  const Eigen::VectorXd enlargement = Enlargement(model, sandwich);
  return enlargement.asDiagonal() * model * enlargement.asDiagonal();
}

}  // namespace imu_pose_calib
