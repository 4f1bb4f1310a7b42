#pragma once

#include <algorithm>
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

/// Throws InputError when there are fewer bytes left.
inline void CheckLength(uint64_t size, uint64_t left) {
  if (size > left)
    throw InputError("a length in it goes beyond its end (" + std::to_string(size) + " of " +
                     std::to_string(left) + " bytes)");
}

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
    CheckLength(size, left_.size());
    const std::string_view bytes = left_.substr(0, size);
    left_.remove_prefix(size);
    return bytes;
  }

  /// Bytes after their number.
  std::string_view Text() { return Bytes(Number<uint32_t>()); }

  FieldReader Skip(uint64_t size) { return FieldReader(Bytes(size)); }

  std::string_view left() const { return left_; }
  uint64_t size() const { return left_.size(); }

 private:
  std::string_view left_;
};

/// The same of a file, from `at` to `end`, where a part can be skipped.
class FileReader {
 public:
  FileReader(InputFile* file, uint64_t at, uint64_t end)
      : file_(file), at_(std::min(at, end)), end_(end) {}

  template <typename T>
  T Number() {
    return FieldReader(Bytes(sizeof(T))).Number<T>();
  }

  /// Leaves out the next bytes, for which there is a reader of their own.
  FileReader Skip(uint64_t count) {
    CheckLength(count, size());
    at_ += count;
    return {file_, at_ - count, at_};
  }
  std::string Bytes(uint64_t count) { return file_->Read(Skip(count).at_, count); }
  std::string Text() { return Bytes(Number<uint32_t>()); }
  /// Some of the next bytes; empty: there are none left.
  std::string Piece() { return Bytes(std::min<uint64_t>(size(), 1 << 17)); }

  uint64_t at() const { return at_; }
  uint64_t size() const { return end_ - at_; }  ///< what is left

 private:
  InputFile* file_;
  uint64_t at_, end_;
};

/// A file of records, which may be in chunks that are compressed.
class RecordFile : public BagFile {
 public:
  std::string_view Read(const Entry& entry) override {
    if (entry.chunk == 0) return message_ = input_->Read(entry.at, entry.size);
    return Records(entry.chunk).substr(entry.at, entry.size);
  }

 protected:
  explicit RecordFile(std::unique_ptr<InputFile> input) : input_(std::move(input)) {}

  uint64_t size() const { return input_->size(); }
  FileReader From(uint64_t at) const { return {input_.get(), at, size()}; }

  /// Notes a chunk of `stored` bytes of the file, which unfolds to `size` bytes, and returns its
  /// number, from 1 on. `compression`: "bz2", "lz4", "zstd" or none. Throws InputError when the
  /// size cannot be.
  uint32_t AddChunk(std::string_view compression, FileReader stored, uint64_t size);

  /// What a chunk unfolds to, while no three others are asked for.
  std::string_view Records(uint32_t chunk);

 private:
  struct Chunk {
    std::string compression;
    FileReader stored;
    uint64_t size;
  };
  /// Chunks that overlap in time are read in turns; this many are kept.
  static constexpr size_t kKept = 4;

  std::unique_ptr<InputFile> input_;
  std::string message_;
  std::vector<Chunk> chunks_;
  std::array<std::pair<uint32_t, std::string>, kKept> kept_;
  size_t next_slot_ = 0;
};

}  // namespace imu_pose_calib
