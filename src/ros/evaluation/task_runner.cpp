#include "imu_pose_calib/ros/evaluation/task_runner.h"

#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iterator>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/child_process.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {

const char kFailed[] = "failed";

namespace {

using Clock = std::chrono::steady_clock;

constexpr ChildLimits kLimits = {3600, 0, 16ull << 30};  // of one task, however long it waits
constexpr int kInputErrorStatus = 3;                     // of a child that has written its error
constexpr auto kBetweenLines = std::chrono::milliseconds(200);

double Seconds(Clock::duration time) { return std::chrono::duration<double>(time).count(); }
double Seconds(const timeval& time) {
  return static_cast<double>(time.tv_sec) + 1e-6 * static_cast<double>(time.tv_usec);
}

std::filesystem::path ResultPath(const std::string& folder, const Task& task) {
  return std::filesystem::path(folder) / "trials" / (task.name + ".yaml");
}

/// A name beside that of the result, for what is not one yet.
std::string ErrorPath(const std::string& folder, const Task& task) {
  return ResultPath(folder, task).string() + ".error";
}

/// What is left of a file.
std::string Rest(std::ifstream& in) { return {std::istreambuf_iterator<char>(in), {}}; }

void Store(const std::string& folder, const Task& task, const std::string& result) {
  WriteFile(ResultPath(folder, task), "# " + task.description + "\n" + result);
}

/// In the child. Ends with it, whatever happens.
[[noreturn]] void RunHere(const std::string& folder, const Task& task, pid_t parent) {
  ConfineChild(parent, kLimits);
  try {
    Store(folder, task, task.run());
  } catch (const InputError& error) {
    std::ofstream(ErrorPath(folder, task)) << error.what();
    _exit(kInputErrorStatus);
  } catch (const std::exception& error) {
    try {
      Store(folder, task, kFailed + std::string(": ") + error.what() + "\n");
    } catch (...) {
      _exit(EXIT_FAILURE);
    }
  }
  _exit(EXIT_SUCCESS);
}

/// "[#####     ] 123 of 456 trials, 12 min left", on one line that is written again and again.
class ProgressBar {
 public:
  ProgressBar(const RunnerOptions& options, size_t count)
      : title_(options.title),
        count_(count),
        is_shown_(!options.quiet && count > 0 && isatty(STDERR_FILENO) == 1) {}
  ProgressBar(const ProgressBar&) = delete;
  ProgressBar& operator=(const ProgressBar&) = delete;
  ~ProgressBar() {
    if (is_shown_) std::fputs("\n", stderr);
  }

  void Show(size_t done) {
    const Clock::time_point now = Clock::now();
    if (!is_shown_ || (done < count_ && done > 0 && now - shown_ < kBetweenLines)) return;
    shown_ = now;
    constexpr size_t kWidth = 30;
    const std::string bar(kWidth * done / count_, '#');
    const double spent = Seconds(now - begin_);
    std::string left = "";
    if (done > 0 && done < count_)
      left = ", " + Left(spent * static_cast<double>(count_ - done) / static_cast<double>(done)) +
             " left";
    if (done == count_) left = ", " + Left(spent);
    std::fprintf(stderr, "\r[%-30s] %zu of %zu %s%s\033[K", bar.c_str(), done, count_,
                 title_.c_str(), left.c_str());
    std::fflush(stderr);
  }

 private:
  static std::string Left(double seconds) {
    if (seconds < 100.0) return Format("%.0f s", seconds);
    if (seconds < 6000.0) return Format("%.0f min", seconds / 60.0);
    return Format("%.1f h", seconds / 3600.0);
  }

  const std::string title_;
  const size_t count_;
  const bool is_shown_;
  const Clock::time_point begin_ = Clock::now();
  Clock::time_point shown_;
};

/// The tasks that run at the moment.
class Children {
 public:
  explicit Children(const RunnerOptions& options) : options_(options) {}
  Children(const Children&) = delete;
  Children& operator=(const Children&) = delete;
  ~Children() {
    for (const auto& [pid, child] : running_) {
      kill(pid, SIGKILL);
      waitpid(pid, nullptr, 0);
    }
  }

  bool IsFull() const { return running_.size() >= static_cast<size_t>(options_.jobs); }

  void Start(const Task& task) {
    std::filesystem::create_directories(ResultPath(options_.folder, task).parent_path());
    const pid_t parent = getpid();
    const pid_t pid = fork();
    if (pid < 0) throw InputError("no process can be started for a task; lower --jobs");
    if (pid == 0) RunHere(options_.folder, task, parent);
    running_[pid] = {&task, Clock::now()};
  }

  /// Waits until one has ended.
  void Finish() {
    int status = 0;
    rusage used{};
    pid_t pid = 0;
    do pid = wait4(-1, &status, 0, &used);
    while ((pid < 0 && errno == EINTR) || (pid > 0 && running_.count(pid) == 0));
    if (pid < 0) throw InputError("the processes of the tasks cannot be waited for");
    const Child child = running_[pid];
    running_.erase(pid);
    const Task& task = *child.task;
    const bool has_ended = WIFEXITED(status);
    if (has_ended && WEXITSTATUS(status) == kInputErrorStatus) Throw(task);
    if (!has_ended || WEXITSTATUS(status) != EXIT_SUCCESS)
      Store(options_.folder, task, kFailed + std::string(": it died or took too long\n"));
    const std::string file =
        Format("%s/usage_%zu_%zu.csv", options_.folder.c_str(), options_.part + 1, options_.parts);
    std::ofstream(file, std::ios::app)
        << Format("\"%s\",%.3f,%.3f,%.1f\n", task.name.c_str(), Seconds(Clock::now() - child.begin),
                  Seconds(used.ru_utime) + Seconds(used.ru_stime),
                  static_cast<double>(used.ru_maxrss) / 1024.0);
  }

 private:
  struct Child {
    const Task* task;
    Clock::time_point begin;
  };

  [[noreturn]] void Throw(const Task& task) const {
    const std::string path = ErrorPath(options_.folder, task);
    std::ifstream in(path);
    std::filesystem::remove(path);
    throw InputError(Rest(in));
  }

  const RunnerOptions& options_;
  std::map<pid_t, Child> running_;
};

}  // namespace

std::string DescribeFile(const std::string& path) {
  std::error_code ignored;
  return Format("%s (%ju bytes of %lld)", path.c_str(),
                static_cast<uintmax_t>(std::filesystem::file_size(path, ignored)),
                static_cast<long long>(
                    std::filesystem::last_write_time(path, ignored).time_since_epoch().count()));
}

std::optional<std::string> FinishedTask(const std::string& folder, const Task& task) {
  std::ifstream in(ResultPath(folder, task));
  std::string description;
  if (!std::getline(in, description) || description != "# " + task.description) return std::nullopt;
  return Rest(in);
}

void RunTasks(const std::vector<Task>& tasks, const RunnerOptions& options) {
  std::vector<const Task*> missing;
  for (size_t i = options.part; i < tasks.size(); i += options.parts)
    if (!FinishedTask(options.folder, tasks[i])) missing.push_back(&tasks[i]);
  ProgressBar progress(options, missing.size());
  Children children(options);
  for (size_t begun = 0, done = 0; done < missing.size(); ++done) {
    progress.Show(done);
    while (begun < missing.size() && !children.IsFull()) children.Start(*missing[begun++]);
    children.Finish();
  }
  progress.Show(missing.size());
}

std::map<std::string, Usage> LoadUsage(const std::string& folder) {
  std::map<std::string, Usage> found;
  for (const auto& entry : std::filesystem::directory_iterator(folder)) {
    const std::string file = entry.path().filename();
    if (file.rfind("usage_", 0) != 0) continue;
    std::ifstream in(entry.path());
    for (std::string line; std::getline(in, line);) {
      const size_t end = line.rfind('"');
      Usage usage{};
      if (end == std::string::npos || end < 1 ||
          std::sscanf(line.c_str() + end + 1, ",%lf,%lf,%lf", &usage.wall_s, &usage.cpu_s,
                      &usage.memory_mb) != 3)
        continue;  // cut off when a process was killed
      found[line.substr(1, end - 1)] = usage;
    }
  }
  return found;
}

}  // namespace imu_pose_calib
