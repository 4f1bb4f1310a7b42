#pragma once

#include <array>
#include <string>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/core/start/initializer.h"
#include "imu_pose_calib/core/trajectory/pose_trajectory.h"

namespace imu_pose_calib {

/// "marker z", or "(0.71, 0.00, 0.71) in the marker frame" when no axis is within 20 degrees.
std::string DescribeAxis(const Eigen::Vector3d& direction, const std::string& frame);

/// What to do about motion that does not suffice.
constexpr const char* kTurnAdvice = "turn the marker about at least two axes";

/// Without turns about two axes no solve can tell the lever arm or the rotation.
class DegenerateMotion : public DataError {
 public:
  DegenerateMotion(const std::string& message, const std::string& unobservable)
      : DataError(message), unobservable(unobservable) {}
  std::string unobservable;  ///< the direction in words
};

/// The stamps and values of one sensor. Shares are 0..1; jitter, bunches and cut are of the stamps
/// as recorded.
struct StreamCheck {
  size_t count = 0;
  double duration_s = 0.0;        ///< first to last stamp
  double rate_hz = 0.0;           ///< 1 / median period
  double jitter_s = 0.0;          ///< robust sigma of the periods
  double longest_gap_s = 0.0;     ///< longest period
  double bunched = 0.0;           ///< within a quarter of a period after the sample before
  double missing = 0.0;           ///< of the samples that rate and duration promise
  double repeated = 0.0;          ///< same value as the sample before
  double longest_freeze_s = 0.0;  ///< longest time without a new value
  double cut_s = 0.0;             ///< uneven stamps are multiples of it; 0: of nothing coarse
  StreamReport report;            ///< what S0, and S1 of poses, would make of them
};

enum class DataVerdict { kGood, kUsable, kRecordAgain };
inline const char* ToString(DataVerdict verdict) {
  return std::array{"good", "usable", "record again"}[static_cast<size_t>(verdict)];
}

/// The same of one IMU.
struct ImuCheck {
  StreamCheck gyro, accel;

  double rest_s = 0.0;     ///< how long the IMU rested
  double rest_norm = 0.0;  ///< [m/s^2] of the accelerometer meanwhile

  bool is_matched = false;  ///< both streams show the same motion; what follows is set
  double explained = 0.0;   ///< share of the gyroscope's variance that the poses explain
  double time_shift = 0.0;  ///< [s] about, t_pose = t_imu + time_shift
  double overlap_s = 0.0;   ///< that both clocks have in common
  double drift_ppm = 0.0;   ///< growth of the time shift
  double drift_ppm_std = 0.0;
};

/// What a recording is worth, found without calibrating.
struct DataCheck {
  DataVerdict verdict = DataVerdict::kRecordAgain;
  /// The reason in one line.
  std::string message;
  std::vector<std::string> warnings;

  StreamCheck poses;
  size_t segments = 0, gaps = 0, jumps = 0;

  /// Rms per axis about the mean: rate about the marker axes, acceleration along the world axes.
  Eigen::Vector3d turns_M = Eigen::Vector3d::Zero();      ///< [rad/s]
  Eigen::Vector3d moves_W = Eigen::Vector3d::Zero();      ///< [m/s^2]
  std::vector<ImuCheck> imus = std::vector<ImuCheck>(1);  ///< in the order of the rig
};

/// Checks of the samples before S0: rates, stamps, repetitions. `session` is `recorded` after
/// RecoverStamps(), which gave `stamps`. Throws DataError when most samples of a stream come in
/// bunches for which no clock was found: when they were taken cannot be told.
void CheckStreams(const SessionData& recorded, const SessionData& session,
                  const SessionStamps& stamps, DataCheck* check);

/// Checks of what S0 and S1 made of them: what was dropped, rest, excitation. Throws
/// DegenerateMotion unless the marker turns about two axes, where it `must_turn`, by the principal
/// axes of its mean-free rate, the trajectory's own variance subtracted.
void CheckMotion(const CalibrationOptions& options, const ConditionedData& data,
                 const PoseTrajectory& trajectory, bool must_turn, DataCheck* check);

/// Checks that poses and an IMU fit each other at the start found in S2: overlap, and clocks that
/// drift where no drift is estimated.
void CheckMatch(const CalibrationOptions& options, const ConditionedData& data,
                const PoseTrajectory& trajectory, const Start& start, size_t imu, DataCheck* check);

}  // namespace imu_pose_calib
