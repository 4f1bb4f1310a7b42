#include "imu_pose_calib/core/calibration/residuals.h"

#include <ceres/autodiff_cost_function.h>

namespace imu_pose_calib {
namespace {

/// A cost function that copies `residual`; sizes: of the residual, and of its blocks.
template <int... sizes, typename Residual>
std::unique_ptr<ceres::CostFunction> AutoDiff(const Residual& residual) {
  return std::make_unique<ceres::AutoDiffCostFunction<Residual, sizes...>>(new Residual(residual));
}

}  // namespace

std::unique_ptr<ceres::CostFunction> GyroResidual::Create() const {
  return AutoDiff<3, 4, 3, 3, 1>(*this);
}

std::unique_ptr<ceres::CostFunction> AccelResidual::Create() const {
  return AutoDiff<3, 4, 3, 3, 3, 3, 1, 1>(*this);
}

std::unique_ptr<ceres::CostFunction> GravityPrior::Create() const { return AutoDiff<1, 3>(*this); }

template <int kSize>
std::unique_ptr<ceres::CostFunction> WalkResidual<kSize>::Create() const {
  return AutoDiff<kSize, kSize, kSize>(*this);
}

std::unique_ptr<ceres::CostFunction> JerkResidual::Create() const {
  return AutoDiff<3, 3, 3, 3, 3>(*this);
}

template struct WalkResidual<1>;
template struct WalkResidual<3>;

}  // namespace imu_pose_calib
