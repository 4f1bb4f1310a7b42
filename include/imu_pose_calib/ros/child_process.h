#pragma once

#include <cstdint>
#include <functional>

namespace imu_pose_calib {

/// Runs `run` in a child process and returns whether it came back, with or without an exception of
/// type InputError: true; false when it crashed, threw anything else, or needed more than the given
/// processor time [s] or memory [bytes]. Nothing else comes out of the child.
///
/// For libraries that trust the files they read.
bool ComesBack(const std::function<void()>& run, uint64_t max_cpu_s, uint64_t max_bytes);

}  // namespace imu_pose_calib
