#pragma once

#include <ros/message_traits.h>
#include <ros/serialization.h>
#include <ros/time.h>
#include <std_msgs/Header.h>

#include <boost/array.hpp>
#include <cstdint>
#include <cstring>
#include <string>
#include <string_view>
#include <type_traits>
#include <vector>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// Messages in their encodings. ROS 2 has CDR (OMG's classic one, XCDR version 1): four bytes that
/// say which, then the fields of the message one after the other, each number at a multiple of its
/// size. Those of ROS 1 follow each other without gaps, and texts have no 0 at their end. The ROS 1
/// serializers of the messages list the fields, and prescribe the name next(); they are the same
/// but for the header, which has no `seq` in ROS 2.
// NOLINTBEGIN(readability-identifier-naming)

/// Reads the fields of one message. Throws InputError, without a name, when the bytes are not what
/// is asked for; no length is believed before the bytes are known to be there.
class MessageInput {
 public:
  /// `is_cdr`: else of ROS 1.
  MessageInput(std::string_view message, bool is_cdr);

  void next(std::string& text);
  void next(ros::Time& stamp);
  void next(std_msgs::Header& header) {
    if (!is_cdr_) next(header.seq);
    next(header.stamp);
    next(header.frame_id);
  }
  template <typename T, size_t N>
  void next(boost::array<T, N>& values) {
    for (T& value : values) next(value);
  }
  template <typename T>
  void next(std::vector<T>& values) {
    const uint32_t count = Count();
    if constexpr (sizeof(T) == 1) {
      const char* from = Take(1, count);
      values.assign(from, from + count);
    } else {
      values.clear();
      for (uint32_t k = 0; k < count; ++k)  // grows as far as there are bytes for it
        next(values.emplace_back());
    }
  }
  template <typename T>
  void next(T& value) {
    if constexpr (std::is_arithmetic_v<T>) {
      const char* from = Take(sizeof(T), sizeof(T));
      char bytes[sizeof(T)];
      for (size_t k = 0; k < sizeof(T); ++k) bytes[is_swapped_ ? sizeof(T) - 1 - k : k] = from[k];
      std::memcpy(&value, bytes, sizeof(T));
    } else {
      ros::serialization::Serializer<T>::template allInOne<MessageInput, T&>(*this, value);
    }
  }

  /// Number of elements of a sequence.
  uint32_t Count();

  /// Throws when more is left than the bytes that fill the last four.
  void Finish() const;

 private:
  /// The next `size` bytes, from the next multiple of `alignment` on.
  const char* Take(size_t alignment, size_t size);

  std::string_view fields_;
  size_t at_ = 0;  ///< in the fields
  bool is_cdr_, is_swapped_ = false;
};

/// Writes the fields of one message.
class CdrOutput {
 public:
  void next(const std::string& text) {
    next(static_cast<uint32_t>(text.size() + 1));
    fields_.append(text.c_str(), text.size() + 1);
  }
  void next(const ros::Time& stamp);
  void next(const std_msgs::Header& header) {
    next(header.stamp);
    next(header.frame_id);
  }
  template <typename T, size_t N>
  void next(const boost::array<T, N>& values) {
    for (const T& value : values) next(value);
  }
  template <typename T>
  void next(const std::vector<T>& values) {
    next(static_cast<uint32_t>(values.size()));
    for (const T& value : values) next(value);
  }
  template <typename T>
  void next(const T& value) {
    if constexpr (std::is_arithmetic_v<T>) {
      fields_.append((sizeof(T) - fields_.size() % sizeof(T)) % sizeof(T), '\0');
      fields_.append(reinterpret_cast<const char*>(&value), sizeof(T));
    } else {
      ros::serialization::Serializer<T>::template allInOne<CdrOutput, const T&>(*this, value);
    }
  }

  /// The whole message.
  std::string Message() const;

 private:
  std::string fields_;
};
// NOLINTEND(readability-identifier-naming)

template <typename Msg>
std::string ToCdr(const Msg& msg) {
  CdrOutput output;
  output.next(msg);
  return output.Message();
}

}  // namespace imu_pose_calib
