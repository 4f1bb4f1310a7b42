#include "imu_pose_calib/ros/io/cdr.h"

#include <cstdio>

namespace imu_pose_calib {
namespace {

constexpr int64_t kMaxSeconds = std::numeric_limits<int32_t>::max();

}  // namespace

CdrInput::CdrInput(std::string_view message) {
  if (message.size() < cdr::kHeaderSize)
    throw InputError("it has " + std::to_string(message.size()) + " bytes, too few for CDR");
  const auto kind = static_cast<unsigned char>(message[1]);
  if (message[0] != 0 || kind > 1) {
    char text[8];
    std::snprintf(text, sizeof(text), "%02x %02x", static_cast<unsigned char>(message[0]), kind);
    const bool is_xcdr2 = message[0] == 0 && kind >= 6 && kind <= 11;
    throw InputError(std::string("its encoding is ") + text + (is_xcdr2 ? " (XCDR2)" : "") +
                     ", must be 00 00 or 00 01 (CDR)");
  }
  is_little_endian_ = kind == 1;
  fields_ = message.substr(cdr::kHeaderSize);
}

std::string CdrInput::String() {
  const uint32_t size = Count();
  if (size == 0) return "";  // written so by some, without the closing 0
  const char* text = Take(0, size);
  if (text[size - 1] != '\0') throw InputError("a text in it does not end with 0");
  return {text, size - 1};
}

ros::Time CdrInput::Stamp() {
  const auto seconds = Number<int32_t>();
  const auto nanoseconds = Number<uint32_t>();
  if (seconds < 0)
    throw InputError("a stamp in it is " + std::to_string(seconds) + " s, must not be negative");
  ros::Time stamp;
  stamp.sec = static_cast<uint32_t>(seconds);
  stamp.nsec = nanoseconds;
  return stamp;
}

uint32_t CdrInput::Count(size_t least) {
  const auto count = Number<uint32_t>();
  const size_t left = fields_.size() - at_;
  if (count > left / least)
    throw InputError("a length in it is " + std::to_string(count) + ", but only " +
                     std::to_string(left) + " bytes are left");
  return count;
}

void CdrInput::Finish() const {
  const size_t left = fields_.size() - at_;
  if (left > 3) throw InputError(std::to_string(left) + " bytes of it are left over");
}

const char* CdrInput::Take(size_t skip, size_t size) {
  const size_t left = fields_.size() - at_;
  if (left < skip || left - skip < size)
    throw InputError("its " + std::to_string(cdr::kHeaderSize + fields_.size()) +
                     " bytes are too few");
  const char* from = fields_.data() + at_ + skip;
  at_ += skip + size;
  return from;
}

void CdrOutput::Stamp(const ros::Time& stamp) {
  if (stamp.sec > kMaxSeconds)
    throw InputError("stamp " + std::to_string(stamp.sec) +
                     " s does not fit a message of ROS 2: must be at most " +
                     std::to_string(kMaxSeconds) + " s");
  next(static_cast<int32_t>(stamp.sec));
  next(stamp.nsec);
}

}  // namespace imu_pose_calib
