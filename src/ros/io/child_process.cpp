#include "imu_pose_calib/ros/io/child_process.h"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <boost/process.hpp>
#include <boost/process/extend.hpp>
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

}  // namespace

std::optional<std::string> RunApart(const std::function<std::string()>& run,
                                    const ChildLimits& limits) {
  // In memory, and shared with the child.
  const std::unique_ptr<std::FILE, int (*)(std::FILE*)> output(
      fdopen(memfd_create("answer", MFD_CLOEXEC), "w+"), std::fclose);
  if (!output) Fail("cannot hold the answer of a process");
  const pid_t parent = getpid();
  const pid_t pid = fork();
  if (pid < 0) Fail("cannot start a process");
  if (pid == 0) {
    ConfineChild(parent, limits);
    RunChild(run, output.get());
  }
  const int status = Wait(pid);
  if (status != kResult && status != kInputError) return std::nullopt;
  std::fseek(output.get(), 0, SEEK_END);
  std::string answer(static_cast<size_t>(std::ftell(output.get())), '\0');
  std::rewind(output.get());
  if (std::fread(answer.data(), 1, answer.size(), output.get()) != answer.size())
    Fail("cannot read from a process");
  if (status == kInputError) throw InputError(answer);
  return answer;
}

bool RunScript(const std::string& script, const std::vector<std::string>& arguments,
               const std::string& errors, const std::string& failure) {
  namespace process = boost::process;
  const std::filesystem::path path =
      std::filesystem::read_symlink("/proc/self/exe").parent_path() / script;
  if (!std::filesystem::exists(path)) throw InputError(failure + ": there is no " + path.string());
  const auto unblock = [](auto&) {  // what InterruptGuard blocks here
    sigset_t none;
    sigemptyset(&none);
    sigprocmask(SIG_SETMASK, &none, nullptr);
  };
  try {
    return process::system(path.string(), process::args = arguments,
                           process::std_in<process::null, process::std_out> process::null,
                           process::std_err > errors,
                           process::extend::on_exec_setup = unblock) == EXIT_SUCCESS;
  } catch (const process::process_error& error) {
    throw InputError("'" + path.string() + "' cannot be run: " + error.code().message());
  }
}

}  // namespace imu_pose_calib
