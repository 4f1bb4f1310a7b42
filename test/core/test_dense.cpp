#include <gtest/gtest.h>

#include <Eigen/Core>

#include "imu_pose_calib/core/base/dense.h"

namespace imu_pose_calib {
namespace {

TEST(AddProduct, IsTheProductOfEigen) {
  std::srand(1);
  for (int n = 1; n <= 30; ++n) {
    for (const int m : {1, 3, 4, 5, 9, n}) {
      for (const int k : {0, 1, 7, 24}) {
        // Parts of larger matrices, of which the rest must stay.
        const Eigen::MatrixXd A = Eigen::MatrixXd::Random(n + 2, k + 1);
        const Eigen::MatrixXd B = Eigen::MatrixXd::Random(m + 3, k);
        const Eigen::MatrixXd before = Eigen::MatrixXd::Random(n + 5, m + 1);
        Eigen::MatrixXd expected = before, C = before;
        expected.block(2, 1, n, m) -= 0.7 * A.block(1, 1, n, k) * B.bottomRows(m).transpose();
        AddProduct(-0.7, A.block(1, 1, n, k), B.bottomRows(m), false, C.block(2, 1, n, m));
        ASSERT_LT((C - expected).cwiseAbs().maxCoeff(), 1e-13) << n << " " << m << " " << k;
        if (m != n) continue;
        C = before;
        AddProduct(-0.7, A.block(1, 1, n, k), B.bottomRows(m), true, C.block(2, 1, n, m));
        C.block(2, 1, n, m).triangularView<Eigen::StrictlyUpper>() = expected.block(2, 1, n, m);
        ASSERT_LT((C - expected).cwiseAbs().maxCoeff(), 1e-13) << n << " lower " << k;
      }
    }
  }
}

}  // namespace
}  // namespace imu_pose_calib
