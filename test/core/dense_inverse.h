#pragma once

#include <Eigen/Cholesky>
#include <algorithm>
#include <numeric>
#include <vector>

#include "imu_pose_calib/core/calibration/marginals.h"

namespace imu_pose_calib {

/// H^-1 of a solve: put together from the factor of H, and inverted as a dense matrix.
inline Eigen::MatrixXd DenseInverse(const Marginals& m) {
  std::vector<int> size;  // of the blocks
  for (const PlacedParameter& p : m.parameters)
    if (p.parameter.data != nullptr) size.push_back(p.parameter.size);
  for (const PlacedParameter& p : m.parameters)
    if (p.parameter.kind == ParameterKind::kGravity) size.push_back(3);
  const size_t border = size.size();
  const int inner_columns = m.elimination->columns() - std::accumulate(size.begin(), size.end(), 0);
  size.resize(border + static_cast<size_t>(inner_columns) / 3, 3);
  std::vector<int> first(size.size(), 0), order(size.size());
  std::partial_sum(size.begin(), size.end() - 1, first.begin() + 1);
  std::iota(order.begin(), order.end(), 0);
  std::sort(order.begin(), order.end(),
            [&m](int a, int b) { return m.elimination->place(a) < m.elimination->place(b); });
  std::vector<int> column;  // by place
  Eigen::Index inner = 0;
  for (const int block : order) {
    if (block >= static_cast<int>(border)) inner += size[static_cast<size_t>(block)];
    for (int k = 0; k < size[static_cast<size_t>(block)]; ++k)
      column.push_back(first[static_cast<size_t>(block)] + k);
  }
  const auto columns = static_cast<Eigen::Index>(column.size());
  Eigen::MatrixXd L = Eigen::MatrixXd::Zero(columns, inner);
  for (Eigen::Index j = 0; j < inner; ++j)
    for (Eigen::Index i = j; i < columns; ++i)
      L(i, j) = m.elimination->At(m.factor, column[static_cast<size_t>(i)],
                                  column[static_cast<size_t>(j)]);
  Eigen::MatrixXd ordered = L * L.transpose();
  ordered.bottomRightCorner(columns - inner, columns - inner) += m.factor.rbegin()->second.H;
  const Eigen::MatrixXd C = ordered.llt().solve(Eigen::MatrixXd::Identity(columns, columns));
  Eigen::MatrixXd inverse(columns, columns);
  for (Eigen::Index i = 0; i < columns; ++i)
    for (Eigen::Index j = 0; j < columns; ++j)
      inverse(column[static_cast<size_t>(i)], column[static_cast<size_t>(j)]) = C(i, j);
  return inverse;
}

}  // namespace imu_pose_calib
