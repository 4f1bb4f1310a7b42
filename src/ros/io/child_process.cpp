#include "imu_pose_calib/ros/io/child_process.h"

#include <fcntl.h>
#include <poll.h>
#include <spawn.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <csignal>
#include <cstdlib>
#include <system_error>
#include <vector>

#include "imu_pose_calib/core/base/types.h"

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

[[noreturn]] void Fail(const char* what) {
  throw std::system_error(errno, std::generic_category(), what);
}

using Clock = std::chrono::steady_clock;

/// Waits until there is something to read, or the end of it. False when it is too late.
bool WaitFor(int file, Clock::time_point deadline) {
  for (;;) {
    const auto left = std::chrono::ceil<std::chrono::milliseconds>(deadline - Clock::now());
    if (left.count() <= 0) return false;
    constexpr int64_t kMaxWait = 3'600'000;  // [ms] poll() takes an int
    pollfd wanted{file, POLLIN, 0};
    const int ready = poll(&wanted, 1, static_cast<int>(std::min<int64_t>(left.count(), kMaxWait)));
    if (ready > 0) return true;
    if (ready < 0 && errno != EINTR) Fail("cannot wait for a process");
  }
}

/// All that comes before the deadline.
std::string ReadAll(int file, Clock::time_point deadline) {
  std::string text;
  std::vector<char> buffer(1 << 16);
  while (WaitFor(file, deadline)) {
    const ssize_t count = read(file, buffer.data(), buffer.size());
    if (count == 0) return text;
    if (count > 0) text.append(buffer.data(), static_cast<size_t>(count));
    if (count < 0 && errno != EINTR) Fail("cannot read from a process");
  }
  return {};
}

/// A running child and the end of the pipe that its answer comes from. None is left behind: what
/// still runs in the end is killed.
class Child {
 public:
  Child(pid_t pid, int output) : pid_(pid), output_(output) {}
  Child(const Child&) = delete;
  Child& operator=(const Child&) = delete;
  ~Child() {
    close(output_);
    if (pid_ <= 0) return;
    kill(pid_, SIGKILL);
    Wait();
  }

  int output() const { return output_; }

  /// Whether it ended well.
  bool Wait() {
    int status = 0;
    while (waitpid(pid_, &status, 0) < 0)
      if (errno != EINTR) return false;
    pid_ = 0;
    return WIFEXITED(status) && WEXITSTATUS(status) == EXIT_SUCCESS;
  }

 private:
  pid_t pid_;  ///< 0: has ended
  int output_;
};

// What the first byte of the child's answer says of the others.
constexpr char kResult = 'r', kInputError = 'e';

[[noreturn]] void RunChild(const std::function<std::string()>& run, const ChildLimits& limits,
                           pid_t parent, int output) {
  ConfineChild(parent, limits);
  Silence();
  try {
    const std::string result = run();
    WriteAll(output, {kResult});
    WriteAll(output, result);
  } catch (const InputError& error) {
    WriteAll(output, kInputError + std::string(error.what()));
  } catch (...) {
    _exit(EXIT_FAILURE);
  }
  _exit(EXIT_SUCCESS);
}

}  // namespace

std::optional<std::string> RunApart(const std::function<std::string()>& run,
                                    const ChildLimits& limits) {
  int ends[2];
  if (pipe2(ends, O_CLOEXEC) < 0) Fail("cannot make a pipe");
  const pid_t parent = getpid();
  const pid_t pid = fork();
  if (pid == 0) {
    // With this end open here too, a write to a parent that is gone would wait for ever.
    close(ends[0]);
    RunChild(run, limits, parent, ends[1]);
  }
  close(ends[1]);
  if (pid < 0) {
    close(ends[0]);
    Fail("cannot start a process");
  }
  Child child(pid, ends[0]);
  const auto deadline = Clock::now() + std::chrono::seconds(limits.wall_s);
  std::string answer = ReadAll(child.output(), deadline);
  // No answer: it is late, or ended before it had one.
  if (answer.empty() || !child.Wait()) return std::nullopt;
  if (answer.front() == kInputError) throw InputError(answer.substr(1));
  answer.erase(0, 1);
  return answer;
}

void ConfineChild(pid_t parent, const ChildLimits& limits) {
  // A parent that is killed takes the child along; it may have been killed before this call.
  prctl(PR_SET_PDEATHSIG, SIGKILL);
  if (getppid() != parent) _exit(EXIT_FAILURE);
  Limit(RLIMIT_CORE, 0);
  Limit(RLIMIT_CPU, limits.cpu_s);
#ifndef __SANITIZE_ADDRESS__  // its shadow memory is larger than any limit
  Limit(RLIMIT_AS, limits.memory);
#endif
}

int RunProgram(const std::vector<std::string>& command, const std::string& errors) {
  std::vector<char*> arguments;
  for (const std::string& word : command) arguments.push_back(const_cast<char*>(word.c_str()));
  arguments.push_back(nullptr);
  posix_spawn_file_actions_t files;
  posix_spawn_file_actions_init(&files);
  posix_spawn_file_actions_addopen(&files, STDIN_FILENO, "/dev/null", O_RDONLY, 0);
  posix_spawn_file_actions_addopen(&files, STDOUT_FILENO, "/dev/null", O_WRONLY, 0);
  posix_spawn_file_actions_addopen(&files, STDERR_FILENO, errors.c_str(),
                                   O_WRONLY | O_CREAT | O_TRUNC, 0600);
  posix_spawnattr_t attributes;
  posix_spawnattr_init(&attributes);
  sigset_t none;
  sigemptyset(&none);
  posix_spawnattr_setsigmask(&attributes, &none);  // not what InterruptGuard blocks here
  posix_spawnattr_setflags(&attributes, POSIX_SPAWN_SETSIGMASK);
  pid_t pid = 0;
  const int failure =
      posix_spawn(&pid, arguments[0], &files, &attributes, arguments.data(), environ);
  posix_spawnattr_destroy(&attributes);
  posix_spawn_file_actions_destroy(&files);
  if (failure != 0)
    throw InputError("'" + command[0] +
                     "' cannot be run: " + std::generic_category().message(failure));
  int status = 0;
  while (waitpid(pid, &status, 0) < 0)
    if (errno != EINTR) Fail("cannot wait for a process");
  return WIFEXITED(status) ? WEXITSTATUS(status) : -1;
}

}  // namespace imu_pose_calib
