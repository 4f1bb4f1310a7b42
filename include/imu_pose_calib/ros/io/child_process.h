#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>

namespace imu_pose_calib {

/// Runs `run` in a child process and hands over the bytes that it returns, or the InputError that
/// it throws. No value when it crashed, threw anything else, or needed more than the given
/// processor time [s] or memory [bytes].
///
/// For libraries that trust the files they read.
std::optional<std::string> RunApart(const std::function<std::string()>& run,
                                    uint64_t max_cpu_s,
                                    uint64_t max_bytes);

}  // namespace imu_pose_calib
