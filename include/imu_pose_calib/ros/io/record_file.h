#pragma once

#include <array>
#include <memory>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/bag_file.h"
#include "imu_pose_calib/ros/io/compression.h"

namespace imu_pose_calib {

/// Fields one after the other, numbers little endian. Throws InputError where there are no more.
class FieldReader {
 public:
  explicit FieldReader(std::string_view left) : left_(left) {}

  template <typename T>
  T Number() {
    const std::string_view bytes = Bytes(sizeof(T));
    uint64_t value = 0;
    for (size_t k = sizeof(T); k-- > 0;) value = value << 8 | static_cast<unsigned char>(bytes[k]);
    return static_cast<T>(value);
  }

  std::string_view Bytes(uint64_t size) {
    if (size > left_.size())
      throw InputError("a length in it goes beyond its end (" + std::to_string(size) + " of " +
                       std::to_string(left_.size()) + " bytes)");
    const std::string_view bytes = left_.substr(0, size);
    left_.remove_prefix(size);
    return bytes;
  }

  /// Bytes after their number.
  std::string_view Text() { return Bytes(Number<uint32_t>()); }

  std::string_view left() const { return left_; }

 private:
  std::string_view left_;
};

/// A file of records, which may be in chunks that are compressed.
class RecordFile : public BagFile {
 public:
  std::string_view Read(const Entry& entry) override {
    return Records(entry.chunk).substr(entry.at, entry.size);
  }

 protected:
  explicit RecordFile(std::unique_ptr<InputFile> input) : input_(std::move(input)) {}

  std::string_view bytes() const { return input_->bytes(); }  ///< all of the file

  /// Notes a chunk, which unfolds to `size` bytes, and returns its number, from 1 on.
  /// `compression`: "bz2", "lz4", "zstd" or none. Throws InputError when the size cannot be.
  uint32_t AddChunk(std::string_view compression, std::string_view stored, uint64_t size);

  /// What a chunk unfolds to, while no three others are asked for; of number 0 the file.
  std::string_view Records(uint32_t chunk);

 private:
  struct Chunk {
    std::string_view compression, stored;
    uint64_t size;
  };
  /// Chunks that overlap in time are read in turns; this many are kept.
  static constexpr size_t kKept = 4;

  std::unique_ptr<InputFile> input_;
  std::vector<Chunk> chunks_;
  std::array<std::pair<uint32_t, std::string>, kKept> kept_;
  size_t next_slot_ = 0;
};

}  // namespace imu_pose_calib
