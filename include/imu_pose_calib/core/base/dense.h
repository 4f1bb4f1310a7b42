#pragma once

#include <Eigen/Core>
#include <vector>

namespace imu_pose_calib {

/// Columns one after the other, without gaps within them.
using DenseRef = Eigen::Ref<Eigen::MatrixXd, 0, Eigen::OuterStride<>>;
using ConstDenseRef = Eigen::Ref<const Eigen::MatrixXd, 0, Eigen::OuterStride<>>;

/// C += scale A B^T; of square C and with `is_lower`, elements above the diagonal may be left as
/// they were. For small matrices, with the instructions that the processor has: Eigen knows those
/// of the oldest.
void AddProduct(double scale, const ConstDenseRef& A, const ConstDenseRef& B, bool is_lower,
                DenseRef C);

// Whatever source names these in Eigen's terms takes seconds more to compile.

/// Cholesky: of C = L L^T, L takes the lower triangle, and B becomes B L^-T. False when C is not
/// positive definite.
bool Factor(DenseRef C, DenseRef B);

/// The elements of A in these rows and columns.
Eigen::MatrixXd Gather(const Eigen::MatrixXd& A, const std::vector<int>& rows,
                       const std::vector<int>& columns);
/// A B.
Eigen::MatrixXd Product(const Eigen::MatrixXd& A, const Eigen::MatrixXd& B);
/// A C A^T: the covariance C propagated by A.
Eigen::MatrixXd Propagate(const Eigen::MatrixXd& A, const Eigen::MatrixXd& C);
Eigen::MatrixXd Inverse(const Eigen::MatrixXd& A);
/// C^-1 B, of symmetric C.
Eigen::MatrixXd Solve(const Eigen::MatrixXd& C, const Eigen::MatrixXd& B);

/// C^-1 B; NaN when C is not positive definite.
Eigen::MatrixXd SolvePositive(const Eigen::MatrixXd& C, const Eigen::MatrixXd& B);
/// d^T C^-1 d, of positive definite C.
double SquaredDistance(const Eigen::VectorXd& d, const Eigen::MatrixXd& C);

}  // namespace imu_pose_calib
