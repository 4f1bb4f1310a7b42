#include "imu_pose_calib/ros/io/child_process.h"

#include <fcntl.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstdlib>
#include <system_error>
#include <vector>

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

void WriteAll(int file, const std::string& text) {
  for (size_t done = 0; done < text.size();) {
    const ssize_t written = write(file, text.data() + done, text.size() - done);
    if (written < 0 && errno != EINTR) _exit(EXIT_FAILURE);
    if (written > 0) done += static_cast<size_t>(written);
  }
}

std::string ReadAll(int file) {
  std::string text;
  std::vector<char> buffer(1 << 16);
  for (;;) {
    const ssize_t count = read(file, buffer.data(), buffer.size());
    if (count == 0) return text;
    if (count > 0) text.append(buffer.data(), static_cast<size_t>(count));
    if (count < 0 && errno != EINTR)
      throw std::system_error(errno, std::generic_category(), "cannot read from a process");
  }
}

// What the first byte of the child's answer says of the others.
constexpr char kResult = 'r', kInputError = 'e';

[[noreturn]] void RunChild(const std::function<std::string()>& run,
                           uint64_t max_cpu_s,
                           uint64_t max_bytes,
                           int output) {
  Silence();
  Limit(RLIMIT_CORE, 0);
  Limit(RLIMIT_CPU, max_cpu_s);
#ifndef __SANITIZE_ADDRESS__  // its shadow memory is larger than any limit
  Limit(RLIMIT_AS, max_bytes);
#else
  (void)max_bytes;
#endif
  try {
    WriteAll(output, kResult + run());
  } catch (const InputError& error) {
    WriteAll(output, kInputError + std::string(error.what()));
  } catch (...) {
    _exit(EXIT_FAILURE);
  }
  _exit(EXIT_SUCCESS);
}

}  // namespace

std::optional<std::string> RunApart(const std::function<std::string()>& run,
                                    uint64_t max_cpu_s,
                                    uint64_t max_bytes) {
  const auto fail = [](const char* what) {
    throw std::system_error(errno, std::generic_category(), what);
  };
  int ends[2];
  if (pipe2(ends, O_CLOEXEC) < 0) fail("cannot make a pipe");
  const pid_t child = fork();
  if (child < 0) fail("cannot start a process");
  if (child == 0) RunChild(run, max_cpu_s, max_bytes, ends[1]);
  close(ends[1]);
  const std::string answer = ReadAll(ends[0]);
  close(ends[0]);
  int status = 0;
  while (waitpid(child, &status, 0) < 0)
    if (errno != EINTR) fail("waitpid");
  if (!WIFEXITED(status) || WEXITSTATUS(status) != EXIT_SUCCESS) return std::nullopt;
  if (answer.front() == kInputError) throw InputError(answer.substr(1));
  return answer.substr(1);
}

}  // namespace imu_pose_calib
