#include "imu_pose_calib/core/ground_truth/trajectory.h"

#include <ceres/jet.h>

#include <numeric>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/so3.h"

namespace imu_pose_calib {
namespace {

constexpr int kPoints = 3 * kSplineOrder;  // coordinates of the control points that act at once
/// Of the state: control points of d, of phi, p_MB and R_MB.
constexpr int kInputs = 2 * kPoints + 6;
using Jet = ceres::Jet<double, kInputs>;
template <typename T>
using Vector3 = Eigen::Matrix<T, 3, 1>;

/// Control points that act at one instant: of d, then of phi.
template <typename T>
using ActingPoints = Eigen::Matrix<T, 3, 2 * kSplineOrder>;

/// State of B on M where the splines of the control points correct the GP's motion.
template <typename T>
BodyStateOf<T> CorrectedState(const MarkerState<double>& gp, const SplineWeights& weights,
                              const ActingPoints<T>& points, const Eigen::Quaternion<T>& q_MB,
                              const Vector3<T>& p_MB) {
  const Eigen::Matrix<T, kSplineOrder, 3> W = weights.transpose().cast<T>();
  const MarkerState<T> M = Corrected<T>(gp, points.template leftCols<kSplineOrder>() * W,
                                        points.template rightCols<kSplineOrder>() * W);
  return {
      M.q_WM * q_MB,
      M.p_WM + M.q_WM * p_MB,
      q_MB.conjugate() * M.omega_M,
      M.v_W + M.q_WM * Vector3<T>(M.omega_M.cross(p_MB)),
      q_MB.conjugate() * M.alpha_M,
      M.a_W + M.q_WM * Vector3<T>(M.alpha_M.cross(p_MB) + M.omega_M.cross(M.omega_M.cross(p_MB)))};
}

/// Derivative of the pose clock's time at t [s, IMU clock] by TrajectoryCovariance::Clock().
Eigen::RowVector4d ByClock(const ImuSessionEstimate& clock, double t) {
  Eigen::RowVector4d J(1.0, t - clock.clock_reference, 0.0, 0.0);
  if (clock.walk.IsLine()) return J;
  const double u = clock.walk.Locate(t).second;
  J.tail<2>() << 1.0 - u, u;
  return J;
}

/// The motion at t whose mean `m` of `gp` is, over times of the variances s_R of the rotation and
/// s_p of the position [s^2], doc/math.md, "Filter of the gyroscope": as it is where the GP ends
/// within a step.
MarkerState<double> Sharpened(const PoseTrajectory& gp, double t, double s_R, double s_p,
                              MarkerState<double> m) {
  constexpr double kStep = 0.01;  // [s] of differences
  MarkerState<double> before, after;
  if ((s_R == 0.0 && s_p == 0.0) || !gp.Evaluate(t - kStep, &before) ||
      !gp.Evaluate(t + kStep, &after))
    return m;
  const auto curvature = [](const Eigen::Vector3d& x, const Eigen::Vector3d& y,
                            const Eigen::Vector3d& z) -> Eigen::Vector3d {
    return (x - 2.0 * y + z) / (kStep * kStep);
  };
  const Eigen::Vector3d alpha_rate = (after.alpha_M - before.alpha_M) / (2.0 * kStep);
  const MarkerState<double> mean = m;
  m.q_WM = mean.q_WM * Exp<double>(-0.5 * s_R * mean.alpha_M);
  m.omega_M -=
      0.5 * s_R *
      (curvature(before.omega_M, mean.omega_M, after.omega_M) + mean.omega_M.cross(mean.alpha_M));
  m.alpha_M -=
      0.5 * s_R *
      (curvature(before.alpha_M, mean.alpha_M, after.alpha_M) + mean.omega_M.cross(alpha_rate));
  m.p_WM -= 0.5 * s_p * mean.a_W;
  m.v_W -= 0.5 * s_p * curvature(before.v_W, mean.v_W, after.v_W);
  m.a_W -= 0.5 * s_p * curvature(before.a_W, mean.a_W, after.a_W);
  return m;
}

}  // namespace

TrajectoryCovariance::TrajectoryCovariance(const std::shared_ptr<const Solution>& solution)
    : solution_(solution) {
  const Marginals& m = solution->marginals;
  if (!m.inverse.valid())
    throw InputError(
        "the covariance of the trajectory was not kept: it needs a larger max_factor_mb");
  int column = m.calibrated_end;
  const auto add = [&](const auto& values, size_t size) {
    first_[values.data()] = column;
    column += static_cast<int>(size);
  };
  const std::vector<SessionEstimate>& sessions = solution->estimate.sessions;
  for (size_t s = 0; s < sessions.size(); ++s)
    if (m.Find(ParameterKind::kGravity, 0, s) >= 0) add(sessions[s].g_W, 3);
  for (const SessionEstimate& session : sessions)
    for (const ImuSessionEstimate& imu : session.imus)
      for (const BiasKnots* knots : {&imu.gyro_bias, &imu.accel_bias})
        add(knots->values, 3 * knots->values.size());
  for (const SessionEstimate& session : sessions)
    for (const ImuSessionEstimate& imu : session.imus)
      if (!imu.walk.IsLine()) add(imu.walk.offset, imu.walk.offset.size() - 1);
  for (const SessionEstimate& session : sessions)
    for (const SlowErrors* const errors : session.AllErrors())
      add(errors->knots.values, 3 * errors->knots.values.size());
  for (const CorrectionSplines& splines : solution->splines)
    for (const auto* points : {&splines.d, &splines.phi}) add(*points, 3 * points->size());
}

TrajectoryCovariance::Columns TrajectoryCovariance::Kept(int first, int count) const {
  Columns columns(static_cast<size_t>(count), -1);
  if (first < 0) return columns;
  std::iota(columns.begin(), columns.end(), first);
  return columns;
}

TrajectoryCovariance::Columns TrajectoryCovariance::ControlPoints(size_t session,
                                                                  size_t first) const {
  const CorrectionSplines& splines = solution_->splines[session];
  const int place = 3 * static_cast<int>(first);
  Columns columns = Kept(first_.at(splines.d.data()) + place, kPoints);
  const Columns of_phi = Kept(first_.at(splines.phi.data()) + place, kPoints);
  columns.insert(columns.end(), of_phi.begin(), of_phi.end());
  return columns;
}

TrajectoryCovariance::Columns TrajectoryCovariance::Calibrated(ParameterKind kind, size_t imu,
                                                               int size) const {
  return Kept(solution_->marginals.Find(kind, imu), size);
}

TrajectoryCovariance::Columns TrajectoryCovariance::Clock(size_t session, size_t imu,
                                                          double t) const {
  const Marginals& m = solution_->marginals;
  Columns clock = {m.Find(ParameterKind::kTimeShift, imu, session),
                   m.Find(ParameterKind::kClockDrift, imu, session), -1, -1};
  const ClockWalk& walk = solution_->estimate.sessions[session].imus[imu].walk;
  if (walk.IsLine()) return clock;
  const size_t knot = walk.Locate(t).first;
  for (size_t k = knot; k < knot + 2; ++k)  // that at the reference is not estimated
    if (k != walk.reference)
      clock[2 + k - knot] =
          first_.at(walk.offset.data()) + static_cast<int>(k) - (k > walk.reference ? 1 : 0);
  return clock;
}

TrajectoryCovariance::Columns TrajectoryCovariance::Gravity(size_t session) const {
  const auto found = first_.find(solution_->estimate.sessions[session].g_W.data());
  return Kept(found == first_.end() ? -1 : found->second, 3);
}

TrajectoryCovariance::Columns TrajectoryCovariance::BiasKnotPair(size_t session, size_t imu,
                                                                 bool is_accel, size_t knot) const {
  const ImuSessionEstimate& own = solution_->estimate.sessions[session].imus[imu];
  const BiasKnots& knots = is_accel ? own.accel_bias : own.gyro_bias;
  return Kept(first_.at(knots.values.data()) + 3 * static_cast<int>(knot), 6);
}

Eigen::MatrixXd TrajectoryCovariance::At(const Columns& columns) const {
  const Marginals& m = solution_->marginals;
  const auto size = static_cast<Eigen::Index>(columns.size());
  Eigen::MatrixXd C = Eigen::MatrixXd::Zero(size, size);
  for (Eigen::Index i = 0; i < size; ++i)
    for (Eigen::Index j = 0; j <= i; ++j) {
      const int row = columns[static_cast<size_t>(i)], column = columns[static_cast<size_t>(j)];
      if (row >= 0 && column >= 0)
        C(i, j) = C(j, i) = m.elimination->At(m.inverse.get(), row, column);
    }
  return C;
}

Eigen::MatrixXd TrajectoryCovariance::Of(const Eigen::MatrixXd& J,
                                         const std::vector<Columns>& parts) const {
  Columns all;
  for (const Columns& part : parts) all.insert(all.end(), part.begin(), part.end());
  return Propagate(J, At(all));
}

std::optional<BodyState> SessionTrajectory::Body(const Rigid3& T_MB, double t,
                                                 StateJacobian* J) const {
  MarkerState<double> gp;
  const PoseTrajectory& trajectory = *solution_->trajectories[session_];
  if (!trajectory.Evaluate(t, &gp)) return std::nullopt;
  const Estimate& estimate = solution_->estimate;
  gp = Sharpened(trajectory, t, estimate.gyro_smoothing,
                 estimate.gyro_smoothing + estimate.accel_smoothing, gp);
  ActingPoints<double> points = ActingPoints<double>::Zero();  // as they are without splines
  SplinePlace place{0, 0.0, 1.0};
  if (!solution_->splines.empty()) {
    const CorrectionSplines& splines = solution_->splines[session_];
    const auto found = splines.Locate(t);
    if (!found) return std::nullopt;
    place = *found;
    for (size_t j = 0; j < kSplineOrder; ++j) {
      points.col(static_cast<int>(j)) = splines.d[place.first + j];
      points.col(static_cast<int>(j) + kSplineOrder) = splines.phi[place.first + j];
    }
  }
  const SplineWeights weights = CubicWeights(place.u, place.spacing);
  const BodyState state = CorrectedState<double>(gp, weights, points, T_MB.q, T_MB.p);
  if (J == nullptr) return state;

  ActingPoints<Jet> jet_points;
  for (int k = 0; k < 2 * kPoints; ++k) jet_points.data()[k] = Jet(points.data()[k], k);
  Vector3<Jet> p_MB, turn;
  for (int i = 0; i < 3; ++i) {
    p_MB[i] = Jet(T_MB.p[i], 2 * kPoints + i);
    turn[i] = Jet(0.0, 2 * kPoints + 3 + i);
  }
  // As Ceres turns it: on the left and by twice the step.
  const Eigen::Quaternion<Jet> q_MB = Exp<Jet>(Vector3<Jet>(turn * Jet(2.0))) * T_MB.q.cast<Jet>();
  const BodyStateOf<Jet> jet = CorrectedState<Jet>(gp, weights, jet_points, q_MB, p_MB);
  const Eigen::Quaternion<Jet> turned = state.q_WB.conjugate().cast<Jet>() * jet.q_WB;
  const Vector3<Jet> rows[] = {Log(turned), jet.p_WB, jet.omega_B, jet.v_W, jet.alpha_B, jet.a_W};
  for (int k = 0; k < 6; ++k)
    for (int i = 0; i < 3; ++i) J->row(3 * k + i) = rows[k][i].v;
  return state;
}

const TrajectoryCovariance* SessionTrajectory::covariance() const {
  if (!covariance_ && !solution_->splines.empty()) covariance_.emplace(solution_);
  return covariance_ ? &*covariance_ : nullptr;
}

std::optional<BodyCovariance> SessionTrajectory::MarkerCovariance(double t,
                                                                  const Rigid3& T_MB) const {
  StateJacobian J;
  if (solution_->splines.empty() || !Body(T_MB, t, &J)) return std::nullopt;
  const TrajectoryCovariance* const own = covariance();
  const size_t first = solution_->splines[session_].Locate(t)->first;
  return BodyCovariance(own->Of(J.leftCols<2 * kPoints>(), {own->ControlPoints(session_, first)}));
}

std::optional<BodyCovariance> SessionTrajectory::ImuCovariance(size_t imu, double t,
                                                               bool is_on_its_clock) const {
  StateJacobian J;
  if (solution_->splines.empty()) return std::nullopt;
  const auto state = Imu(imu, t, &J);
  if (!state) return std::nullopt;
  const ImuSessionEstimate& clock = solution_->estimate.sessions[session_].imus[imu];
  const double t_imu = clock.ImuTime(t);
  Eigen::Matrix<double, 18, 1> rate = Eigen::Matrix<double, 18, 1>::Zero();
  if (is_on_its_clock) rate.head<12>() << state->omega_B, state->v_W, state->alpha_B, state->a_W;
  Eigen::Matrix<double, 18, kInputs + 4> with_clock;
  with_clock << J, rate * ByClock(clock, t_imu);
  const TrajectoryCovariance* const own = covariance();
  const size_t first = solution_->splines[session_].Locate(t)->first;
  return BodyCovariance(own->Of(
      with_clock,
      {own->ControlPoints(session_, first), own->Calibrated(ParameterKind::kTranslation, imu, 3),
       own->Calibrated(ParameterKind::kRotation, imu, 3), own->Clock(session_, imu, t_imu)}));
}

double SessionTrajectory::ClockVariance(size_t imu, double t) const {
  const TrajectoryCovariance* const own = covariance();
  if (own == nullptr) return 0.0;
  const ImuSessionEstimate& clock = solution_->estimate.sessions[session_].imus[imu];
  const double t_imu = clock.ImuTime(t);
  return own->Of(ByClock(clock, t_imu), {own->Clock(session_, imu, t_imu)})(0, 0);
}

std::optional<BodyState> SessionTrajectory::Imu(size_t imu, double t, StateJacobian* J) const {
  const ImuEstimate& rig = solution_->estimate.imus[imu];
  return Body({rig.q_MI, rig.p_MI}, t, J);
}

ImuBiases SessionTrajectory::Biases(size_t imu, double t) const {
  const ImuSessionEstimate& own = solution_->estimate.sessions[session_].imus[imu];
  const double t_I = own.ImuTime(t);
  return {own.gyro_bias.At(t_I), own.accel_bias.At(t_I)};
}

std::optional<Matrix6d> SessionTrajectory::BiasCovariance(size_t imu, double t) const {
  const TrajectoryCovariance* const own = covariance();
  if (own == nullptr) return std::nullopt;
  const ImuSessionEstimate& biases = solution_->estimate.sessions[session_].imus[imu];
  std::vector<TrajectoryCovariance::Columns> knots;
  Eigen::Matrix<double, 6, 12> J = Eigen::Matrix<double, 6, 12>::Zero();
  for (const bool is_accel : {false, true}) {
    const auto [k, u] = (is_accel ? biases.accel_bias : biases.gyro_bias).Locate(biases.ImuTime(t));
    knots.push_back(own->BiasKnotPair(session_, imu, is_accel, k));
    const int i = is_accel ? 3 : 0;
    J.block<3, 3>(i, 2 * i) = (1.0 - u) * Eigen::Matrix3d::Identity();
    J.block<3, 3>(i, 2 * i + 3) = u * Eigen::Matrix3d::Identity();
  }
  return Matrix6d(own->Of(J, knots));
}

}  // namespace imu_pose_calib
