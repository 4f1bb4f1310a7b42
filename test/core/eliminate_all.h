#pragma once

#include <utility>
#include <vector>

#include "imu_pose_calib/core/solver/elimination.h"

namespace imu_pose_calib {

/// Eliminates all that is not the border, window by window; `shared` takes what windows share.
inline Reduced EliminateAll(const Elimination& elimination, const Eigen::VectorXd& weights,
                            bool keeps, std::vector<Panels>* windows, Panels* shared) {
  std::vector<Rest> rests;
  std::vector<const Rest*> parts;
  for (size_t w = 0; w < windows->size(); ++w)
    rests.push_back(
        elimination.EliminateWindow(static_cast<int>(w), weights, keeps, &(*windows)[w]));
  for (const Rest& rest : rests) parts.push_back(&rest);
  return elimination.Reduce(parts, weights, keeps, shared);
}

}  // namespace imu_pose_calib
