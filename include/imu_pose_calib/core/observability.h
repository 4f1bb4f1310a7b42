#pragma once

#include <string>

#include "imu_pose_calib/core/conditioning.h"
#include "imu_pose_calib/core/marginals.h"
#include "imu_pose_calib/core/options.h"
#include "imu_pose_calib/core/pose_trajectory.h"
#include "imu_pose_calib/core/result.h"

namespace imu_pose_calib {

/// How the marker turns: principal axes of its mean-free rate, the trajectory's own variance
/// subtracted.
struct TurnExcitation {
  Eigen::Vector3d rate_std;  ///< [rad/s] about each axis, largest first; 0 when within the noise
  Eigen::Matrix3d axes_M;    ///< columns: the axes in M
};
TurnExcitation MeasureTurns(const PoseTrajectory& trajectory, const ConditionedData& data);

/// Without turns about two axes no solve can tell the lever arm or the rotation.
class DegenerateMotion : public DataError {
 public:
  DegenerateMotion(const std::string& message, const std::string& unobservable)
      : DataError(message), unobservable(unobservable) {}
  std::string unobservable;  ///< the direction in words
};

/// Throws DegenerateMotion unless the motion suffices.
void CheckTurns(const TurnExcitation& turns);

/// Stage S5: fills covariances, sigmas, observability, split halves, status and message.
void GradeResult(const CalibrationOptions& options,
                 const Marginals& marginals,
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
void JudgeAgreement(Calibration* result);

/// "123.4 mm", "0.1234 deg" or "0.1234 ms" of a value in m, rad or s.
std::string InWords(double value, const std::string& unit);
/// By a format of printf for one double, such as "%.1f sigma"; 31 characters at most.
std::string Number(double value, const char* format = "%.4g");

}  // namespace imu_pose_calib
