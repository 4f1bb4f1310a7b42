#pragma once

#include <array>
#include <deque>
#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// How a live calibration collects and when it is done; the names are those of the parameters.
struct LiveOptions {
  double window = 60.0;         ///< [s] of the newest data are kept and calibrated from
  double min_duration = 10.0;   ///< [s] of every stream before the first solve
  double solve_interval = 5.0;  ///< [s] of new poses between two solves
  double lost_timeout = 1.0;    ///< [s] of silence after which a stream is lost
  /// Converged when the largest sigma over the axes is below these.
  double target_rotation_std = 2e-3;     ///< [rad]
  double target_translation_std = 5e-4;  ///< [m]
  double target_time_shift_std = 5e-4;   ///< [s]

  /// All of them, by their names.
  struct Field {
    const char* name;
    double LiveOptions::*value;
  };
  static const std::array<Field, 7> kFields;

  /// Throws InputError naming parameter, value and bound when a value is out of range.
  void Validate() const;
};

/// What a live calibration is doing; see msg/CalibrationStatus.msg.
enum class Phase { kWaiting, kCollecting, kSolving, kConverged, kDegraded, kSaved };

/// "waiting", "collecting", ...
const char* ToString(Phase phase);

/// Motion along the marker axes from 0 to 1, which is enough for a calibration: 3 s of turning at
/// 1 rad/s rms and of moving at 0.3 m/s rms, or slower and longer.
struct Excitation {
  Eigen::Vector3d rotation = Eigen::Vector3d::Zero();
  Eigen::Vector3d translation = Eigen::Vector3d::Zero();
};

struct StreamStatus {
  size_t received = 0;      ///< since construction
  double buffered_s = 0.0;  ///< first to last sample kept [s]
  double rate_hz = 0.0;     ///< of the last two seconds
  double delay_s = 0.0;     ///< arrival - stamp of the last sample [s]
};

struct LiveStatus {
  Phase phase = Phase::kWaiting;
  std::string message;              ///< one sentence for people
  StreamStatus poses, gyro, accel;  ///< of several IMUs, the slowest
  Excitation excitation;
  size_t solves = 0;  ///< since the last reset
};

/// Largest sigma over the axes.
struct LargestStd {
  double rotation, translation, time_shift;  ///< [rad] [m] [s]
};
LargestStd MaxStd(const Calibration& result);

/// Keeps the newest samples, tells when a solve is worthwhile and what to move next, and judges the
/// results. Knows no ROS, no threads and no clock: the caller says when something happens (`now`
/// [s]) and solves.
///
///   live.AddPose(pose, now);  // and AddGyro(), AddAccel(), as samples arrive
///   if (live.WantsSolve()) result = Calibrate(options, live.BeginSolve());  // on another thread
///   live.EndSolve(result);  // or live.FailSolve(error.what())
class LiveCalibration {
 public:
  /// `calibration` tells how the poses are to be understood: unit and direction. `imus`: how many
  /// there are on the body.
  explicit LiveCalibration(const LiveOptions& options,
                           const CalibrationOptions& calibration = CalibrationOptions(),
                           size_t imus = 1);

  /// Samples in the order of arrival. A stamp that jumps, or `now` that goes back, starts anew:
  /// the old data and result belong to another clock.
  /// True when the pose is valid and differs from the one before.
  bool AddPose(const PoseSample& recorded, double now);
  void AddGyro(const ImuSample& sample, double now, size_t imu = 0);
  void AddAccel(const ImuSample& sample, double now, size_t imu = 0);

  /// There is enough motion, enough of it is new, and no solve is running.
  bool WantsSolve() const;
  /// What is in the buffers, for Calibrate().
  SessionData BeginSolve();
  /// True when `result` is the one to use from now on: no result so far was clearly more precise.
  /// A result of data from before a reset is ignored.
  bool EndSolve(const Calibration& result);
  void FailSolve(const std::string& reason);

  /// Forgets data and results; a reason that is not empty is shown for a while.
  void Reset(const std::string& reason, double now);
  /// No more solves and no more resets but Reset(); `message` tells where the result was saved.
  void Freeze(const std::string& message);

  bool IsFrozen() const { return !frozen_.empty(); }
  /// Counts the resets, asked for or not.
  size_t resets() const { return resets_; }

  LiveStatus Status(double now) const;
  /// The result to use, of those since the last reset.
  const std::optional<Calibration>& result() const { return result_; }
  /// Newest valid pose T_WM [m].
  const std::optional<PoseSample>& pose() const { return pose_; }
  /// Valid poses of the window, thinned out.
  const std::deque<PoseSample>& path() const { return path_; }

 private:
  template <typename Sample>
  struct Stream {
    std::string name;  ///< for people
    std::deque<Sample> samples;
    size_t received = 0, unstamped = 0;
    double arrival = 0.0;  ///< `now` of the last sample [s]

    StreamStatus Status() const;
    double Duration() const;  ///< [s]
  };
  struct Imu {
    Stream<ImuSample> gyro, accel;
  };
  /// Squared rates in the marker frame, times the time between two poses.
  struct Motion {
    int64_t t_ns = 0;
    Eigen::Vector3d rotation = Eigen::Vector3d::Zero();     ///< [rad^2/s]
    Eigen::Vector3d translation = Eigen::Vector3d::Zero();  ///< [m^2/s]
  };

  template <typename Sample>
  bool Add(const Sample& sample, double now, Stream<Sample>* stream);
  template <typename Sample>
  std::string FindJump(const Sample& sample, double now, const Stream<Sample>& stream) const;
  void MeasureMotion(const PoseSample& pose);
  void ExtendPath(const PoseSample& pose);
  Excitation Excited() const;

  bool IsConverged() const;
  std::string MissingStreams() const;
  std::string LostStreams(double now) const;
  std::string Advice() const;

  const LiveOptions options_;
  const CalibrationOptions calibration_;
  Stream<PoseSample> poses_{"poses", {}};
  std::vector<Imu> imus_;

  std::optional<PoseSample> pose_;
  std::deque<PoseSample> path_;
  double pose_changed_ = 0.0;  ///< `now` of the last pose that was valid and new [s]

  std::deque<Motion> motion_;
  Motion total_;  ///< sum of motion_
  std::optional<PoseSample> motion_from_;

  bool is_solving_ = false, is_stale_ = false;
  int64_t solved_until_ns_ = 0;  ///< newest pose of the last solve; 0: none
  size_t solves_ = 0;
  std::string failure_;           ///< of the last solve
  std::deque<Calibration> last_;  ///< results of the last solves, at most three
  std::optional<Calibration> result_;
  double best_score_ = 0.0;  ///< of the results so far; 1: all targets just reached

  size_t resets_ = 0;
  std::string notice_;  ///< reason of the last reset
  double notice_time_ = 0.0;
  std::string frozen_;
};

}  // namespace imu_pose_calib
