#include "imu_pose_calib/core/trajectory_covariance.h"

#include <Eigen/SparseCholesky>
#include <algorithm>

namespace imu_pose_calib {
namespace {

using SparseMatrix = Eigen::SparseMatrix<double>;

}  // namespace

/// The elements of H^-1 where the Cholesky factor of H has elements, by Takahashi's recursion: as
/// cheap as the factorisation.
class TrajectoryCovariance::SelectedInverse {
 public:
  explicit SelectedInverse(const SparseMatrix& H) {
    const Eigen::SimplicialLDLT<SparseMatrix> ldlt(H);
    if (ldlt.info() != Eigen::Success) throw DataError("the trajectory is not determined");
    place_ = ldlt.permutationP().indices();
    Z_ = ldlt.matrixL();
    const Eigen::VectorXd D = ldlt.vectorD();
    for (Eigen::Index j = H.cols() - 1; j >= 0; --j) SolveColumn(j, 1.0 / D[j]);
  }

  double At(int row, int column) const {
    Eigen::Index i = place_[row], j = place_[column];
    if (i < j) std::swap(i, j);
    const int* begin = Z_.innerIndexPtr() + Z_.outerIndexPtr()[j];
    const int* end = Z_.innerIndexPtr() + Z_.outerIndexPtr()[j + 1];
    const int* found = std::lower_bound(begin, end, static_cast<int>(i));
    return found == end || *found != i ? 0.0 : Z_.valuePtr()[found - Z_.innerIndexPtr()];
  }

 private:
  /// Replaces column j of L by that of H^-1; all later columns are done.
  void SolveColumn(Eigen::Index j, double inverse_D) {
    const int begin = Z_.outerIndexPtr()[j] + 1, end = Z_.outerIndexPtr()[j + 1];  // below diagonal
    const int* rows = Z_.innerIndexPtr();
    double* values = Z_.valuePtr();
    const Eigen::Map<const Eigen::VectorXd> l(values + begin, end - begin);
    Eigen::VectorXd z = Eigen::VectorXd::Zero(l.size());
    for (int a = begin; a < end; ++a) {
      // Column rows[a] of H^-1 holds all rows of column j below it.
      int b = a;
      for (int k = Z_.outerIndexPtr()[rows[a]]; k < Z_.outerIndexPtr()[rows[a] + 1] && b < end;
           ++k) {
        if (rows[k] != rows[b]) continue;
        z[b - begin] -= values[k] * l[a - begin];
        if (b != a) z[a - begin] -= values[k] * l[b - begin];
        ++b;
      }
    }
    values[begin - 1] = inverse_D - l.dot(z);
    std::copy(z.data(), z.data() + z.size(), values + begin);
  }

  Eigen::VectorXi place_;
  SparseMatrix Z_;  ///< lower triangle, permuted
};

TrajectoryCovariance::TrajectoryCovariance(const std::shared_ptr<const Solution>& solution)
    : solution_(solution) {
  // As FindMarginals() orders H.
  int column = solution->marginals.held_end;
  for (size_t s = 0; s < solution->estimate.sessions.size(); ++s) {
    const SessionEstimate& session = solution->estimate.sessions[s];
    const bool has_gravity = solution->marginals.Find(ParameterKind::kGravity, 0, s) >= 0;
    gravity_.push_back(has_gravity ? column : -1);
    if (has_gravity) column += 2;
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
  inverse_ = std::make_unique<const SelectedInverse>(FreeInformation());
}

TrajectoryCovariance::~TrajectoryCovariance() = default;

SparseMatrix TrajectoryCovariance::FreeInformation() const {
  const Marginals& m = solution_->marginals;
  const auto free = [&m](Eigen::Index column) {
    return column < m.held_begin || column >= m.held_end;
  };
  const auto place = [&m](Eigen::Index column) {
    return column < m.held_begin ? column : column - (m.held_end - m.held_begin);
  };
  const Eigen::Index size = m.H.cols() - (m.held_end - m.held_begin);
  SparseMatrix own(size, size);
  own.reserve(m.H.nonZeros());
  for (Eigen::Index column = 0; column < m.H.cols(); ++column) {
    if (!free(column)) continue;
    own.startVec(place(column));
    for (SparseMatrix::InnerIterator it(m.H, column); it; ++it)
      if (free(it.row())) own.insertBack(place(it.row()), place(column)) = it.value();
  }
  own.finalize();

  // Zeros keep places for pairs that share no residual.
  std::vector<Eigen::Triplet<double>> zeros;
  for (size_t s = 0; s < solution_->splines.size(); ++s) {
    for (const CorrectionSplines::Run& run : solution_->splines[s].Runs()) {
      for (size_t i = 0; i < solution_->estimate.imus.size(); ++i) {
        const ImuSessionEstimate& imu = solution_->estimate.sessions[s].imus[i];
        if (!imu.is_present) continue;
        const auto add = [&](size_t first, double t) {
          Columns others = Calibrated(ParameterKind::kGyroIntrinsics, i, 6);
          const size_t knot = imu.gyro_bias.Locate(imu.ImuTime(t)).first;
          for (const int c : BiasKnotPair(s, i, false, knot)) others.push_back(c);
          const Columns points = ControlPoints(s, first);
          for (size_t k = 0; k < 3 * kSplineOrder; ++k)
            for (const int other : others)
              if (other >= 0) zeros.emplace_back(points[k], other, 0.0);
        };
        add(run.first, run.begin);
        add(run.first + run.points - kSplineOrder, run.end);
      }
    }
  }
  SparseMatrix places(size, size);
  places.setFromTriplets(zeros.begin(), zeros.end());
  return own + places;
}

TrajectoryCovariance::Columns TrajectoryCovariance::Kept(int first, int count) const {
  const Marginals& m = solution_->marginals;
  Columns columns(static_cast<size_t>(count), -1);
  if (first < 0 || (first >= m.held_begin && first < m.held_end)) return columns;
  for (int k = 0; k < count; ++k)
    columns[static_cast<size_t>(k)] =
        first + k - (first < m.held_begin ? 0 : m.held_end - m.held_begin);
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
      if (row >= 0 && column >= 0) C(i, j) = C(j, i) = inverse_->At(row, column);
    }
  return C;
}

}  // namespace imu_pose_calib
