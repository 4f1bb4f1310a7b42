#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <numeric>
#include <vector>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/calibration/marginals.h"

namespace imu_pose_calib {

/// All of H^-1 of a solve by its elements where the factor of H has any: as they are where the rest
/// of H is 0.
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
  std::vector<int> columns;  // by place
  for (const int block : order)
    for (int k = 0; k < size[static_cast<size_t>(block)]; ++k)
      columns.push_back(first[static_cast<size_t>(block)] + k);
  Eigen::MatrixXd inverse = Eigen::MatrixXd::Zero(m.elimination->columns(), columns.size());
  std::vector<int> later;
  for (; !columns.empty(); columns.pop_back()) {
    const int own = columns.back();
    std::vector<int> acting;  // of those eliminated later, given which others tell nothing of it
    for (const int other : later)
      if (m.elimination->At(m.inverse.get(), other, own) != 0.0) acting.push_back(other);
    const auto count = static_cast<Eigen::Index>(acting.size());
    Eigen::MatrixXd C(count, count), with(inverse.rows(), count);
    Eigen::VectorXd known(count);
    for (Eigen::Index j = 0; j < count; ++j) {
      const int of = acting[static_cast<size_t>(j)];
      with.col(j) = inverse.col(of);
      known[j] = m.elimination->At(m.inverse.get(), of, own);
      for (Eigen::Index i = 0; i < count; ++i)
        C(i, j) = inverse(acting[static_cast<size_t>(i)], of);
    }
    const Eigen::VectorXd found = with * SolvePositive(C, known);
    for (const int other : later) inverse(other, own) = inverse(own, other) = found[other];
    inverse(own, own) = m.elimination->At(m.inverse.get(), own, own);
    later.push_back(own);
  }
  return inverse;
}

}  // namespace imu_pose_calib
