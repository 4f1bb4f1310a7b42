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
#include <map>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/child_process.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

using Clock = std::chrono::steady_clock;

constexpr ChildLimits kLimits = {3600, 0, 16ull << 30};  // of one task, however long it waits
constexpr int kInputErrorStatus = 3;                     // of a child that has written its error

double SecondsSince(Clock::time_point begin) {
  return std::chrono::duration<double>(Clock::now() - begin).count();
}
double Seconds(const timeval& time) {
  return static_cast<double>(time.tv_sec) + 1e-6 * static_cast<double>(time.tv_usec);
}

std::filesystem::path ResultPath(const std::string& folder, const Task& task) {
  return std::filesystem::path(folder) / "trials" / (task.name + ".yaml");
}

/// The tasks of one call of RunTasks().
class Runner {
 public:
  Runner(const RunnerOptions& options, size_t count)
      : options_(options),
        count_(count),
        is_shown_(!options.quiet && count > 0 && isatty(STDERR_FILENO) == 1) {}
  Runner(const Runner&) = delete;
  Runner& operator=(const Runner&) = delete;
  ~Runner() {
    for (const auto& [pid, child] : running_) {
      kill(pid, SIGKILL);
      waitpid(pid, nullptr, 0);
    }
    if (is_shown_) std::fputs("\n", stderr);
  }

  bool IsFull() const { return running_.size() >= static_cast<size_t>(options_.jobs); }

  void Start(const Task& task) {
    std::filesystem::create_directories(ResultPath(options_.folder, task).parent_path());
    const pid_t parent = getpid();
    const pid_t pid = fork();
    if (pid < 0) throw InputError("no process can be started for a task; lower --jobs");
    if (pid == 0) RunHere(task, parent);
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
    const auto [task, begin] = running_[pid];
    running_.erase(pid);
    const int exit_status = WIFEXITED(status) ? WEXITSTATUS(status) : -1;
    if (exit_status == kInputErrorStatus) {
      const std::string error = FinishedTask(options_.folder, Error(*task)).value();
      std::filesystem::remove(ResultPath(options_.folder, *task));
      throw InputError(error);
    }
    if (exit_status != EXIT_SUCCESS)
      Store(*task, kFailed + std::string(": it died or took too long\n"));
    const std::string file =
        Format("%s/usage_%zu_%zu.csv", options_.folder.c_str(), options_.part + 1, options_.parts);
    std::ofstream(file, std::ios::app)
        << Format("\"%s\",%.3f,%.3f,%.1f\n", task->name.c_str(), SecondsSince(begin),
                  Seconds(used.ru_utime) + Seconds(used.ru_stime),
                  static_cast<double>(used.ru_maxrss) / 1024.0);
  }

  /// "[#####     ] 123 of 456 trials, 12 min left", on one line that is written again and again.
  void Show(size_t done) const {
    if (!is_shown_ || count_ == 0) return;
    const auto time = [](double seconds) {
      if (seconds < 100.0) return Format("%.0f s", seconds);
      if (seconds < 6000.0) return Format("%.0f min", seconds / 60.0);
      return Format("%.1f h", seconds / 3600.0);
    };
    const double spent = SecondsSince(begin_);
    std::string left;
    if (done == count_)
      left = ", " + time(spent);
    else if (done > 0)
      left = ", " + time(spent * static_cast<double>(count_ - done) / static_cast<double>(done)) +
             " left";
    const std::string bar(30 * done / count_, '#');
    std::fprintf(stderr, "\r[%-30s] %zu of %zu %s%s\033[K", bar.c_str(), done, count_,
                 options_.title.c_str(), left.c_str());
  }

 private:
  struct Child {
    const Task* task;
    Clock::time_point begin;
  };

  /// What stands in place of the result after an InputError.
  static Task Error(const Task& task) { return {task.name, "input error", {}}; }

  void Store(const Task& task, const std::string& result) const {
    WriteFile(ResultPath(options_.folder, task), "# " + task.description + "\n" + result);
  }

  /// In the child. Ends with it, whatever happens.
  [[noreturn]] void RunHere(const Task& task, pid_t parent) const {
    ConfineChild(parent, kLimits);
    try {
      try {
        Store(task, task.run());
      } catch (const InputError& error) {
        Store(Error(task), error.what());
        _exit(kInputErrorStatus);
      } catch (const std::exception& error) {
        Store(task, kFailed + std::string(": ") + error.what() + "\n");
      }
    } catch (...) {
      _exit(EXIT_FAILURE);
    }
    _exit(EXIT_SUCCESS);
  }

  const RunnerOptions& options_;
  const size_t count_;
  const bool is_shown_;
  const Clock::time_point begin_ = Clock::now();
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
  return std::string(std::istreambuf_iterator<char>(in), {});
}

void RunTasks(const std::vector<Task>& tasks, const RunnerOptions& options) {
  std::vector<const Task*> missing;
  for (size_t i = options.part; i < tasks.size(); i += options.parts)
    if (!FinishedTask(options.folder, tasks[i])) missing.push_back(&tasks[i]);
  Runner runner(options, missing.size());
  for (size_t begun = 0, done = 0; done < missing.size();) {
    while (begun < missing.size() && !runner.IsFull()) runner.Start(*missing[begun++]);
    runner.Show(done);
    runner.Finish();
    runner.Show(++done);
  }
}

}  // namespace imu_pose_calib
