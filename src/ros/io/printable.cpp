#include "imu_pose_calib/ros/io/printable.h"

#include <cstdint>
#include <cstdio>

namespace imu_pose_calib {
namespace {

/// Length of the printable character at `at`; 0: there is none.
size_t PrintableLength(const std::string& text, size_t at) {
  const auto byte = [&](size_t k) { return static_cast<unsigned char>(text[k]); };
  const unsigned char first = byte(at);
  if (first < 0x80) return first >= ' ' && first != 0x7f ? 1 : 0;
  const size_t length = first >= 0xf0 ? 4 : first >= 0xe0 ? 3 : 2;
  if (first < 0xc2 || first > 0xf4 || at + length > text.size()) return 0;
  uint32_t code = first & (0xffu >> (length + 1));
  for (size_t k = at + 1; k < at + length; ++k) {
    if ((byte(k) & 0xc0) != 0x80) return 0;
    code = code << 6 | (byte(k) & 0x3fu);
  }
  // UTF-8 takes the shortest form, has no surrogates and ends at 0x10ffff. Up to 0x9f are control
  // characters, from 0x202a and 0x2066 those that turn the direction of the text around.
  constexpr uint32_t kSmallest[] = {0, 0, 0xa0, 0x800, 0x10000};
  const bool is_surrogate = code >= 0xd800 && code <= 0xdfff;
  const bool turns_around =
      (code >= 0x202a && code <= 0x202e) || (code >= 0x2066 && code <= 0x2069);
  const bool is_good = code >= kSmallest[length] && code <= 0x10ffff && !is_surrogate;
  return is_good && !turns_around ? length : 0;
}

}  // namespace

std::string Printable(const std::string& text) {
  std::string printable;
  for (size_t at = 0; at < text.size();) {
    if (const size_t length = PrintableLength(text, at); length > 0) {
      printable.append(text, at, length);
      at += length;
    } else {
      char escaped[5];
      std::snprintf(escaped, sizeof(escaped), "\\x%02x", static_cast<unsigned char>(text[at++]));
      printable += escaped;
    }
  }
  return printable;
}

}  // namespace imu_pose_calib
