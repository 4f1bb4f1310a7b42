#include "imu_pose_calib/ros/io/child_process.h"

#include <fcntl.h>
#include <spawn.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <memory>
#include <system_error>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {
namespace {

/// Exit status of a child that has answered; others have not.
enum Answer : int { kResult = 81, kInputError = 82 };

void Limit(decltype(RLIMIT_CPU) resource, uint64_t value) {
  rlimit limit{};
  getrlimit(resource, &limit);
  limit.rlim_cur = std::min<rlim_t>(value, limit.rlim_max);
  setrlimit(resource, &limit);
}

/// In the child of the process `parent`: lets it end with that, and limits what it uses up.
void ConfineChild(pid_t parent, const ChildLimits& limits) {
  // A parent that is killed takes the child along; it may have been killed before this call.
  prctl(PR_SET_PDEATHSIG, SIGKILL);
  if (getppid() != parent) _exit(EXIT_FAILURE);
  Limit(RLIMIT_CORE, 0);
  Limit(RLIMIT_CPU, limits.cpu_s);
#ifndef __SANITIZE_ADDRESS__  // its shadow memory is larger than any limit
  Limit(RLIMIT_AS, limits.memory);
#endif
  std::signal(SIGALRM, SIG_DFL);
  alarm(static_cast<unsigned>(limits.wall_s));
}

[[noreturn]] void Fail(const char* what) {
  throw std::system_error(errno, std::generic_category(), what);
}

/// The exit status of a child; -1 when it did not end by itself.
int Wait(pid_t pid) {
  int status = 0;
  while (waitpid(pid, &status, 0) < 0)
    if (errno != EINTR) Fail("cannot wait for a process");
  return WIFEXITED(status) ? WEXITSTATUS(status) : -1;
}

[[noreturn]] void RunChild(const std::function<std::string()>& run, std::FILE* output) {
  const int null = open("/dev/null", O_WRONLY);
  dup2(null, STDOUT_FILENO);
  dup2(null, STDERR_FILENO);
  const auto answer = [output](const std::string& text, Answer status) {
    const bool is_written = std::fwrite(text.data(), 1, text.size(), output) == text.size();
    _exit(is_written && std::fflush(output) == 0 ? int{status} : EXIT_FAILURE);
  };
  try {
    answer(run(), kResult);
  } catch (const InputError& error) {
    answer(error.what(), kInputError);
  } catch (...) {
  }
  _exit(EXIT_FAILURE);
}

/// Runs a program, a path and its arguments; returns its exit status, -1 when it did not end by
/// itself.
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
  return Wait(pid);
}

}  // namespace

std::optional<std::string> RunApart(const std::function<std::string()>& run,
                                    const ChildLimits& limits) {
  int ends[2];  // to read from and to write to
  if (pipe2(ends, O_CLOEXEC) != 0) Fail("cannot hold the answer of a process");
  const pid_t parent = getpid();
  const pid_t pid = fork();
  if (pid < 0) {
    close(ends[0]);
    close(ends[1]);
    Fail("cannot start a process");
  }
  if (pid == 0) {
    close(ends[0]);
    ConfineChild(parent, limits);
    RunChild(run, fdopen(ends[1], "w"));
  }
  close(ends[1]);
  const std::unique_ptr<std::FILE, int (*)(std::FILE*)> input(fdopen(ends[0], "r"), std::fclose);
  std::string answer;
  char part[1 << 16];
  while (const ssize_t size = read(ends[0], part, sizeof(part))) {
    if (size > 0) answer.append(part, static_cast<size_t>(size));
    if (size < 0 && errno != EINTR) Fail("cannot read from a process");
  }
  const int status = Wait(pid);
  if (status != kResult && status != kInputError) return std::nullopt;
  if (status == kInputError) throw InputError(answer);
  return answer;
}

bool RunScript(const std::string& script, const std::vector<std::string>& arguments,
               const std::string& errors, const std::string& failure) {
  const std::filesystem::path path =
      std::filesystem::read_symlink("/proc/self/exe").parent_path() / script;
  if (!std::filesystem::exists(path)) throw InputError(failure + ": there is no " + path.string());
  std::vector<std::string> command = {path};
  command.insert(command.end(), arguments.begin(), arguments.end());
  return RunProgram(command, errors) == EXIT_SUCCESS;
}

}  // namespace imu_pose_calib
