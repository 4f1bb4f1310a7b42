#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <ctime>
#include <string>

#include "imu_pose_calib/core/base/text.h"
#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// Throws an InputError whose text is all of these, as a stream writes them.
template <typename... Args>
[[noreturn]] void Reject(const Args&... args) {
  Throw<InputError>(args...);
}

/// As printf.
[[gnu::format(printf, 1, 2)]] std::string Format(const char* format, ...);

/// `text` in lines of at most `columns`, the first behind `label`, the others indented like it.
std::string Wrap(const std::string& label, const std::string& text, size_t columns = 80);
/// A time as people say it: "3.10 ms", "2.5 s", "-2.00 h", "12.0 days".
std::string Time(double seconds);
/// "x, y, z", each as printf prints it by `number`.
std::string List(const Eigen::Vector3d& v, const char* number);

/// Of nanoseconds.
inline double Seconds(int64_t ns) { return 1e-9 * static_cast<double>(ns); }

/// `text` from a file, safe to show in a terminal: control characters and bytes that are no UTF-8
/// are written as \\x1b. What is printable stays as it is, so that doing it twice does no harm.
std::string Printable(const std::string& text);

/// `text` as one word of a shell: quoted unless it is of letters, digits and _-/.: only.
std::string ShellWord(const std::string& text);

/// Shortest text that reads back as `value` and that YAML 1.1 and 1.2 both take for a float.
std::string YamlNumber(double value);

/// "[1.0, 2.5]", of a vector of Eigen.
template <typename Vector>
std::string YamlNumbers(const Vector& values) {
  std::string text;
  for (int i = 0; i < values.size(); ++i) text += (i == 0 ? "[" : ", ") + YamlNumber(values[i]);
  return text + "]";
}

/// Decimal seconds, exact: "-12.000000345".
std::string SecondsText(int64_t t_ns);

/// Whether there is a folder, or a regular file, at `path`; false where that cannot be told.
bool IsFolder(const std::string& path);
bool IsFile(const std::string& path);

/// A time as UTC, in a format of strftime().
std::string UtcText(std::time_t time, const char* format);

}  // namespace imu_pose_calib
