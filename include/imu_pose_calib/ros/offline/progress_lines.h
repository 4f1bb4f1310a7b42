#pragma once

#include <chrono>
#include <functional>
#include <optional>
#include <string>

namespace imu_pose_calib {

/// A line on stderr for each stage of a calibration, with the time and the iterations that it took;
/// nothing when stderr is no terminal.
class ProgressLines {
 public:
  explicit ProgressLines(bool quiet);
  ProgressLines(const ProgressLines&) = delete;
  ProgressLines& operator=(const ProgressLines&) = delete;
  ~ProgressLines();

  /// See Progress.
  void operator()(const std::string& stage, std::optional<int> iterations);
  /// Tells of a stage that `run` is.
  void Run(const std::string& stage, const std::function<void()>& run);

 private:
  bool is_shown_;
  bool is_open_ = false;  ///< the last line has no end
  std::chrono::steady_clock::time_point begin_;
};

}  // namespace imu_pose_calib
