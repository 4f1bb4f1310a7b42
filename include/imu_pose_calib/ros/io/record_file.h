#pragma once

#include <algorithm>
#include <array>
#include <fstream>
#include <memory>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/bag_file.h"

namespace imu_pose_calib {

/// Most bytes that a chunk or a message may have.
constexpr uint64_t kMaxBlockSize = uint64_t{1} << 30;

/// The contents of zstd frames. Memory is taken as they unfold, up to `max_size`. Throws InputError
/// with the reason, without a name.
std::string DecompressZstd(std::string_view bytes, uint64_t max_size);

/// A file to read from.
class InputFile {
 public:
  /// Throws InputError naming the file.
  explicit InputFile(const std::string& path);

  uint64_t size() const { return size_; }  ///< when it was opened
  /// Bytes of it. Throws InputError naming the file when they cannot be read, as after it has
  /// become shorter.
  std::string Read(uint64_t at, uint64_t size);
  /// The first bytes, which tell what it is.
  std::string Start() { return Read(0, std::min<uint64_t>(size_, 16)); }

 private:
  std::string path_;
  std::ifstream file_;
  uint64_t next_ = 0;  ///< where `file_` goes on
  uint64_t size_ = 0;
};

/// Bytes of a file, or in memory, of which fields are read one after the other, numbers little
/// endian. Throws InputError where there are no more.
class ByteReader {
 public:
  explicit ByteReader(std::string_view memory) : memory_(memory), end_(memory.size()) {}
  ByteReader(InputFile* file, uint64_t at)
      : file_(file), at_(std::min(at, file->size())), end_(file->size()) {}

  uint64_t at() const { return at_; }
  uint64_t size() const { return end_ - at_; }  ///< what is left

  /// Leaves out the next bytes, for which there is a reader of their own.
  ByteReader Skip(uint64_t count) {
    if (count > size())
      throw InputError("a length in it goes beyond its end (" + std::to_string(count) + " of " +
                       std::to_string(size()) + " bytes)");
    ByteReader part = *this;
    at_ += count;
    part.end_ = at_;
    return part;
  }
  /// The same of bytes after their number.
  ByteReader Part() { return Skip(Number<uint32_t>()); }

  std::string Bytes(uint64_t count) {
    const uint64_t at = Skip(count).at_;
    return file_ ? file_->Read(at, count) : std::string(memory_.substr(at, count));
  }
  std::string All() { return Bytes(size()); }
  /// Some of the next bytes; empty: there are none left.
  std::string Piece() { return Bytes(std::min<uint64_t>(size(), 1 << 17)); }

  template <typename T>
  T Number() {
    const std::string bytes = Bytes(sizeof(T));
    uint64_t value = 0;
    for (size_t k = sizeof(T); k-- > 0;) value = value << 8 | static_cast<unsigned char>(bytes[k]);
    return static_cast<T>(value);
  }

 private:
  InputFile* file_ = nullptr;  ///< null: in memory
  std::string_view memory_;
  uint64_t at_ = 0, end_;
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
  ByteReader From(uint64_t at) const { return {input_.get(), at}; }

  /// Notes a chunk of `stored` bytes of the file, which unfolds to `size` bytes, and returns its
  /// number, from 1 on. `compression`: "bz2", "lz4", "zstd" or none. Throws InputError when the
  /// size cannot be.
  uint32_t AddChunk(std::string_view compression, ByteReader stored, uint64_t size);

  /// What a chunk unfolds to, while no three others are asked for.
  std::string_view Records(uint32_t chunk);

  /// Notes that the file is whole up to there.
  void NoteCutOff(const std::string& name, uint64_t end);

 private:
  struct Chunk {
    std::string compression;
    ByteReader stored;
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
