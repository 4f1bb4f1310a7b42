#include "imu_pose_calib/ros/live/live_solver.h"

#include <optional>
#include <utility>

#include "imu_pose_calib/ros/offline/offline.h"

namespace imu_pose_calib {
namespace {

const LiveSolver::Verdict kForgotten = {false,
                                        "the data were forgotten during the solve: call again"};

}  // namespace

LiveSolver::LiveSolver(std::mutex* mutex, LiveCalibration* live, const Solve& solve,
                       const std::function<void()>& on_result)
    : mutex_(mutex), live_(live), solve_(solve), on_result_(on_result), thread_([this] {
        Run();
      }) {}

LiveSolver::~LiveSolver() {
  {
    const std::lock_guard<std::mutex> lock(*mutex_);
    is_ending_ = true;
  }
  changed_.notify_all();
  thread_.join();
}

void LiveSolver::Start() {
  if (is_solving_) return;
  is_solving_ = true;
  ++started_;
  start_ = Clock::now();
  resets_ = live_->resets();
  data_ = live_->BeginSolve();
  changed_.notify_all();
}

double LiveSolver::SecondsSinceStart() const {
  return std::chrono::duration<double>(Clock::now() - start_).count();
}

double LiveSolver::SolveTime() const { return is_solving_ ? SecondsSinceStart() : 0.0; }

LiveSolver::Verdict LiveSolver::Calibrate() {
  std::unique_lock<std::mutex> lock(*mutex_);
  // A solve cannot be interrupted, and one of forgotten data is no answer.
  changed_.wait(lock, [&] { return !is_solving_ || !IsStale(); });
  Start();
  const size_t awaited = started_;
  changed_.wait(lock, [&] { return ended_ >= awaited; });
  // Another may have ended since.
  return awaited <= forgotten_ ? kForgotten : verdict_;
}

void LiveSolver::Run() {
  std::unique_lock<std::mutex> lock(*mutex_);
  while (true) {
    changed_.wait(lock, [&] { return is_solving_ || is_ending_; });
    if (is_ending_) return;
    const SessionData data = std::exchange(data_, {});
    std::optional<Calibration> result;
    std::string error;
    lock.unlock();
    try {
      result = solve_(data);
    } catch (const std::exception& exception) {
      error = OneLine(exception);
    }
    lock.lock();

    is_solving_ = false;
    ++ended_;
    last_solve_time_ = SecondsSinceStart();
    if (IsStale()) {
      forgotten_ = ended_;
      verdict_ = kForgotten;
      live_->FailSolve("");
    } else if (result) {
      verdict_ = {result->IsUsable(),
                  std::string(ToString(result->status)) + ": " + result->message};
      if (live_->EndSolve(*result)) on_result_();
    } else {
      verdict_ = {false, error};
      live_->FailSolve(error);
    }
    changed_.notify_all();
  }
}

}  // namespace imu_pose_calib
