#include "imu_pose_calib/core/trajectory_covariance.h"

#include <Eigen/Cholesky>
#include <numeric>

namespace imu_pose_calib {
TrajectoryCovariance::TrajectoryCovariance(const std::shared_ptr<const Solution>& solution)
    : solution_(solution) {
  const Marginals& m = solution->marginals;
  if (m.factor.empty())
    throw InputError(
        "the covariance of the trajectory was not kept: it needs a larger max_factor_mb");
  int column = m.held_end;
  for (size_t s = 0; s < solution->estimate.sessions.size(); ++s) {
    const bool has_gravity = m.Find(ParameterKind::kGravity, 0, s) >= 0;
    gravity_.push_back(has_gravity ? column : -1);
    if (has_gravity) column += 2;
  }
  for (const SessionEstimate& session : solution->estimate.sessions) {
    gyro_knots_.emplace_back();
    accel_knots_.emplace_back();
    for (const ImuSessionEstimate& imu : session.imus) {
      gyro_knots_.back().push_back(column);
      column += 3 * static_cast<int>(imu.gyro_bias.values.size());
      accel_knots_.back().push_back(column);
      column += 3 * static_cast<int>(imu.accel_bias.values.size());
    }
  }
  for (const CorrectionSplines& splines : solution->splines) {
    d_.push_back(column);
    column += 6 * static_cast<int>(splines.d.size());
  }

  Eigen::MatrixXd border = m.factor.rbegin()->second.H;
  const int held = m.held_end - m.held_begin;
  border.middleRows(m.held_begin, held).setZero();
  border.middleCols(m.held_begin, held).setZero();
  border.diagonal().segment(m.held_begin, held).setOnes();
  const Eigen::LLT<Eigen::MatrixXd> llt(border);
  if (!border.allFinite() || llt.info() != Eigen::Success)
    throw DataError("the trajectory is not determined");
  border = llt.solve(Eigen::MatrixXd::Identity(border.rows(), border.cols()));
  border.diagonal().segment(m.held_begin, held).setZero();
  inverse_ = m.factor;
  m.elimination->Invert(border, &inverse_);
}

TrajectoryCovariance::Columns TrajectoryCovariance::Kept(int first, int count) const {
  const Marginals& m = solution_->marginals;
  Columns columns(static_cast<size_t>(count), -1);
  if (first < 0 || (first >= m.held_begin && first < m.held_end)) return columns;
  std::iota(columns.begin(), columns.end(), first);
  return columns;
}

TrajectoryCovariance::Columns TrajectoryCovariance::ControlPoints(size_t session,
                                                                  size_t first) const {
  const int d = d_[session] + 3 * static_cast<int>(first);
  Columns columns = Kept(d, 3 * kSplineOrder);
  const Columns phi =
      Kept(d + 3 * static_cast<int>(solution_->splines[session].d.size()), 3 * kSplineOrder);
  columns.insert(columns.end(), phi.begin(), phi.end());
  return columns;
}

TrajectoryCovariance::Columns TrajectoryCovariance::Calibrated(ParameterKind kind,
                                                               size_t imu,
                                                               int size) const {
  return Kept(solution_->marginals.FindColumn(kind, IsOfPoses(kind) ? 0 : imu), size);
}

TrajectoryCovariance::Columns TrajectoryCovariance::Clock(size_t session, size_t imu) const {
  Columns clock(2, -1);
  int column = 0;
  for (const PlacedParameter& p : solution_->marginals.parameters) {
    if (!p.is_estimated) continue;
    if (p.parameter.imu == imu && p.parameter.session == session) {
      if (p.parameter.kind == ParameterKind::kTimeShift) clock[0] = Kept(column, 1)[0];
      if (p.parameter.kind == ParameterKind::kClockDrift) clock[1] = Kept(column, 1)[0];
    }
    column += p.parameter.size;
  }
  return clock;
}

TrajectoryCovariance::Columns TrajectoryCovariance::Gravity(size_t session) const {
  return Kept(gravity_[session], 2);
}

TrajectoryCovariance::Columns TrajectoryCovariance::BiasKnotPair(size_t session,
                                                                 size_t imu,
                                                                 bool is_accel,
                                                                 size_t knot) const {
  const auto& knots = is_accel ? accel_knots_ : gyro_knots_;
  return Kept(knots[session][imu] + 3 * static_cast<int>(knot), 6);
}

Eigen::MatrixXd TrajectoryCovariance::At(const Columns& columns) const {
  const auto size = static_cast<Eigen::Index>(columns.size());
  Eigen::MatrixXd C = Eigen::MatrixXd::Zero(size, size);
  for (Eigen::Index i = 0; i < size; ++i)
    for (Eigen::Index j = 0; j <= i; ++j) {
      const int row = columns[static_cast<size_t>(i)], column = columns[static_cast<size_t>(j)];
      if (row >= 0 && column >= 0)
        C(i, j) = C(j, i) = solution_->marginals.elimination->At(inverse_, row, column);
    }
  return C;
}

}  // namespace imu_pose_calib
