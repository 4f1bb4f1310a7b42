#pragma once

/// Room core/pose_sensor: where a further source of poses sits on the body (doc/math.md, "Pose
/// sensors").
/// In: the marker's motion in each session, as solved or of the poses alone, and the poses T_VS of
/// one sensor. Out: PoseSensorCalibration. Changes no other estimate.

#include <memory>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/calibration/solution.h"

namespace imu_pose_calib {

/// Calibrates a pose sensor against the marker of the solution; `poses`: of each session, empty
/// where it lacks the sensor. Throws DataError when the poses cannot be used or turn otherwise than
/// the marker.
PoseSensorCalibration CalibratePoseSensor(const CalibrationOptions& options,
                                          const std::shared_ptr<const Solution>& solution,
                                          const std::vector<std::vector<PoseSample>>& poses);

}  // namespace imu_pose_calib
