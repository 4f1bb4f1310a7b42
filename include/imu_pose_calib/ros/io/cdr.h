#pragma once

#include <ros/message_traits.h>
#include <ros/serialization.h>
#include <ros/time.h>
#include <std_msgs/Header.h>

#include <boost/array.hpp>
#include <cstdint>
#include <cstring>
#include <limits>
#include <string>
#include <string_view>
#include <type_traits>
#include <vector>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// Messages of ROS 2 in their encoding, CDR (OMG's classic one, XCDR version 1): four bytes that
/// say which, then the fields of the message one after the other, each number at a multiple of its
/// size. The ROS 1 serializers of the messages list the fields, which are the same but for the
/// header, which has no `seq` in ROS 2.
namespace cdr {

template <typename T>
struct IsVector : std::false_type {};
template <typename T, typename Allocator>
struct IsVector<std::vector<T, Allocator>> : std::true_type {};

template <typename T>
struct IsArray : std::false_type {};
template <typename T, size_t N>
struct IsArray<boost::array<T, N>> : std::true_type {};

constexpr size_t kHeaderSize = 4;

}  // namespace cdr

/// Reads the fields of one message. Throws InputError, without a name, when the bytes are not what
/// is asked for; no length is believed before the bytes are known to be there.
class CdrInput {
 public:
  explicit CdrInput(std::string_view message);

  template <typename T>
  T Number() {
    static_assert(std::is_arithmetic_v<T>);
    const char* from = Take((sizeof(T) - at_ % sizeof(T)) % sizeof(T), sizeof(T));
    char bytes[sizeof(T)];
    for (size_t k = 0; k < sizeof(T); ++k)
      bytes[k] = from[is_little_endian_ == kHostIsLittleEndian ? k : sizeof(T) - 1 - k];
    T value;
    std::memcpy(&value, bytes, sizeof(T));
    return value;
  }

  std::string String();
  ros::Time Stamp();
  /// Number of elements of a sequence, each of at least `least` bytes.
  uint32_t Count(size_t least = 1);

  /// Reads a field of any type; roscpp's serializers prescribe the name.
  template <typename T>
  void next(T& value) {  // NOLINT(readability-identifier-naming)
    if constexpr (std::is_arithmetic_v<T>) {
      value = Number<T>();
    } else if constexpr (std::is_same_v<T, std::string>) {
      value = String();
    } else if constexpr (std::is_same_v<T, ros::Time>) {
      value = Stamp();
    } else if constexpr (std::is_same_v<T, std_msgs::Header>) {
      value.stamp = Stamp();
      value.frame_id = String();
    } else if constexpr (cdr::IsArray<T>::value) {
      for (auto& element : value) next(element);
    } else if constexpr (cdr::IsVector<T>::value) {
      Sequence(value);
    } else {
      ros::serialization::Serializer<T>::template allInOne<CdrInput, T&>(*this, value);
    }
  }

  /// Throws when more is left than the bytes that fill the last four.
  void Finish() const;

 private:
  static constexpr bool kHostIsLittleEndian = __BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__;

  template <typename T>
  void Sequence(std::vector<T>& values) {
    if constexpr (sizeof(T) == 1) {
      const uint32_t count = Count();
      const char* from = Take(0, count);
      values.assign(from, from + count);
    } else {
      const uint32_t count = Count(std::is_arithmetic_v<T> ? sizeof(T) : 1);
      values.clear();
      for (uint32_t k = 0; k < count; ++k) {  // grows as far as there are bytes for it
        values.emplace_back();
        next(values.back());
      }
    }
  }

  /// The next `size` bytes after those skipped.
  const char* Take(size_t skip, size_t size);

  std::string_view fields_;
  size_t at_ = 0;  ///< in the fields
  bool is_little_endian_ = true;
};

/// Writes the fields of one message, little endian.
class CdrOutput {
 public:
  template <typename T>
  void next(const T& value) {  // NOLINT(readability-identifier-naming)
    if constexpr (std::is_arithmetic_v<T>) {
      fields_.append((sizeof(T) - fields_.size() % sizeof(T)) % sizeof(T), '\0');
      fields_.append(reinterpret_cast<const char*>(&value), sizeof(T));
    } else if constexpr (std::is_same_v<T, std::string>) {
      next(static_cast<uint32_t>(value.size() + 1));
      fields_.append(value.c_str(), value.size() + 1);
    } else if constexpr (std::is_same_v<T, ros::Time>) {
      Stamp(value);
    } else if constexpr (std::is_same_v<T, std_msgs::Header>) {
      Stamp(value.stamp);
      next(value.frame_id);
    } else if constexpr (cdr::IsArray<T>::value) {
      for (const auto& element : value) next(element);
    } else if constexpr (cdr::IsVector<T>::value) {
      next(static_cast<uint32_t>(value.size()));
      for (const auto& element : value) next(element);
    } else {
      ros::serialization::Serializer<T>::template allInOne<CdrOutput, const T&>(*this, value);
    }
  }

  /// The whole message.
  std::string Message() const { return std::string("\0\1\0\0", cdr::kHeaderSize) + fields_; }

 private:
  void Stamp(const ros::Time& stamp);

  std::string fields_;
};

template <typename Msg>
Msg FromCdr(std::string_view message) {
  CdrInput input(message);
  Msg msg;
  input.next(msg);
  input.Finish();
  return msg;
}

template <typename Msg>
std::string ToCdr(const Msg& msg) {
  CdrOutput output;
  output.next(msg);
  return output.Message();
}

}  // namespace imu_pose_calib
