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

/// The same for work that is small: a thread takes some hundreds of it at a time.
template <typename Work>
void InPortions(int threads, size_t count, const Work& work) {
  constexpr size_t kPortion = 256;
  InParallel(threads, (count + kPortion - 1) / kPortion, [&](size_t portion) {
    const size_t begin = portion * kPortion;
    for (size_t k = begin; k < std::min(count, begin + kPortion); ++k) work(k);
  });
}

}  // namespace imu_pose_calib
