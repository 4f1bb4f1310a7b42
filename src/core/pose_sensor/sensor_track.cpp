#include "imu_pose_calib/core/pose_sensor/sensor_track.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/so3.h"

namespace imu_pose_calib {
namespace {

using Eigen::Quaterniond;
using Eigen::Vector3d;

constexpr double kApart = 1.0;  // [s] of relative poses

double Seconds(int64_t ns) { return 1e-9 * static_cast<double>(ns); }

/// A pose of the sensor, aligned, and the true one.
struct PosePair {
  double t;  ///< [s] pose clock
  Rigid3 measured, truth;
};

PoseStd Rms(const std::vector<Rigid3>& errors) {
  PoseStd squares;
  for (const Rigid3& error : errors) {
    squares.position += error.p.squaredNorm();
    squares.rotation += Log(error.q).squaredNorm();
  }
  const double n = std::max(1.0, static_cast<double>(errors.size()));
  return {std::sqrt(squares.position / n), std::sqrt(squares.rotation / n)};
}

}  // namespace

std::vector<ImuTrack::Instant> SensorTrack::Instants(double rate_hz) const {
  const int64_t epoch_ns = trajectory_.epoch_ns();
  const bool is_own_clock = clock_ == TrackClock::kImu;
  std::vector<ImuTrack::Instant> instants;
  for (const PoseSensorSession::Residual& pose : Own().residuals) {
    const double t = pose.t - Seconds(epoch_ns);
    instants.push_back({is_own_clock ? pose.stamp_ns : epoch_ns + std::llround(1e9 * t), t});
  }
  return EvenInstants(instants, rate_hz);
}

std::optional<ImuState> SensorTrack::At(double t) const {
  SessionTrajectory::StateJacobian J;
  const auto sensor = trajectory_.Body(sensor_.T_MS, t, has_covariance() ? &J : nullptr);
  if (!sensor) return std::nullopt;
  ImuState state(*sensor, t);
  if (!has_covariance()) return state;
  // By p_MS and the rotation of R_MS about the sensor's axes.
  Eigen::Matrix<double, 12, 6> by_mount = J.topRightCorner<12, 6>();
  by_mount.rightCols<3>() *= 0.5 * sensor_.T_MS.q.toRotationMatrix();
  state.covariance = trajectory_.MarkerCovariance(t, sensor_.T_MS)->topLeftCorner<12, 12>() +
                     Propagate(by_mount, sensor_.covariance);
  if (clock_ != TrackClock::kImu) return state;
  Eigen::Matrix<double, 12, 1> rate;
  rate << sensor->omega_B, sensor->v_W, sensor->alpha_B, sensor->a_W;
  const double since =
      Seconds(trajectory_.epoch_ns()) + t - Own().time_shift - Own().clock_reference;
  const double clock_std = std::hypot(Own().time_shift_std, since * Own().clock_drift_std);
  state.covariance += clock_std * clock_std * rate * rate.transpose();
  return state;
}

SensorErrors FindErrors(const PoseSensorSession& session,
                        const std::function<std::optional<Rigid3>(double t)>& T_WS) {
  std::vector<PosePair> pairs;
  std::vector<Rigid3> absolute, relative;
  for (size_t i = 0; i < session.residuals.size(); ++i) {
    const PoseSensorSession::Residual& residual = session.residuals[i];
    const auto truth = T_WS(residual.t);
    if (!truth) continue;
    const Rigid3 &T_VW = session.world[i].T_VW, &first = session.world.front().T_VW;
    const Vector3d p_VS = T_VW.p + session.scale * (T_VW.q * truth->p) + residual.position;
    const Quaterniond q_VS = T_VW.q * truth->q * Exp<double>(residual.rotation);
    const Rigid3 measured{first.q.conjugate() * q_VS,
                          first.q.conjugate() * (p_VS - first.p) / session.scale};
    pairs.push_back({residual.t, measured, *truth});
    absolute.push_back(truth->Inverse() * measured);
  }
  const double half_period = 0.5 / session.poses.rate_hz;
  auto last = pairs.begin();
  for (auto first = last; first != pairs.end(); ++first) {
    while (last != pairs.end() && last->t < first->t + kApart - half_period) ++last;
    if (last == pairs.end()) break;
    if (last->t > first->t + kApart + half_period) continue;
    relative.push_back((first->truth.Inverse() * last->truth).Inverse() *
                       (first->measured.Inverse() * last->measured));
  }
  return {Rms(absolute), Rms(relative), absolute.size(), relative.size()};
}

SensorErrors FindErrors(const std::shared_ptr<const Solution>& solution, size_t session,
                        const PoseSensorCalibration& sensor) {
  const SessionTrajectory trajectory(solution, session);
  const auto T_WS = [&](double t) -> std::optional<Rigid3> {
    const auto body = trajectory.Body(sensor.T_MS, t - Seconds(trajectory.epoch_ns()));
    if (!body) return std::nullopt;
    return Rigid3{body->q_WB, body->p_WB};
  };
  return FindErrors(sensor.sessions[session], T_WS);
}

}  // namespace imu_pose_calib
