#pragma once

#include <algorithm>
#include <atomic>
#include <future>
#include <vector>

namespace imu_pose_calib {

/// Calls work(k) for k = 0 .. count - 1 on up to `threads` threads, and throws what it throws.
template <typename Work>
void InParallel(int threads, size_t count, const Work& work) {
  std::atomic<size_t> next{0};
  const auto run = [&] {
    for (size_t k = next++; k < count; k = next++) work(k);
  };
  std::vector<std::future<void>> others;
  for (size_t k = 1; k < std::min(count, static_cast<size_t>(threads)); ++k)
    others.push_back(std::async(std::launch::async, run));
  run();
  for (std::future<void>& other : others) other.get();
}

}  // namespace imu_pose_calib
