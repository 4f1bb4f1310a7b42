#include "imu_pose_calib/ros/offline/progress_lines.h"

#include <unistd.h>

#include <cstdio>

namespace imu_pose_calib {

ProgressLines::ProgressLines(bool quiet) : is_shown_(!quiet && isatty(STDERR_FILENO) == 1) {}

ProgressLines::~ProgressLines() {
  if (is_open_) std::fputs("\n", stderr);
}

void ProgressLines::operator()(const std::string& stage, std::optional<int> iterations) {
  if (!is_shown_) return;
  is_open_ = !iterations;
  if (!iterations) {
    begin_ = std::chrono::steady_clock::now();
    std::fprintf(stderr, "%-30s", stage.c_str());
    return;
  }
  const std::chrono::duration<double> time = std::chrono::steady_clock::now() - begin_;
  std::fprintf(stderr, "%6.1f s", time.count());
  if (*iterations > 0) std::fprintf(stderr, "  %d iterations", *iterations);
  std::fputs("\n", stderr);
}

void ProgressLines::Run(const std::string& stage, const std::function<void()>& run) {
  (*this)(stage, std::nullopt);
  run();
  (*this)(stage, 0);
}

}  // namespace imu_pose_calib
