#include "imu_pose_calib/ros/live/live_solver.h"

#include <optional>
#include <utility>

#include "imu_pose_calib/ros/offline/offline.h"

namespace imu_pose_calib {

void LiveSolver::Start() {
  if (live_->IsSolving()) return;
  start_ = std::chrono::steady_clock::now();
  verdict_ = std::async(std::launch::async, [this, data = live_->BeginSolve()]() mutable {
               return Run(std::exchange(data, {}));  // the samples go with the solve
             }).share();
}

double LiveSolver::SecondsSinceStart() const {
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count();
}

double LiveSolver::SolveTime() const { return live_->IsSolving() ? SecondsSinceStart() : 0.0; }

LiveSolver::Verdict LiveSolver::Calibrate() {
  std::unique_lock<std::mutex> lock(*mutex_);
  // A solve cannot be interrupted, and one of forgotten data is no answer.
  while (live_->IsStale()) {
    const auto stale = verdict_;
    lock.unlock();
    stale.wait();
    lock.lock();
  }
  Start();
  const auto verdict = verdict_;
  lock.unlock();
  return verdict.get();
}

LiveSolver::Verdict LiveSolver::Run(const SessionData& data) {
  std::optional<Calibration> result;
  std::string error;
  try {
    result = solve_(data);
  } catch (const std::exception& exception) {
    error = OneLine(exception);
  }
  const std::lock_guard<std::mutex> lock(*mutex_);
  last_solve_time_ = SecondsSinceStart();
  const bool is_stale = live_->IsStale();
  if (!result)
    live_->FailSolve(error);
  else if (live_->EndSolve(*result))
    on_result_();
  if (is_stale) return {false, "the data were forgotten during the solve: call again"};
  if (!result) return {false, error};
  return {result->IsUsable(), std::string(ToString(result->status)) + ": " + result->message};
}

}  // namespace imu_pose_calib
