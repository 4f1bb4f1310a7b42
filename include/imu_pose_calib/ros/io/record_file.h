#pragma once

#include <deque>
#include <map>
#include <memory>
#include <string>
#include <string_view>
#include <utility>

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

/// A file of records, of which some are chunks of others, which may be compressed.
class RecordFile : public BagFile {
 public:
  std::string_view Read(const Entry& entry) override {
    return Records(entry.chunk).substr(entry.at, entry.size);
  }

 protected:
  /// `remedy`: what can be done about a damaged file; ends the errors.
  RecordFile(std::unique_ptr<InputFile> input, const std::string& name, const std::string& remedy)
      : input_(std::move(input)), name_(name), remedy_(remedy) {}

  std::string_view bytes() const { return input_->bytes(); }  ///< all of the file

  /// Reads the records from byte `begin` on. What is cut off or has no index is noted; throws
  /// InputError with the place when the file is damaged otherwise.
  void ReadFile(size_t begin);

  /// Reads the record that `left` begins with, which is in a chunk or, 0, in none, and cuts it off.
  /// False when it is not whole.
  virtual bool ReadRecord(uint32_t chunk, std::string_view* left) = 0;

  /// Reads the records of a chunk, which unfolds to `size` bytes. `compression`: empty for none.
  void AddChunk(const std::string& compression, std::string_view stored, uint64_t size,
                uint32_t crc);

  /// `expected`: 0 for none. `what` names the bytes.
  static void CheckCrc(std::string_view checked, uint32_t expected, const char* what);

  /// The topic that messages of a channel are of; may be told more than once.
  void AddChannel(uint32_t id, const Topic& topic);
  void AddMessage(uint32_t channel, int64_t t_ns, uint32_t chunk, std::string_view data);

  bool is_complete_ = false;  ///< what a recorder writes last is there

 private:
  struct Chunk {
    std::string compression;
    std::string_view stored;
    uint64_t size;
    std::string records = {};  ///< what it unfolds to, while that is kept
  };
  /// Most that is kept of what chunks unfold to [bytes]: what is read again soon, as chunks that
  /// overlap in time are, and bags that are not large.
  static constexpr uint64_t kMaxKept = 1 << 28;

  /// What a chunk unfolds to, until another is asked for; of number 0 the file.
  std::string_view Records(uint32_t chunk);

  std::unique_ptr<InputFile> input_;
  std::string name_, remedy_;
  std::map<uint32_t, uint32_t> channels_;  ///< index of the topic
  std::deque<Chunk> chunks_;               ///< numbered from 1 on
  std::deque<Chunk*> kept_;
  uint64_t kept_size_ = 0;  ///< [bytes]
};

}  // namespace imu_pose_calib
