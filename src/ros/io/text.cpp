#include "imu_pose_calib/ros/io/text.h"

#include <algorithm>
#include <boost/algorithm/string/replace.hpp>
#include <boost/locale/utf.hpp>
#include <cctype>
#include <cmath>
#include <cstdarg>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <sstream>

namespace imu_pose_calib {
namespace {

/// `code`: of Unicode, or an error of the decoder, which is beyond all of these.
bool IsPrintable(boost::locale::utf::code_point code) {
  const bool is_control = code < 0x20 || (code >= 0x7f && code < 0xa0);
  const bool turns_the_text_around =
      (code >= 0x202a && code <= 0x202e) || (code >= 0x2066 && code <= 0x2069);
  return code <= 0x10ffff && !is_control && !turns_the_text_around;
}

}  // namespace

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
  std::string wrapped, line = label;
  for (std::string word; words >> word;) {
    if (line.size() > label.size() && line.size() + 1 + word.size() > columns) {
      wrapped += line + "\n";
      line.assign(label.size(), ' ');
    }
    line += (line.size() > label.size() ? " " : "") + word;
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

std::string Printable(const std::string& text) {
  std::string printable;
  for (auto at = text.begin(); at != text.end();) {
    auto end = at;
    if (IsPrintable(boost::locale::utf::utf_traits<char>::decode(end, text.end()))) {
      printable.append(at, end);
      at = end;
    } else {
      printable += Format("\\x%02x", static_cast<unsigned char>(*at++));
    }
  }
  return printable;
}

std::string ShellWord(const std::string& text) {
  const bool is_plain = std::all_of(text.begin(), text.end(), [](unsigned char c) {
    return c < 0x80 && (std::isalnum(c) || std::strchr("_-/.:", c));
  });
  return is_plain ? text : "'" + boost::replace_all_copy(text, "'", "'\\''") + "'";
}

std::string YamlNumber(double value) {
  if (std::isnan(value)) return ".nan";
  if (std::isinf(value)) return value > 0 ? ".inf" : "-.inf";
  char buffer[32];
  for (int digits = 15; digits <= 17; ++digits) {
    std::snprintf(buffer, sizeof(buffer), "%.*g", digits, value);
    if (std::strtod(buffer, nullptr) == value) break;
  }
  // YAML 1.1 takes "1" for an integer and "1e-05" for a string.
  std::string text = buffer;
  if (text.find('.') == std::string::npos) text.insert(std::min(text.find('e'), text.size()), ".0");
  return text;
}

std::string SecondsText(int64_t t_ns) {
  const std::lldiv_t parts = std::lldiv(t_ns, 1'000'000'000);
  return Format("%s%lld.%09lld", t_ns < 0 ? "-" : "", std::llabs(parts.quot),
                std::llabs(parts.rem));
}

bool IsFolder(const std::string& path) {
  std::error_code ignored;
  return std::filesystem::is_directory(path, ignored);
}

bool IsFile(const std::string& path) {
  std::error_code ignored;
  return std::filesystem::is_regular_file(path, ignored);
}

std::string UtcText(std::time_t time, const char* format) {
  std::tm utc{};
  char text[32];
  std::strftime(text, sizeof(text), format, gmtime_r(&time, &utc));
  return text;
}

}  // namespace imu_pose_calib
