#pragma once

#include <memory>
#include <vector>

#include "imu_pose_calib/core/calibration/correction_splines.h"
#include "imu_pose_calib/core/calibration/marginals.h"

namespace imu_pose_calib {

/// What comes out of a solve: all of it belongs together, since the last step moves everything.
struct Solution {
  std::vector<SensorModel> models;  ///< noise and weights of the last pass
  std::vector<SensorStatistics> statistics;
  std::vector<SensorResiduals> residuals;  ///< where the solve ended
  std::vector<CorrectionSplines> splines;  ///< of each session; none when they are not estimated
  Marginals marginals;
  int iterations = 0;       ///< of all passes
  bool has_settled = true;  ///< noise and weights agree with the residuals

  // What it was solved from and for:
  Estimate estimate;
  std::vector<std::shared_ptr<const PoseTrajectory>> trajectories;  ///< of S1, of each session
  std::vector<int64_t> pose_epochs_ns;                              ///< of each session
  std::vector<std::vector<ConditionedImu>> imus;  ///< samples of each session's IMUs
};

}  // namespace imu_pose_calib
