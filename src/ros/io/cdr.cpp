#include "imu_pose_calib/ros/io/cdr.h"

#include <limits>

#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kHeaderSize = 4;

}  // namespace

MessageInput::MessageInput(std::string_view message, bool is_cdr)
    : fields_(message), is_cdr_(is_cdr) {
  if (!is_cdr) return;
  if (message.size() < kHeaderSize)
    Throw<InputError>("it has ", message.size(), " bytes, too few for CDR");
  const auto kind = static_cast<unsigned char>(message[1]);
  if (message[0] != 0 || kind > 1) {
    const bool is_xcdr2 = message[0] == 0 && kind >= 6 && kind <= 11;
    Reject(Format("its encoding is %02x %02x%s, must be 00 00 or 00 01 (CDR)",
                  static_cast<unsigned char>(message[0]), kind, is_xcdr2 ? " (XCDR2)" : ""));
  }
  is_swapped_ = kind == 0;  // big endian
  fields_.remove_prefix(kHeaderSize);
}

void MessageInput::next(std::string& text) {
  const uint32_t size = Count();
  const char* from = Take(1, size);
  if (!is_cdr_) {
    text.assign(from, size);
    return;
  }
  if (size > 0 && from[size - 1] != '\0') Reject("a text in it does not end with 0");
  text.assign(from, size > 0 ? size - 1 : 0);  // an empty one is written without the 0 by some
}

void MessageInput::next(ros::Time& stamp) {
  next(stamp.sec);
  next(stamp.nsec);
  const auto seconds = static_cast<int32_t>(stamp.sec);  // as ROS 2 has them
  if (is_cdr_ && seconds < 0) Reject("a stamp in it is ", seconds, " s, must not be negative");
}

uint32_t MessageInput::Count() {
  uint32_t count = 0;
  next(count);
  const size_t left = fields_.size() - at_;
  if (count > left) Reject("a length in it is ", count, ", but only ", left, " bytes are left");
  return count;
}

void MessageInput::Finish() const {
  const size_t left = fields_.size() - at_;
  if (left > (is_cdr_ ? 3 : 0)) Reject(left, " bytes of it are left over");
}

const char* MessageInput::Take(size_t alignment, size_t size) {
  const size_t begin = is_cdr_ ? (at_ + alignment - 1) / alignment * alignment : at_;
  if (begin > fields_.size() || fields_.size() - begin < size)
    Reject("its ", (is_cdr_ ? kHeaderSize : 0) + fields_.size(), " bytes are too few");
  at_ = begin + size;
  return fields_.data() + begin;
}

void CdrOutput::next(const ros::Time& stamp) {
  constexpr int64_t kMaxSeconds = std::numeric_limits<int32_t>::max();
  if (stamp.sec > kMaxSeconds)
    Reject("stamp ", stamp.sec, " s does not fit a message of ROS 2: must be at most ", kMaxSeconds,
           " s");
  next(static_cast<int32_t>(stamp.sec));
  next(stamp.nsec);
}

std::string CdrOutput::Message() const { return std::string("\0\1\0\0", kHeaderSize) + fields_; }

}  // namespace imu_pose_calib
