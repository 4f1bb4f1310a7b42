#pragma once

#include <vector>

#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/calibration/marginals.h"
#include "imu_pose_calib/core/start/preparation.h"

namespace imu_pose_calib {

/// The marginals with sigmas that cover half of what the halves differ by, if they disagree: then
/// the recording shows more scatter than its residuals do.
Marginals CoverHalves(Marginals marginals);

/// Makes a graded result `weak`, and says why, where what the solve found cannot be right though
/// every sigma is small: motion in a moment only, halves that disagree, poses that are ignored, a
/// source of poses as there is none, motion that method gp has lost, a solve that has not settled
/// (doc/math.md, "Doubts").
void DoubtResult(const std::vector<PreparedSession>& sessions, bool has_settled,
                 Calibration* result);

}  // namespace imu_pose_calib
