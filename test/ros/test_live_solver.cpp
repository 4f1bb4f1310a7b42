// LiveSolver and the LiveCalibration around which it puts a thread, used by many threads at once.
// Run under ThreadSanitizer by .ci/run.

#include <gtest/gtest.h>

#include <atomic>
#include <chrono>
#include <functional>
#include <future>
#include <mutex>
#include <stdexcept>
#include <thread>
#include <vector>

#include "imu_pose_calib/ros/live/live_calibration.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using std::chrono::milliseconds;

/// A pose in metres from the origin that tells which data it belongs to.
PoseSample Pose(int64_t k, double tag) {
  PoseSample pose;
  pose.t_ns = 1'000'000'000 + 10'000'000 * k;
  pose.q_WM.setIdentity();
  pose.p_WM = {tag, 1e-3 * static_cast<double>(k), 0.0};
  return pose;
}

/// A usable result that tells which data it comes from.
Calibration Tagged(const SessionData& data) {
  if (data.poses.empty()) throw std::runtime_error("no poses");
  Calibration result;
  result.status = Status::kOk;
  result.message = std::to_string(static_cast<int>(data.poses.front().p_WM.x()));
  result.imus[0].covariance.setIdentity();
  result.sessions[0].imus[0].time_shift_std = 1.0;
  return result;
}

/// A solver whose solves wait until they are let go.
class LiveSolverTest : public ::testing::Test {
 protected:
  void Add(double tag) {
    const std::lock_guard<std::mutex> lock(mutex_);
    live_.AddPose(Pose(++count_, tag), 1.0);
  }
  void Reset() {
    const std::lock_guard<std::mutex> lock(mutex_);
    live_.Reset("", 1.0);
  }
  std::future<LiveSolver::Verdict> Calibrate() {
    return std::async(std::launch::async, [this] { return solver_.Calibrate(); });
  }
  /// Waits for the begin of the solve `number`, counted from 1.
  void WaitForSolve(int number) {
    while (begun_ < number) std::this_thread::sleep_for(milliseconds(1));
  }
  void LetGo(int solves) { allowed_ += solves; }

  std::mutex mutex_;
  LiveCalibration live_{LiveOptions()};
  int64_t count_ = 0;
  std::atomic<int> begun_{0}, allowed_{0}, results_{0};
  LiveSolver solver_{&mutex_, &live_,
                     [this](const SessionData& data) {
                       const int number = ++begun_;
                       while (allowed_ < number) std::this_thread::sleep_for(milliseconds(1));
                       return Tagged(data);
                     },
                     [this] { ++results_; }};
};

TEST_F(LiveSolverTest, AnswersAllWhoWaitForOneSolve) {
  Add(1.0);
  auto first = Calibrate();
  WaitForSolve(1);
  auto second = Calibrate();
  std::this_thread::sleep_for(milliseconds(50));
  LetGo(1);
  EXPECT_EQ(first.get().message, "ok: 1");
  const LiveSolver::Verdict verdict = second.get();
  EXPECT_TRUE(verdict.success);
  EXPECT_EQ(verdict.message, "ok: 1");
  EXPECT_EQ(results_, 1);
}

TEST_F(LiveSolverTest, SolvesAgainAfterAReset) {
  Add(1.0);
  auto stale = Calibrate();
  WaitForSolve(1);
  Reset();
  Add(2.0);
  auto fresh = Calibrate();
  std::this_thread::sleep_for(milliseconds(50));
  LetGo(2);
  const LiveSolver::Verdict verdict = fresh.get();
  EXPECT_TRUE(verdict.success);
  EXPECT_EQ(verdict.message, "ok: 2");
  EXPECT_FALSE(stale.get().success) << "its data are forgotten";
  EXPECT_EQ(results_, 1);
}

TEST_F(LiveSolverTest, AnswersWithTheErrorOfASolve) {
  LetGo(1);
  const LiveSolver::Verdict verdict = Calibrate().get();
  EXPECT_FALSE(verdict.success);
  EXPECT_EQ(verdict.message, "no poses");
  const std::lock_guard<std::mutex> lock(mutex_);
  EXPECT_FALSE(live_.IsSolving());
  EXPECT_EQ(solver_.SolveTime(), 0.0);
  EXPECT_GT(solver_.last_solve_time(), 0.0);
}

TEST_F(LiveSolverTest, EndsWithASolveOnItsWay) {
  Add(1.0);
  const std::lock_guard<std::mutex> lock(mutex_);
  solver_.Start();
  LetGo(1);
}

/// As in the node: samples, status, reset, save and calibrate, each from a thread of its own.
TEST(LiveSolver, WorksForManyThreads) {
  std::mutex mutex;
  LiveCalibration live((LiveOptions()));
  int64_t count = 0;
  int tag = 1;  // of the data; grows with each reset
  std::atomic<int> results{0}, verdicts{0};
  LiveSolver solver(
      &mutex, &live,
      [](const SessionData& data) {
        std::this_thread::sleep_for(milliseconds(2));
        return Tagged(data);
      },
      [&] { ++results; });

  const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(2);
  std::vector<std::thread> threads;
  const auto repeat = [&](milliseconds pause, const std::function<void()>& work) {
    threads.emplace_back([=] {
      while (std::chrono::steady_clock::now() < end) {
        work();
        std::this_thread::sleep_for(pause);
      }
    });
  };
  const auto reset = [&] {
    const std::lock_guard<std::mutex> lock(mutex);
    ++tag;
    live.Reset("", 1.0);
    live.AddPose(Pose(++count, tag), 1.0);
    return tag;
  };
  const auto calibrate = [&](int least) {
    const LiveSolver::Verdict verdict = solver.Calibrate();
    ++verdicts;
    if (!verdict.success) return;
    EXPECT_GE(std::stoi(verdict.message.substr(4)), least);
  };
  repeat(milliseconds(1), [&] {
    const std::lock_guard<std::mutex> lock(mutex);
    live.AddPose(Pose(++count, tag), 1.0);
    live.AddGyro({1'000'000'000 + 10'000'000 * count, Eigen::Vector3d::Ones()}, 1.0);
    live.AddAccel({1'000'000'000 + 10'000'000 * count, Eigen::Vector3d::Ones()}, 1.0);
  });
  repeat(milliseconds(3), [&] {
    const std::lock_guard<std::mutex> lock(mutex);
    if (!live.IsFrozen()) solver.Start();
    const CalibrationStatus status = live.Status(1.0);
    EXPECT_FALSE(status.message.empty());
    EXPECT_GE(solver.SolveTime(), 0.0);
  });
  repeat(milliseconds(0), [&] { calibrate(1); });
  repeat(milliseconds(1), [&] { calibrate(reset()); });
  repeat(milliseconds(20), [&] {
    const std::lock_guard<std::mutex> lock(mutex);
    if (live.result()) live.Freeze("saved");
  });
  for (std::thread& thread : threads) thread.join();
  EXPECT_GT(results, 10);
  EXPECT_GT(verdicts, 20);
}

}  // namespace
}  // namespace imu_pose_calib
