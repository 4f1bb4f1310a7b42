#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

namespace imu_pose_calib {

/// What a child process may use up.
struct ChildLimits {
  uint64_t cpu_s;   ///< processor time [s]
  uint64_t wall_s;  ///< time from start to end [s]; 0: any
  uint64_t memory;  ///< address space [bytes]
};

/// Runs `run` in a child process and hands over the bytes that it returns, or the InputError that
/// it throws. No value when it crashed, threw anything else, or went beyond a limit. The child does
/// not outlive the calling thread.
///
/// For libraries that trust the files they read. The child is a fork: call this while the process
/// has no other threads that could hold a lock which `run` needs, since in the child nobody would
/// open it again. When that happens all the same, the limits end it.
std::optional<std::string> RunApart(const std::function<std::string()>& run,
                                    const ChildLimits& limits);

/// Runs a script that is installed beside the executables, without input and output and with stderr
/// in the file `errors`; whether it succeeded. Throws InputError when it cannot be started,
/// beginning with `failure` when there is none.
bool RunScript(const std::string& script, const std::vector<std::string>& arguments,
               const std::string& errors, const std::string& failure);

}  // namespace imu_pose_calib
