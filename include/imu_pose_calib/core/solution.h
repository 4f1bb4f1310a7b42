#pragma once

#include <vector>

#include "imu_pose_calib/core/correction_splines.h"
#include "imu_pose_calib/core/marginals.h"

namespace imu_pose_calib {

/// What comes out of a solve beside the estimate.
struct Solution {
  std::vector<SensorModel> models;  ///< noise and weights of the last pass
  std::vector<SensorStatistics> statistics;
  std::vector<SensorResiduals> residuals;  ///< where the solve ended
  std::vector<CorrectionSplines> splines;  ///< of each session; none when they are not estimated
  Marginals marginals;
};

}  // namespace imu_pose_calib
