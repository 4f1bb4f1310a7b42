#include "imu_pose_calib/ros/io/cdr.h"

#include <limits>

#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kHeaderSize = 4;

}  // namespace

CdrInput::CdrInput(std::string_view message) {
  if (message.size() < kHeaderSize)
    throw InputError("it has " + std::to_string(message.size()) + " bytes, too few for CDR");
  const auto kind = static_cast<unsigned char>(message[1]);
  if (message[0] != 0 || kind > 1) {
    const bool is_xcdr2 = message[0] == 0 && kind >= 6 && kind <= 11;
    throw InputError(Format("its encoding is %02x %02x%s, must be 00 00 or 00 01 (CDR)",
                            static_cast<unsigned char>(message[0]), kind,
                            is_xcdr2 ? " (XCDR2)" : ""));
  }
  is_swapped_ = kind == 0;  // big endian
  fields_ = message.substr(kHeaderSize);
}

void CdrInput::next(std::string& text) {
  const uint32_t size = Count();
  const char* from = Take(1, size);
  if (size > 0 && from[size - 1] != '\0') throw InputError("a text in it does not end with 0");
  text.assign(from, size > 0 ? size - 1 : 0);  // an empty one is written without the 0 by some
}

void CdrInput::next(ros::Time& stamp) {
  int32_t seconds = 0;
  next(seconds);
  next(stamp.nsec);
  if (seconds < 0)
    throw InputError("a stamp in it is " + std::to_string(seconds) + " s, must not be negative");
  stamp.sec = static_cast<uint32_t>(seconds);
}

uint32_t CdrInput::Count(size_t least) {
  uint32_t count = 0;
  next(count);
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

const char* CdrInput::Take(size_t alignment, size_t size) {
  const size_t begin = (at_ + alignment - 1) / alignment * alignment;
  if (begin > fields_.size() || fields_.size() - begin < size)
    throw InputError("its " + std::to_string(kHeaderSize + fields_.size()) + " bytes are too few");
  at_ = begin + size;
  return fields_.data() + begin;
}

void CdrOutput::next(const ros::Time& stamp) {
  constexpr int64_t kMaxSeconds = std::numeric_limits<int32_t>::max();
  if (stamp.sec > kMaxSeconds)
    throw InputError("stamp " + std::to_string(stamp.sec) +
                     " s does not fit a message of ROS 2: must be at most " +
                     std::to_string(kMaxSeconds) + " s");
  next(static_cast<int32_t>(stamp.sec));
  next(stamp.nsec);
}

std::string CdrOutput::Message() const { return std::string("\0\1\0\0", kHeaderSize) + fields_; }

}  // namespace imu_pose_calib
