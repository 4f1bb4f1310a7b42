#pragma once

#include <chrono>
#include <functional>
#include <future>
#include <mutex>
#include <string>

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

  /// `on_result` is called, with the mutex held, when there is another result to use. The end of
  /// the object waits for the solve that is running, without the mutex.
  LiveSolver(std::mutex* mutex, LiveCalibration* live, const Solve& solve,
             const std::function<void()>& on_result)
      : mutex_(mutex), live_(live), solve_(solve), on_result_(on_result) {}
  LiveSolver(const LiveSolver&) = delete;
  LiveSolver& operator=(const LiveSolver&) = delete;

  /// Begins to solve what is there now, unless a solve is running.
  void Start();
  double SolveTime() const;                                    ///< of the one running; 0: none [s]
  double last_solve_time() const { return last_solve_time_; }  ///< 0: none has ended yet [s]

  /// Solves what is there now, or waits for the solve that is running if that is of data since the
  /// last reset. No success when a reset comes meanwhile. Locks the mutex itself.
  Verdict Calibrate();

 private:
  Verdict Run(const SessionData& data);
  double SecondsSinceStart() const;

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
