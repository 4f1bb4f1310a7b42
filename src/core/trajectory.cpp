#include "imu_pose_calib/core/trajectory.h"

#include <ceres/jet.h>

#include <Eigen/SparseCholesky>
#include <algorithm>

#include "imu_pose_calib/core/correction.h"

namespace imu_pose_calib {
namespace {

using SparseMatrix = Eigen::SparseMatrix<double>;

constexpr int kPoints = 3 * kSplineOrder;  // coordinates of the control points that act at once
/// Of the state: control points of d, of phi, p_MB and R_MB.
constexpr int kInputs = 2 * kPoints + 6;
using Jet = ceres::Jet<double, kInputs>;
template <typename T>
using Vector3 = Eigen::Matrix<T, 3, 1>;

/// The elements of H^-1 where the Cholesky factor of H has elements, by Takahashi's recursion: as
/// cheap as the factorisation, and enough for parameters that share a residual.
class SelectedInverse {
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

/// State of B on M where the splines of the control points correct the GP's motion.
template <typename T>
void CorrectedState(const MarkerState<double>& gp,
                    const SplineWeights& weights,
                    T const* const* d_points,
                    T const* const* phi_points,
                    const Eigen::Quaternion<T>& q_MB,
                    const Vector3<T>& p_MB,
                    Eigen::Quaternion<T>* q_WB,
                    Vector3<T>* rest) {
  const Eigen::Matrix<T, 3, 4> d = EvaluateSpline<T>(d_points, weights);
  const Eigen::Matrix<T, 3, 4> phi = EvaluateSpline<T>(phi_points, weights);
  Vector3<T> u, u_dot;
  CorrectionRate<T>(phi.col(0), phi.col(1), phi.col(2), &u, &u_dot);
  const Eigen::Quaternion<T> E = Exp<T>(phi.col(0));
  const Vector3<T> omega_E = E.conjugate() * Vector3<T>(gp.omega_M.cast<T>());
  const Vector3<T> omega = omega_E + u;
  const Vector3<T> alpha =
      E.conjugate() * Vector3<T>(gp.alpha_M.cast<T>()) - u.cross(omega_E) + u_dot;
  const Eigen::Quaternion<T> q_WM = gp.q_WM.cast<T>() * E;
  *q_WB = q_WM * q_MB;
  rest[0] = gp.p_WM.cast<T>() + d.col(0) + q_WM * p_MB;
  rest[1] = q_MB.conjugate() * omega;
  rest[2] = gp.v_W.cast<T>() + d.col(1) + q_WM * Vector3<T>(omega.cross(p_MB));
  rest[3] = q_MB.conjugate() * alpha;
  rest[4] = gp.a_W.cast<T>() + d.col(2) +
            q_WM * Vector3<T>(alpha.cross(p_MB) + omega.cross(omega.cross(p_MB)));
}

}  // namespace

/// H^-1 as far as single instants need it, parameters that are held left out.
class SessionTrajectory::Uncertainty {
 public:
  explicit Uncertainty(const Solution& solution) : marginals_(solution.marginals) {
    std::vector<Eigen::Triplet<double>> kept;
    const SparseMatrix& H = marginals_.H;
    for (int column = 0; column < H.cols(); ++column)
      for (SparseMatrix::InnerIterator it(H, column); it; ++it)
        if (Kept(column) >= 0 && Kept(static_cast<int>(it.row())) >= 0)
          kept.emplace_back(Kept(static_cast<int>(it.row())), Kept(column), it.value());
    const int size = static_cast<int>(H.cols()) - (marginals_.held_end - marginals_.held_begin);
    SparseMatrix own(size, size);
    own.setFromTriplets(kept.begin(), kept.end());
    inverse_ = std::make_unique<SelectedInverse>(own);
    for (const CorrectionSplines& splines : solution.splines) {
      first_column_.push_back(first_column_.empty() ? marginals_.trajectory_begin : next_);
      next_ = first_column_.back() + 6 * static_cast<int>(splines.d.size());
    }
  }

  /// Covariance of the inputs of CorrectedState(), at a place of the session's splines.
  Eigen::Matrix<double, kInputs, kInputs> At(const Solution& solution,
                                             size_t session,
                                             size_t first_point,
                                             int imu) const {
    std::vector<int> columns;
    const auto add = [&](int first, int count) {
      for (int k = 0; k < count; ++k) columns.push_back(first < 0 ? -1 : Kept(first + k));
    };
    const int d = first_column_[session] + 3 * static_cast<int>(first_point);
    add(d, kPoints);
    add(d + 3 * static_cast<int>(solution.splines[session].d.size()), kPoints);
    const auto calibrated = [&](ParameterKind kind) {
      return imu < 0 ? -1 : marginals_.FindColumn(kind, static_cast<size_t>(imu));
    };
    add(calibrated(ParameterKind::kTranslation), 3);
    add(calibrated(ParameterKind::kRotation), 3);
    Eigen::Matrix<double, kInputs, kInputs> C;
    for (int i = 0; i < kInputs; ++i)
      for (int j = 0; j < kInputs; ++j) {
        const int row = columns[static_cast<size_t>(i)], column = columns[static_cast<size_t>(j)];
        C(i, j) = row < 0 || column < 0 ? 0.0 : inverse_->At(row, column);
      }
    return C;
  }

 private:
  /// Column without those that are held; -1 for one of them.
  int Kept(int column) const {
    if (column < marginals_.held_begin) return column;
    return column < marginals_.held_end ? -1
                                        : column - (marginals_.held_end - marginals_.held_begin);
  }

  const Marginals& marginals_;
  std::unique_ptr<SelectedInverse> inverse_;
  std::vector<int> first_column_;  ///< of each session's d
  int next_ = 0;
};

SessionTrajectory::SessionTrajectory(const std::shared_ptr<const Solution>& solution,
                                     size_t session)
    : solution_(solution), session_(session) {}

int64_t SessionTrajectory::epoch_ns() const { return solution_->pose_epochs_ns[session_]; }

std::optional<BodyState> SessionTrajectory::Evaluate(const Rigid3& T_MB,
                                                     double t,
                                                     Eigen::Matrix<double, 18, 30>* J) const {
  static_assert(kInputs == 30, "as declared");
  MarkerState<double> gp;
  if (!solution_->trajectories[session_]->Evaluate(t, &gp)) return std::nullopt;
  // Without splines, zero corrections.
  SplinePlace place{0, 0.0, 1.0};
  const Eigen::Vector3d zero = Eigen::Vector3d::Zero();
  const double *d[kSplineOrder], *phi[kSplineOrder];
  std::fill(d, d + kSplineOrder, zero.data());
  std::fill(phi, phi + kSplineOrder, zero.data());
  if (!solution_->splines.empty()) {
    const CorrectionSplines& splines = solution_->splines[session_];
    const auto found = splines.Locate(t);
    if (!found) return std::nullopt;
    place = *found;
    for (size_t j = 0; j < kSplineOrder; ++j) {
      d[j] = splines.d[place.first + j].data();
      phi[j] = splines.phi[place.first + j].data();
    }
  }
  const SplineWeights weights = CubicWeights(place.u, place.spacing);
  BodyState state;
  Eigen::Vector3d rest[5];
  CorrectedState<double>(gp, weights, d, phi, T_MB.q, T_MB.p, &state.q_WB, rest);
  state.p_WB = rest[0];
  state.omega_B = rest[1];
  state.v_W = rest[2];
  state.alpha_B = rest[3];
  state.a_W = rest[4];
  if (J == nullptr) return state;

  Vector3<Jet> jets[2 * kSplineOrder], p_MB, turn, rest_jets[5];
  const Jet* jet_points[2 * kSplineOrder];
  for (int j = 0; j < 2 * kSplineOrder; ++j) {
    for (int i = 0; i < 3; ++i)
      jets[j][i] = Jet(j < kSplineOrder ? d[j][i] : phi[j - kSplineOrder][i], 3 * j + i);
    jet_points[j] = jets[j].data();
  }
  for (int i = 0; i < 3; ++i) {
    p_MB[i] = Jet(T_MB.p[i], 2 * kPoints + i);
    turn[i] = Jet(0.0, 2 * kPoints + 3 + i);
  }
  // As Ceres turns it: on the left and by twice the step.
  const Eigen::Quaternion<Jet> q_MB = Exp<Jet>(Vector3<Jet>(turn * Jet(2.0))) * T_MB.q.cast<Jet>();
  Eigen::Quaternion<Jet> q_WB;
  CorrectedState<Jet>(
      gp, weights, jet_points, jet_points + kSplineOrder, q_MB, p_MB, &q_WB, rest_jets);
  const Vector3<Jet> theta = Log(Eigen::Quaternion<Jet>(state.q_WB.conjugate().cast<Jet>() * q_WB));
  for (int i = 0; i < 3; ++i) {
    J->row(i) = theta[i].v;
    for (int k = 0; k < 5; ++k) J->row(3 * (k + 1) + i) = rest_jets[k][i].v;
  }
  return state;
}

std::optional<BodyCovariance> SessionTrajectory::Covariance(const Rigid3& T_MB,
                                                            int imu,
                                                            double t) const {
  Eigen::Matrix<double, 18, 30> J;
  if (solution_->splines.empty() || !Evaluate(T_MB, t, &J)) return std::nullopt;
  if (!uncertainty_) uncertainty_ = std::make_shared<const Uncertainty>(*solution_);
  const size_t first_point = solution_->splines[session_].Locate(t)->first;
  return BodyCovariance(J * uncertainty_->At(*solution_, session_, first_point, imu) *
                        J.transpose());
}

std::optional<BodyState> SessionTrajectory::Marker(double t) const {
  return Evaluate({}, t, nullptr);
}

std::optional<BodyState> SessionTrajectory::Imu(size_t imu, double t) const {
  const ImuEstimate& rig = solution_->estimate.imus[imu];
  return Evaluate({rig.q_MI, rig.p_MI}, t, nullptr);
}

std::optional<BodyCovariance> SessionTrajectory::MarkerCovariance(double t) const {
  return Covariance({}, -1, t);
}

std::optional<BodyCovariance> SessionTrajectory::ImuCovariance(size_t imu, double t) const {
  const ImuEstimate& rig = solution_->estimate.imus[imu];
  return Covariance({rig.q_MI, rig.p_MI}, static_cast<int>(imu), t);
}

}  // namespace imu_pose_calib
