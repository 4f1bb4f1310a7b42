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

}  // namespace imu_pose_calib
