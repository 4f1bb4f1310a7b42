#pragma once

#include <chrono>
#include <condition_variable>
#include <functional>
#include <mutex>
#include <string>
#include <thread>

#include "imu_pose_calib/ros/live/live_calibration.h"

namespace imu_pose_calib {

/// Runs the solves of a LiveCalibration, one at a time, on a thread of its own. Knows no ROS.
///
/// `mutex` guards the LiveCalibration and this. Nobody holds it during a solve; all but Calibrate()
/// are called with it held.
class LiveSolver {
 public:
  using Solve = std::function<Calibration(const SessionData&)>;
  struct Verdict {
    bool success = false;
    std::string message;
  };

  /// `on_result` is called, with the mutex held, when there is another result to use.
  LiveSolver(std::mutex* mutex, LiveCalibration* live, const Solve& solve,
             const std::function<void()>& on_result);
  /// Waits for the solve that is running. The mutex is not held.
  ~LiveSolver();
  LiveSolver(const LiveSolver&) = delete;
  LiveSolver& operator=(const LiveSolver&) = delete;

  /// Begins to solve what is there now, unless a solve is running.
  void Start();
  bool IsSolving() const { return is_solving_; }
  double SolveTime() const;                                    ///< of the one running; 0: none [s]
  double last_solve_time() const { return last_solve_time_; }  ///< 0: none has ended yet [s]

  /// Solves what is there now, or waits for the solve that is running if that is of data since the
  /// last reset. No success when a reset comes meanwhile. Locks the mutex itself.
  Verdict Calibrate();

 private:
  using Clock = std::chrono::steady_clock;
  void Run();
  double SecondsSinceStart() const;
  /// The data of the last solve have been forgotten.
  bool IsStale() const { return resets_ != live_->resets(); }

  std::mutex* const mutex_;
  LiveCalibration* const live_;
  const Solve solve_;
  const std::function<void()> on_result_;

  std::condition_variable changed_;  ///< one of the following
  bool is_ending_ = false;
  bool is_solving_ = false;
  size_t started_ = 0, ended_ = 0;  ///< counts of solves
  size_t forgotten_ = 0;            ///< the last one that ended with its data forgotten
  SessionData data_;                ///< of the next solve
  size_t resets_ = 0;               ///< of live_, when the last solve began
  Clock::time_point start_;         ///< of the last solve
  double last_solve_time_ = 0.0;    ///< [s]
  Verdict verdict_;                 ///< of the last solve

  std::thread thread_;  ///< the last member: it uses all of the others
};

}  // namespace imu_pose_calib
