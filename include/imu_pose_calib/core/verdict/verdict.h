#pragma once

/// Room core/verdict: how sure the result is, in numbers and words (S5).
/// In: Marginals and prepared sessions. Out: sigmas, observability, status, message and warnings of
/// a Calibration, agreement of halves and sessions. Changes no estimate.

#include <string>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/calibration/marginals.h"
#include "imu_pose_calib/core/start/preparation.h"

namespace imu_pose_calib {

// --- Grades ---

/// T_FS of two frames of the body, IMUs or pose sensors, whose places in the rig are 0. Covariances
/// are those of (p_MF, R_MF) and (p_MS, R_MS), rotations about the axes of F and S; `cross` is that
/// of the one with the other.
BetweenImus Between(const Rigid3& T_MF, const Matrix6d& covariance_F, const Rigid3& T_MS,
                    const Matrix6d& covariance_S, const Matrix6d& cross = Matrix6d::Zero());

/// Adds the principal directions of a 3x3 covariance, each with its sigma; none for 0.
void AddDirections(const Eigen::Matrix3d& C, const std::string& name, const std::string& frame,
                   const std::string& unit, std::vector<Observability>* spectrum);

/// Gives each direction its status and sorts them, the worst first. Returns the status of all, and
/// one sentence of it.
Status GradeSpectrum(const CalibrationOptions& options, std::vector<Observability>* spectrum,
                     std::string* message);

/// Stage S5: fills covariances, sigmas, observability, split halves, status and message, and warns
/// of correlated residuals and a long accel_delay: signs that the model does not fit the data.
void GradeResult(const CalibrationOptions& options, const Marginals& marginals,
                 Calibration* result);

// --- Sessions and halves ---

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

// --- Doubts ---

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
