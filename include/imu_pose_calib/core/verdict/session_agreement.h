#pragma once

#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/calibration/marginals.h"

namespace imu_pose_calib {

/// Sessions and halves of a recording agree when no component differs by more than this many sigma;
/// AGREEMENT of scripts/comparison.py is the same for calibrations.
constexpr double kAgreementBound = 5.0;

/// Compares what each session says alone with the common estimate, which `result` holds: fills
/// `own` and `agreement` of the sessions (doc/math.md, S5, "Sessions"). Where they scatter more
/// than their sigmas say, the robust covariance of what is returned is larger by as much.
Marginals CompareSessions(Marginals marginals, Calibration* result);

/// After the grading: sessions that disagree make an `ok` result `weak`, and the message names the
/// one that stands out, of a degenerate result, too.
void TestSessionAgreement(Calibration* result);

}  // namespace imu_pose_calib
