#pragma once

#include <array>
#include <boost/noncopyable.hpp>
#include <chrono>
#include <deque>
#include <functional>
#include <future>
#include <limits>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "imu_pose_calib/CalibrationStatus.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/text.h"

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
};

/// All of them, by their names.
constexpr std::pair<const char*, double LiveOptions::*> kLiveOptions[] = {
    {"window", &LiveOptions::window},
    {"min_duration", &LiveOptions::min_duration},
    {"solve_interval", &LiveOptions::solve_interval},
    {"lost_timeout", &LiveOptions::lost_timeout},
    {"target_rotation_std", &LiveOptions::target_rotation_std},
    {"target_translation_std", &LiveOptions::target_translation_std},
    {"target_time_shift_std", &LiveOptions::target_time_shift_std}};

struct StreamStatus {
  size_t received = 0;      ///< since construction
  double buffered_s = 0.0;  ///< first to last sample kept [s]
  double rate_hz = 0.0;     ///< of the last two seconds
  double delay_s = 0.0;     ///< arrival - stamp of the last sample [s]
};

/// Keeps the newest samples, tells when a solve is worthwhile and what to move next, and judges the
/// results. Knows no nodes, no threads and no clock: the caller says when something happens (`now`
/// [s]) and solves.
///
///   live.AddPose(pose, now);  // and AddGyro(), AddAccel(), as samples arrive
///   if (live.WantsSolve()) result = Calibrate(options, live.BeginSolve());  // on another thread
///   live.EndSolve(result);
class LiveCalibration {
 public:
  /// `calibration` tells how the poses are to be understood: unit and direction. `imus`: how many
  /// there are on the body. `pose_sensors`: their names. Throws InputError naming an option out of
  /// range, value and bound.
  explicit LiveCalibration(const LiveOptions& options,
                           const CalibrationOptions& calibration = CalibrationOptions(),
                           size_t imus = 1, const std::vector<std::string>& pose_sensors = {});

  /// Samples in the order of arrival. A stamp that jumps, or `now` that goes back, starts anew:
  /// the old data and result belong to another clock.
  /// `source` of poses: 0 is the marker, then come the pose sensors. Nothing waits for these; when
  /// the stamps of one jump, only its own poses are forgotten.
  /// True when the pose is one of the marker, valid, and differs from the one before.
  bool AddPose(const PoseSample& recorded, double now, size_t source = 0);
  void AddGyro(const ImuSample& sample, double now, size_t imu = 0);
  void AddAccel(const ImuSample& sample, double now, size_t imu = 0);
  bool HasPoses(size_t source) const { return !poses_[source].samples.empty(); }
  bool LacksSensor() const;  ///< some pose sensor has no poses

  /// There is enough motion, enough of it is new, and no solve is running.
  bool WantsSolve() const;
  /// What is in the buffers, for Calibrate().
  SessionData BeginSolve();
  /// True when `result` is the one to use from now on: no result so far was clearly more precise.
  /// One that is not usable tells why. A result of data from before a reset is ignored.
  bool EndSolve(const Calibration& result);
  bool IsSolving() const { return is_solving_; }
  /// A solve is running whose data have been forgotten.
  bool IsStale() const { return is_stale_; }

  /// Forgets data and results; a reason that is not empty is shown for a while.
  void Reset(const std::string& reason, double now);
  /// Has each reset, asked for or not, call `forget` when the data are gone.
  void OnReset(const std::function<void()>& forget) { on_reset_ = forget; }
  /// No more solves and no more resets but Reset(); `message` tells where the result was saved.
  void Freeze(const std::string& message) { known_.frozen = message; }
  bool IsFrozen() const { return !known_.frozen.empty(); }

  /// All but the stamp and the time of the running solve.
  CalibrationStatus Status(double now) const;
  /// Poses, gyroscope and accelerometer; of several IMUs, the slowest.
  std::array<StreamStatus, 3> Streams() const;
  /// Turning about the marker axes, then motion along them, from 0 to 1, which is enough for a
  /// calibration: 3 s at 1 rad/s rms and 0.3 m/s rms, or slower and longer.
  Vector6d Excitation() const;
  /// The result to use, of those since the last reset.
  const std::optional<Calibration>& result() const { return known_.result; }
  /// Newest valid pose T_WM [m].
  const std::optional<PoseSample>& pose() const { return known_.pose; }
  /// Valid poses of the window, thinned out.
  const std::deque<PoseSample>& path() const { return known_.path; }

 private:
  template <typename Sample>
  struct Stream {
    std::string name;  ///< for people
    std::deque<Sample> samples;
    size_t received = 0, unstamped = 0;
    double arrival = 0.0;  ///< `now` of the last sample [s]

    StreamStatus Status() const;
    /// [s]
    double Duration() const {
      return samples.empty() ? 0.0 : Seconds(samples.back().t_ns - samples.front().t_ns);
    }
    /// Its name and what is the matter with its stamps.
    std::string Missing() const {
      return name + (unstamped > 0 ? " with header stamps (all are 0)" : "");
    }
    /// Empty, or how the clock has jumped when `sample` comes.
    std::string FindJump(const Sample& sample, double now) const;
    /// Lets go of what is older than `window` [s], and of too many.
    void Trim(double window, double now);
  };
  /// What a reset forgets beside the samples.
  struct Knowledge {
    std::optional<PoseSample> pose;
    std::deque<PoseSample> path;
    int64_t solved_until_ns = 0;  ///< newest pose of the last solve; 0: none
    size_t solves = 0;
    std::string failure;           ///< of the last solve
    std::deque<Calibration> last;  ///< results of the last solves, at most three
    std::optional<Calibration> result;
    /// Of the results so far; 1: all targets just reached.
    double best_score = std::numeric_limits<double>::infinity();
    std::string frozen;
  };

  template <typename Sample>
  bool Add(const Sample& sample, double now, Stream<Sample>* stream, bool resets = true);

  bool IsConverged() const;
  std::string MissingStreams() const;
  std::string LostStreams(double now) const;
  std::string SensorNotes(double now) const;
  std::string Advice() const;
  std::pair<uint8_t, std::string> PhaseAndMessage(double now) const;

  const LiveOptions options_;
  const CalibrationOptions calibration_;
  std::vector<Stream<PoseSample>> poses_;   ///< of the marker, then of the pose sensors
  std::vector<Stream<ImuSample>> sensors_;  ///< gyroscope and accelerometer of each IMU in turn
  double pose_changed_ = 0.0;               ///< `now` of the last pose that was valid and new [s]
  Knowledge known_;

  std::function<void()> on_reset_ = [] {};
  bool is_solving_ = false, is_stale_ = false;  ///< see IsStale()
  std::string notice_;                          ///< reason of the last reset
  double notice_time_ = 0.0;
};

/// Runs the solves of a LiveCalibration, one at a time, on a thread of its own. Knows no ROS.
///
/// `mutex` guards the LiveCalibration and this. Nobody holds it during a solve; all but Calibrate()
/// are called with it held.
class LiveSolver : boost::noncopyable {
 public:
  using Solve = std::function<Calibration(const SessionData&)>;
  struct Verdict {
    bool success = false;
    std::string message;
  };

  /// `on_result` is called, with the mutex held, when there is another result to use. The end of
  /// the object waits for the solve that is running, without the mutex.
  LiveSolver(std::mutex* mutex, LiveCalibration* live, const Solve& solve,
             const std::function<void()>& on_result)
      : mutex_(mutex), live_(live), solve_(solve), on_result_(on_result) {}

  /// Begins to solve what is there now, unless a solve is running.
  void Start();
  double SolveTime() const;                                    ///< of the one running; 0: none [s]
  double last_solve_time() const { return last_solve_time_; }  ///< 0: none has ended yet [s]

  /// Solves what is there now, or waits for the solve that is running if that is of data since the
  /// last reset. No success when a reset comes meanwhile. Locks the mutex itself.
  Verdict Calibrate();

 private:
  Verdict Run(const SessionData& data);

  std::mutex* const mutex_;
  LiveCalibration* const live_;
  const Solve solve_;
  const std::function<void()> on_result_;

  std::chrono::steady_clock::time_point start_;  ///< of the last solve
  double last_solve_time_ = 0.0;                 ///< [s]
  /// Of the last solve. The last member: its thread uses all of the others.
  std::shared_future<Verdict> verdict_;
};

}  // namespace imu_pose_calib
