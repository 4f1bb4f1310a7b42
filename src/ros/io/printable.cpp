#include "imu_pose_calib/ros/io/printable.h"

#include <boost/locale/utf.hpp>
#include <cstdio>

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

std::string Printable(const std::string& text) {
  std::string printable;
  for (auto at = text.begin(); at != text.end();) {
    auto end = at;
    if (IsPrintable(boost::locale::utf::utf_traits<char>::decode(end, text.end()))) {
      printable.append(at, end);
      at = end;
    } else {
      char escaped[5];
      std::snprintf(escaped, sizeof(escaped), "\\x%02x", static_cast<unsigned char>(*at++));
      printable += escaped;
    }
  }
  return printable;
}

}  // namespace imu_pose_calib
