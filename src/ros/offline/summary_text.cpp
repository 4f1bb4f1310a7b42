#include "imu_pose_calib/ros/offline/summary_text.h"

#include <cmath>
#include <cstdarg>
#include <cstdio>
#include <sstream>

#include "imu_pose_calib/ros/io/printable.h"

namespace imu_pose_calib {

std::string Format(const char* format, ...) {
  va_list arguments, again;
  va_start(arguments, format);
  va_copy(again, arguments);
  std::string text(static_cast<size_t>(std::vsnprintf(nullptr, 0, format, arguments)), ' ');
  std::vsnprintf(text.data(), text.size() + 1, format, again);
  va_end(again);
  va_end(arguments);
  return text;
}

std::string Wrap(const std::string& label, const std::string& text, size_t columns) {
  std::istringstream words(text);
  std::string wrapped, line = label, word;
  const std::string indent(label.size(), ' ');
  bool is_empty = true;
  while (words >> word) {
    if (!is_empty && line.size() + 1 + word.size() > columns) {
      wrapped += line + "\n";
      line = indent;
      is_empty = true;
    }
    line += (is_empty ? "" : " ") + word;
    is_empty = false;
  }
  return wrapped + line + "\n";
}

std::string Time(double seconds) {
  const double size = std::abs(seconds);
  if (size < 1.0) return Format("%.2f ms", 1e3 * seconds);
  if (size < 600.0) return Format("%.1f s", seconds);
  if (size < 36.0 * 3600.0) return Format("%.2f h", seconds / 3600.0);
  return Format("%.1f days", seconds / 86400.0);
}

std::string List(const Eigen::Vector3d& v, const char* number) {
  const std::string format = std::string(number) + ", " + number + ", " + number;
  return Format(format.c_str(), v.x(), v.y(), v.z());  // NOLINT
}

std::string Dropped(const StreamReport& report) {
  std::string reasons;
  const auto add = [&](size_t count, const char* reason) {
    if (count > 0) reasons += (reasons.empty() ? "" : ", ") + std::to_string(count) + " " + reason;
  };
  add(report.not_finite, "not finite");
  add(report.zero_quaternion, "zero quaternion");
  add(report.reversed_stamp, "reversed stamp");
  add(report.duplicate_stamp, "duplicate stamp");
  add(report.repeated_value, "repeated value");
  add(report.saturated, "saturated");
  add(report.outlier, "outlier");
  add(report.flipped, "flipped");
  add(report.in_short_segment, "between gaps");
  add(report.between_updates, "between updates");
  return reasons.empty() ? "" : "; dropped " + reasons;
}

RecordingInfo WithPrintableNames(RecordingInfo info) {
  std::vector<std::string*> names = {&info.bag, &info.pose_topic, &info.marker_frame,
                                     &info.imu_yaml};
  for (ImuInfo& imu : info.imus)
    names.insert(names.end(), {&imu.imu_topic, &imu.gyro_topic, &imu.accel_topic, &imu.imu_frame});
  for (std::string* name : names) *name = Printable(*name);
  return info;
}

}  // namespace imu_pose_calib
