#pragma once

#include <functional>
#include <optional>
#include <string>
#include <vector>

namespace imu_pose_calib {

/// A piece of work whose result is a text. Tasks are independent of each other.
struct Task {
  std::string name;         ///< path of its result below the folder, without ending
  std::string description;  ///< all that the result follows from, on one line
  std::function<std::string()> run;
};

/// A file that a result follows from, with its size and time of change.
std::string DescribeFile(const std::string& path);

struct RunnerOptions {
  std::string folder;           ///< of the results
  int jobs = 1;                 ///< tasks at a time
  size_t part = 0, parts = 1;   ///< every parts-th task, from this one on
  bool quiet = false;           ///< no progress
  std::string title = "tasks";  ///< for the progress
};

/// The result of a task that has run, unless something that it follows from has changed since.
std::optional<std::string> FinishedTask(const std::string& folder, const Task& task);

/// Runs those tasks of the part that have no stored result, each in a process of its own, which may
/// die or take too long: its result is then kFailed and the reason. A result is there as a whole or
/// not at all, so that what was done is kept when this process is killed. Name, time [s], time of
/// the processor [s] and memory [MB] of each are added to folder/usage_PART_PARTS.csv. On a
/// terminal, shows how much is done and the time left. Throws the first InputError of a task, when
/// the others at work have ended.
///
/// Forks: call it from a process without other threads.
void RunTasks(const std::vector<Task>& tasks, const RunnerOptions& options);

/// First word of the result of a task that had none.
constexpr char kFailed[] = "failed";

}  // namespace imu_pose_calib
