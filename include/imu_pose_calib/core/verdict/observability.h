#pragma once

/// Room core/verdict: how sure the result is, in numbers and words (S5).
/// In: Marginals and prepared sessions. Out: sigmas, observability, status, message and warnings of
/// a Calibration, agreement of halves and sessions. Changes no estimate.

#include <string>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/calibration/marginals.h"
#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/core/trajectory/pose_trajectory.h"

namespace imu_pose_calib {

/// Stage S5: fills covariances, sigmas, observability, split halves, status and message.
void GradeResult(const CalibrationOptions& options, const Marginals& marginals,
                 Calibration* result);

/// Adds a warning in words for each sign that the model does not fit the data: correlated
/// residuals, drifting clocks, wrong scales, a long accel_delay.
void WarnOfMisfit(const Marginals& marginals, Calibration* result);

/// The marginals with sigmas that cover half of what the halves differ by, if they disagree: then
/// the recording shows more scatter than its residuals do.
Marginals CoverHalves(Marginals marginals);

/// Makes a graded result `weak`, and says why, where what the solve found cannot be right though
/// every sigma is small: halves that disagree, poses that are ignored, a source of poses as there
/// is none, motion that method gp has lost (doc/math.md, "Doubts").
void DoubtResult(const std::vector<PreparedSession>& sessions, Calibration* result);

/// Compares what each session says alone with the common estimate, which `result` holds: fills
/// `own` and `agreement` of the sessions (doc/math.md, S5, "Sessions"). Where they scatter more
/// than their sigmas say, the robust covariance of what is returned is larger by as much.
Marginals CompareSessions(Marginals marginals, Calibration* result);

/// After the grading: sessions that disagree make an `ok` result `weak`, and the message names the
/// one that stands out.
void TestSessionAgreement(Calibration* result);

}  // namespace imu_pose_calib
