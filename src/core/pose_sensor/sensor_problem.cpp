#include "imu_pose_calib/core/pose_sensor/sensor_problem.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <tuple>
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
constexpr double kHeldDrift = 1e-12;  // [s/s] sigma of a clock's drift that is not estimated
/// Squared drift over squared noise [1/s], its logarithm: what is searched, and how finely.
constexpr double kLeastDrift = -16.0, kMostDrift = 10.0, kDriftStep = 0.25;
/// Noise and drift have settled when what they are together, from one pose to the next and over a
/// second, changes by a smaller share.
constexpr double kSettled = 0.02;
constexpr double kConverged = 1e-3;  // [sigma] of the last step
constexpr double kTimeBlocks = 24.0;
constexpr int kCalibrated = 9;  // p_MS, turn of R_MS, time shift, drift of the clock, scale

constexpr double PoseStd::*kKinds[] = {&PoseStd::position, &PoseStd::rotation};

using Gradient = Eigen::Matrix<double, kCalibrated, 1>;
using Information = Eigen::Matrix<double, kCalibrated, kCalibrated>;
using ByCalibrated = Eigen::Matrix<double, 6, kCalibrated>;

/// (position, rotation), 3 each.
Vector6d Squares(double position, double rotation) {
  Vector6d both;
  both << Vector3d::Constant(position * position), Vector3d::Constant(rotation * rotation);
  return both;
}

/// Where the sensor is in V.
Vector3d SensorInV(const SensorSession& session, const SensorPose& sample, const Rigid3& T_VW) {
  return T_VW.p + session.scale * (T_VW.q * sample.sensor.p_WB);
}

/// By how much the step from one T_VW to another moves the sensor [m], and turns it [rad].
Vector6d WorldStep(const SensorSession& session, const SensorPose& sample, const Rigid3& from,
                   const Rigid3& to) {
  Vector6d step;
  step << SensorInV(session, sample, to) - SensorInV(session, sample, from),
      Log(Quaterniond(to.q * from.q.conjugate()));
  return step;
}

/// Where that step leads to.
Rigid3 Moved(const SensorSession& session, const SensorPose& sample, const Rigid3& T_VW,
             const Vector6d& step) {
  const Vector3d p_VS = SensorInV(session, sample, T_VW);
  const Quaterniond turn = Exp<double>(step.tail<3>());
  return {(turn * T_VW.q).normalized(), p_VS + step.head<3>() + turn * (T_VW.p - p_VS)};
}

/// Derivative of FindResidual() by what is calibrated. By a WorldStep() it is the negative
/// identity.
ByCalibrated Jacobian(const Rigid3& T_MS, const SensorSession& session, const SensorPose& sample,
                      const Rigid3& T_VW) {
  const BodyState& S = sample.sensor;
  const Matrix3d R_VS = (T_VW.q * S.q_WB).toRotationMatrix();
  ByCalibrated J = ByCalibrated::Zero();
  J.block<3, 3>(0, 0) = -session.scale * R_VS * T_MS.q.toRotationMatrix().transpose();
  J.block<3, 3>(3, 3) = -R_VS;
  J.col(6) << -session.scale * (T_VW.q * S.v_W), -R_VS * S.omega_B;
  J.col(7) = (sample.t - session.reference) * J.col(6);
  J.col(8).head<3>() = -(T_VW.q * S.p_WB);
  return J;
}

/// From the WorldStep() that V errs by at a pose to that at the next one, where it also walks.
Matrix6d Predict(const SensorSession& session, const SensorPose& last, const SensorPose& sample,
                 const Rigid3& T_VW, Matrix6d* covariance) {
  Matrix6d F = Matrix6d::Identity();
  F.topRightCorner<3, 3>() =
      -Hat<double>(SensorInV(session, sample, T_VW) - SensorInV(session, last, T_VW));
  *covariance = F * *covariance * F.transpose();
  covariance->diagonal() +=
      (sample.t - last.t) * Squares(session.drift.position, session.drift.rotation);
  return F;
}

Vector6d NoiseVariance(const SensorSession& session, const SensorPose& sample) {
  return Squares(
      session.noise.position * sample.scale.position / std::sqrt(sample.weight.position),
      session.noise.rotation * sample.scale.rotation / std::sqrt(sample.weight.rotation));
}

/// What innovations tell of the calibration of a session: H, and scores of time blocks, whose sum
/// is the gradient of the cost.
struct Told {
  Information H = Information::Zero();
  std::map<int, Gradient> scores;
};

/// Kalman filter of V along a session, with the derivatives of its state by what is calibrated: the
/// innovations are white, and their least squares are those of poses and walk.
Told Filter(const Rigid3& T_MS, double block_s, SensorSession* session) {
  Told told;
  Rigid3 T_VW;
  Matrix6d P;
  ByCalibrated by_calibrated;
  for (SensorPose& sample : session->samples) {
    const Vector6d noise = NoiseVariance(*session, sample);
    if (sample.begins_piece) {
      T_VW = ImpliedWorld(*session, sample);
      P = noise.asDiagonal();
      by_calibrated = Jacobian(T_MS, *session, sample, T_VW);
    } else {
      by_calibrated = Predict(*session, *(&sample - 1), sample, T_VW, &P) * by_calibrated;
      const Vector6d innovation = FindResidual(*session, sample, T_VW);
      const ByCalibrated J = Jacobian(T_MS, *session, sample, T_VW) - by_calibrated;
      const Matrix6d inverse = Inverse(P + Matrix6d(noise.asDiagonal()));
      told.H += J.transpose().lazyProduct(inverse.lazyProduct(J).eval());
      const auto block = static_cast<int>(sample.t / block_s);
      told.scores.try_emplace(block, Gradient::Zero()).first->second +=
          J.transpose() * (inverse * innovation);
      const Matrix6d gain = P * inverse;
      T_VW = Moved(*session, sample, T_VW, gain * innovation);
      by_calibrated += gain * J;
      P -= (gain * P).eval();
    }
    sample.T_VW = T_VW;
    sample.covariance = P;
  }
  return told;
}

/// V by all poses, where the filter has it by those so far (Rauch-Tung-Striebel).
void Smooth(SensorSession* session) {
  for (size_t i = session->samples.size(); i-- > 1;) {
    const SensorPose& next = session->samples[i];
    SensorPose& sample = session->samples[i - 1];
    if (next.begins_piece) continue;
    Matrix6d predicted = sample.covariance;
    const Matrix6d F = Predict(*session, sample, next, sample.T_VW, &predicted);
    const Matrix6d gain = sample.covariance * F.transpose() * Matrix6d(Inverse(predicted));
    sample.covariance += gain * (next.covariance - predicted) * gain.transpose();
    sample.T_VW = Moved(*session, sample, sample.T_VW,
                        gain * WorldStep(*session, next, sample.T_VW, next.T_VW));
  }
}

/// H of all that is calibrated, in the order of SensorCovariance, and scores of time blocks.
struct Equations {
  Eigen::MatrixXd H;
  std::vector<Eigen::VectorXd> scores;
};

/// Finds V, too, by the poses so far.
Equations FindEquations(const CalibrationOptions& options, SensorEstimate* estimate) {
  Eigen::Index size = 6;
  double duration = 0.0;
  for (const SensorSession& session : estimate->sessions) {
    if (session.samples.empty()) continue;
    size += 3;
    duration += session.samples.back().t - session.samples.front().t;
  }
  Equations all{Eigen::MatrixXd::Zero(size, size), {}};
  Eigen::Index column = 6;
  for (SensorSession& session : estimate->sessions) {
    if (session.samples.empty()) continue;
    Told told = Filter(estimate->T_MS, std::max(duration / kTimeBlocks, 2.0), &session);
    const double drift_std = options.estimate_clock_drift ? kDriftPrior : kHeldDrift;
    Gradient known = Gradient::Zero(), off = Gradient::Zero();  // beforehand
    known[7] = 1.0 / (drift_std * drift_std);
    known[8] = options.estimate_sensor_scale ? 0.0 : 1.0 / (kMetricScale * kMetricScale);
    off[7] = session.clock_drift;
    off[8] = session.scale - 1.0;
    told.H.diagonal() += known;
    told.scores[-1] = known.cwiseProduct(off);
    const auto place = [column](int k) { return k < 6 ? k : column + k - 6; };
    for (int i = 0; i < kCalibrated; ++i)
      for (int j = 0; j < kCalibrated; ++j) all.H(place(i), place(j)) += told.H(i, j);
    for (const auto& [block, score] : told.scores) {
      all.scores.push_back(Eigen::VectorXd::Zero(size));
      all.scores.back().head<6>() = score.head<6>();
      all.scores.back().segment<3>(column) = score.tail<3>();
    }
    column += 3;
  }
  return all;
}

/// A value of a series, and its derivatives by what is calibrated: positions and rotations.
using TrackValue = Eigen::Matrix<double, 6, 1 + kCalibrated>;

/// Noise per sample, and density of the walk, of a series that is a walk beside white noise (local
/// level model): the likeliest, by the Kalman filter, with the calibration that makes it likeliest:
/// errors of the calibration move with the body and would pass for a walk. `row`: 0 of positions, 3
/// of rotations.
std::pair<double, double> FitWalk(const std::vector<SensorPose>& samples,
                                  const std::vector<TrackValue>& values, int row,
                                  double PoseStd::*kind) {
  double best = -std::numeric_limits<double>::infinity();
  std::pair<double, double> found;
  for (double x = kLeastDrift; x <= kMostDrift; x += kDriftStep) {
    const double q = std::exp(x);
    Eigen::Matrix<double, 3, 1 + kCalibrated> mean;
    Eigen::Matrix<double, 1 + kCalibrated, 1 + kCalibrated> products;
    products.setZero();
    double P = 0.0, t = 0.0, log_det = 0.0, count = 1.0;
    for (size_t i = 0; i < samples.size(); ++i) {
      const SensorPose& sample = samples[i];
      const double variance = std::pow(sample.scale.*kind, 2) / sample.weight.*kind;
      P += q * (sample.t - t);
      t = sample.t;
      if (sample.begins_piece) {
        mean = values[i].middleRows<3>(row);
        P = variance;
        continue;
      }
      const double F = P + variance;
      const Eigen::Matrix<double, 3, 1 + kCalibrated> innovation =
          values[i].middleRows<3>(row) - mean;
      products += innovation.transpose().lazyProduct(innovation) / F;
      log_det += 3.0 * std::log(F);
      count += 3.0;
      mean += P / F * innovation;
      P *= variance / F;
    }
    Information H = products.bottomRightCorner<kCalibrated, kCalibrated>();
    H.diagonal().array() += 1e-12 * H.trace() + 1e-24;  // of what does not act
    const Gradient g = products.bottomLeftCorner<kCalibrated, 1>();
    const double squares = products(0, 0) - g.dot(Gradient(Solve(H, g)));
    const double variance = std::max(squares / count, 1e-24);
    const double log_likelihood = -0.5 * (log_det + count * std::log(variance));
    if (log_likelihood <= best) continue;
    best = log_likelihood;
    found = {std::sqrt(variance), std::sqrt(variance * q)};
  }
  return found;
}

void FindNoise(const Rigid3& T_MS, SensorSession* session) {
  Vector6d moved = Vector6d::Zero();  // V since the first pose, where the sensor was
  std::vector<TrackValue> values;
  std::vector<Vector3d> residuals[2];
  for (size_t i = 0; i < session->samples.size(); ++i) {
    const SensorPose& sample = session->samples[i];
    const Vector6d residual = FindResidual(*session, sample, sample.T_VW);
    const Vector6d noise = NoiseVariance(*session, sample);
    for (int k : {0, 1}) {
      // V follows the pose by that share: the rest, as if it did not.
      const double followed = sample.covariance(3 * k, 3 * k) / noise[3 * k];
      residuals[k].push_back(residual.segment<3>(3 * k) /
                             (sample.scale.*kKinds[k] * std::sqrt(1.0 - std::min(followed, 0.99))));
    }
    if (!sample.begins_piece)
      moved += WorldStep(*session, sample, session->samples[i - 1].T_VW, sample.T_VW);
    values.emplace_back();
    values.back() << residual + moved, Jacobian(T_MS, *session, sample, sample.T_VW);
  }
  for (int k : {0, 1}) {
    const auto kind = kKinds[k];
    const StudentT spread = FitStudentT(residuals[k]);
    for (size_t i = 0; i < values.size(); ++i)
      session->samples[i].weight.*kind = spread.Weight(residuals[k][i].squaredNorm());
    session->loss.*kind = std::sqrt((spread.dof + 5.0) / (spread.dof + 3.0));
    std::tie(session->noise.*kind, session->drift.*kind) =
        FitWalk(session->samples, values, 3 * k, kind);
    session->noise.*kind *= session->loss.*kind;
  }
}

}  // namespace

Vector6d FindResidual(const SensorSession& session, const SensorPose& sample, const Rigid3& T_VW) {
  Vector6d residual;
  residual << sample.T_VS.p - SensorInV(session, sample, T_VW),
      Log(Quaterniond(sample.T_VS.q * (T_VW.q * sample.sensor.q_WB).conjugate()));
  return residual;
}

Rigid3 ImpliedWorld(const SensorSession& session, const SensorPose& sample) {
  const Quaterniond q = (sample.T_VS.q * sample.sensor.q_WB.conjugate()).normalized();
  return {q, sample.T_VS.p - session.scale * (q * sample.sensor.p_WB)};
}

void PlaceSamples(const Rigid3& T_MS, SensorSession* session) {
  std::vector<SensorPose> placed;
  bool begins_piece = true;
  for (SensorPose& sample : session->samples) {
    const auto state =
        session->marker->Body(T_MS, sample.t + session->time_shift +
                                        session->clock_drift * (sample.t - session->reference));
    begins_piece = begins_piece || sample.begins_piece;
    if (!state) continue;
    sample.sensor = *state;
    sample.begins_piece = std::exchange(begins_piece, false);
    placed.push_back(sample);
  }
  session->samples = std::move(placed);
}

bool SolveSensor(const CalibrationOptions& options, SensorEstimate* estimate) {
  bool has_converged = false;
  for (int iteration = 0; iteration < options.max_iterations && !has_converged; ++iteration) {
    const Equations equations = FindEquations(options, estimate);
    Eigen::VectorXd gradient = Eigen::VectorXd::Zero(equations.H.rows());
    for (const Eigen::VectorXd& score : equations.scores) gradient += score;
    const Eigen::VectorXd step = -Solve(equations.H, gradient);
    if (!step.allFinite()) return false;
    estimate->T_MS.p += step.head<3>();
    estimate->T_MS.q = (estimate->T_MS.q * Exp<double>(Vector3d(step.segment<3>(3)))).normalized();
    Eigen::Index column = 6;
    for (SensorSession& session : estimate->sessions) {
      if (session.samples.empty()) continue;
      session.time_shift += step[column];
      session.clock_drift += step[column + 1];
      session.scale += step[column + 2];
      column += 3;
      PlaceSamples(estimate->T_MS, &session);
    }
    has_converged = std::abs(step.dot(gradient)) < kConverged * kConverged;
  }
  for (SensorSession& session : estimate->sessions) Smooth(&session);
  return has_converged;
}

bool FindNoise(SensorEstimate* estimate) {
  bool has_settled = true;
  for (SensorSession& session : estimate->sessions) {
    if (session.samples.empty()) continue;
    const PoseStd noise = session.noise, drift = session.drift;
    FindNoise(estimate->T_MS, &session);
    for (const auto kind : kKinds)
      for (const double t : {1.0 / session.report.rate_hz, 1.0}) {
        const double before = std::hypot(noise.*kind, drift.*kind * std::sqrt(t));
        const double after = std::hypot(session.noise.*kind, session.drift.*kind * std::sqrt(t));
        has_settled = has_settled && std::abs(std::log(after / before)) <= kSettled;
      }
  }
  return has_settled;
}

SensorCovariance FindSensorCovariance(const CalibrationOptions& options, SensorEstimate* estimate) {
  const Equations equations = FindEquations(options, estimate);
  for (SensorSession& session : estimate->sessions) Smooth(&session);
  const Eigen::Index size = equations.H.rows();
  const Eigen::MatrixXd model = Solve(equations.H, Eigen::MatrixXd::Identity(size, size));
  Eigen::MatrixXd scatter = Eigen::MatrixXd::Zero(size, size);
  for (const Eigen::VectorXd& score : equations.scores) scatter += score * score.transpose();
  const Eigen::VectorXd enlargement = Enlargement(model, Propagate(model, scatter));
  return {model, enlargement.asDiagonal() * model * enlargement.asDiagonal()};
}

}  // namespace imu_pose_calib
