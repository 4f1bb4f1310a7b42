#include "imu_pose_calib/ros/child_process.h"

#include <fcntl.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <system_error>

#include "imu_pose_calib/core/types.h"

namespace imu_pose_calib {
namespace {

void Limit(decltype(RLIMIT_CPU) resource, uint64_t value) {
  rlimit limit{};
  getrlimit(resource, &limit);
  limit.rlim_cur = std::min<rlim_t>(value, limit.rlim_max);
  setrlimit(resource, &limit);
}

void Silence() {
  const int null = open("/dev/null", O_WRONLY);
  dup2(null, STDOUT_FILENO);
  dup2(null, STDERR_FILENO);
}

[[noreturn]] void RunChild(const std::function<void()>& run,
                           uint64_t max_cpu_s,
                           uint64_t max_bytes) {
  Silence();
  Limit(RLIMIT_CORE, 0);
  Limit(RLIMIT_CPU, max_cpu_s);
#ifndef __SANITIZE_ADDRESS__  // its shadow memory is larger than any limit
  Limit(RLIMIT_AS, max_bytes);
#else
  (void)max_bytes;
#endif
  int status = 0;
  try {
    run();
  } catch (const InputError&) {
  } catch (...) {
    status = 1;
  }
  _exit(status);
}

}  // namespace

bool ComesBack(const std::function<void()>& run, uint64_t max_cpu_s, uint64_t max_bytes) {
  const pid_t child = fork();
  if (child < 0) throw std::system_error(errno, std::generic_category(), "cannot start a process");
  if (child == 0) RunChild(run, max_cpu_s, max_bytes);
  int status = 0;
  while (waitpid(child, &status, 0) < 0)
    if (errno != EINTR) throw std::system_error(errno, std::generic_category(), "waitpid");
  return WIFEXITED(status) && WEXITSTATUS(status) == 0;
}

}  // namespace imu_pose_calib
