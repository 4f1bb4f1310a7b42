#pragma once

#include <Eigen/Core>

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

/// A C A^T: the covariance C propagated by A.
Eigen::MatrixXd Propagate(const Eigen::MatrixXd& A, const Eigen::MatrixXd& C);
Eigen::MatrixXd Inverse(const Eigen::MatrixXd& A);
bool IsPositiveDefinite(const Eigen::MatrixXd& C);
/// d^T C^-1 d, of positive definite C.
double SquaredDistance(const Eigen::VectorXd& d, const Eigen::MatrixXd& C);

}  // namespace imu_pose_calib
