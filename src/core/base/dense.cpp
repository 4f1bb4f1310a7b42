#include "imu_pose_calib/core/base/dense.h"

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <limits>

#if defined(__x86_64__) && defined(__GNUC__)
#define IMU_POSE_CALIB_AVX2
#define IMU_POSE_CALIB_INLINE inline __attribute__((always_inline))
#endif

namespace imu_pose_calib {
namespace {

#ifdef IMU_POSE_CALIB_AVX2

using Packet = double __attribute__((vector_size(32), aligned(8), may_alias));

/// A (n x k), B (m x k) and C (n x m), and the distance of their columns.
struct Operands {
  double scale;
  Eigen::Index n, m, k;
  const double* A;
  Eigen::Index A_stride;
  const double* B;
  Eigen::Index B_stride;
  double* C;
  Eigen::Index C_stride;
};

/// 4 kPackets rows from i on and kColumns columns from j on; of the rows, those from `first` on.
template <int kPackets, int kColumns>
IMU_POSE_CALIB_INLINE void AddTile(const Operands& p, Eigen::Index i, Eigen::Index j,
                                   Eigen::Index first) {
  Packet sums[kPackets][kColumns];
  for (auto& row : sums)
    for (Packet& sum : row) sum = Packet{0.0, 0.0, 0.0, 0.0};
  const double* a = p.A + i;
  const double* b = p.B + j;
  for (Eigen::Index k = 0; k < p.k; ++k, a += p.A_stride, b += p.B_stride)
    for (int r = 0; r < kPackets; ++r) {
      const Packet rows = *reinterpret_cast<const Packet*>(a + 4 * r);
      for (int c = 0; c < kColumns; ++c) sums[r][c] += rows * b[c];
    }
  double* to = p.C + i + j * p.C_stride;
  for (int c = 0; c < kColumns; ++c, to += p.C_stride) {
    for (int r = 0; r < kPackets && first == i; ++r)
      *reinterpret_cast<Packet*>(to + 4 * r) += p.scale * sums[r][c];
    for (Eigen::Index r = first - i; r < 4 && first != i; ++r) to[r] += p.scale * sums[0][c][r];
  }
}

/// Rows from `begin` on of columns from j on.
template <int kColumns>
IMU_POSE_CALIB_INLINE void AddColumns(const Operands& p, Eigen::Index begin, Eigen::Index j) {
  Eigen::Index i = begin;
  for (; i + 12 <= p.n; i += 12) AddTile<3, kColumns>(p, i, j, i);
  for (; i + 4 <= p.n; i += 4) AddTile<1, kColumns>(p, i, j, i);
  if (i < p.n) AddTile<1, kColumns>(p, p.n - 4, j, i);
}

__attribute__((target("avx2,fma"))) void AddWithAvx2(const Operands& p, bool is_lower) {
  Eigen::Index j = 0;
  for (; j + 4 <= p.m; j += 4) AddColumns<4>(p, is_lower ? j : 0, j);
  for (; j < p.m; ++j) AddColumns<1>(p, is_lower ? j : 0, j);
}

#endif

}  // namespace

void AddProduct(double scale, const ConstDenseRef& A, const ConstDenseRef& B, bool is_lower,
                DenseRef C) {
#ifdef IMU_POSE_CALIB_AVX2
  static const bool kHasAvx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  if (kHasAvx2 && C.rows() >= 4)
    return AddWithAvx2({scale, C.rows(), C.cols(), A.cols(), A.data(), A.outerStride(), B.data(),
                        B.outerStride(), C.data(), C.outerStride()},
                       is_lower);
#endif
  if (is_lower)
    C.triangularView<Eigen::Lower>() += scale * A * B.transpose();
  else
    C.noalias() += scale * A * B.transpose();
}

// Eigen's solveInPlace() writes what it takes as constant.
// NOLINTNEXTLINE(performance-unnecessary-value-param)
bool Factor(DenseRef C, DenseRef B) {
  Eigen::LLT<DenseRef> llt(C);
  llt.matrixL().transpose().solveInPlace<Eigen::OnTheRight>(B);
  return llt.info() == Eigen::Success;
}

Eigen::MatrixXd Gather(const Eigen::MatrixXd& A, const std::vector<int>& rows,
                       const std::vector<int>& columns) {
  Eigen::MatrixXd gathered(rows.size(), columns.size());
  for (Eigen::Index j = 0; j < gathered.cols(); ++j)
    for (Eigen::Index i = 0; i < gathered.rows(); ++i)
      gathered(i, j) = A(rows[static_cast<size_t>(i)], columns[static_cast<size_t>(j)]);
  return gathered;
}

Eigen::MatrixXd Product(const Eigen::MatrixXd& A, const Eigen::MatrixXd& B) { return A * B; }

Eigen::MatrixXd Propagate(const Eigen::MatrixXd& A, const Eigen::MatrixXd& C) {
  return A * C * A.transpose();
}

Eigen::MatrixXd Inverse(const Eigen::MatrixXd& A) { return A.inverse(); }

Eigen::MatrixXd Solve(const Eigen::MatrixXd& C, const Eigen::MatrixXd& B) {
  return C.ldlt().solve(B);
}

Eigen::MatrixXd SolvePositive(const Eigen::MatrixXd& C, const Eigen::MatrixXd& B) {
  Eigen::MatrixXd L = C;
  const Eigen::LLT<DenseRef> llt(L);
  if (!C.allFinite() || llt.info() != Eigen::Success)
    return Eigen::MatrixXd::Constant(B.rows(), B.cols(), std::numeric_limits<double>::quiet_NaN());
  return llt.solve(B);
}

double SquaredDistance(const Eigen::VectorXd& d, const Eigen::MatrixXd& C) {
  return d.dot(SolvePositive(C, d).col(0));
}

}  // namespace imu_pose_calib
