#pragma once

/// Files of bags: which there are, what they hold and, of ROS 2, how they are written.

#include <algorithm>
#include <array>
#include <cstdint>
#include <fstream>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {

/// A file of a bag: what topics it has, where the messages are, and the bytes of each.
class BagFile {
 public:
  struct Topic {
    std::string name;
    std::string type;                   ///< as ROS 1 names it: "sensor_msgs/Imu"
    std::optional<std::string> md5sum;  ///< of the type's definition; none: of ROS 2
  };
  /// A message, and where the reader finds it.
  struct Entry {
    int64_t t_ns = 0;    ///< record time
    uint32_t topic = 0;  ///< index in topics()
    uint32_t chunk = 0;
    uint64_t at = 0, size = 0;
  };

  virtual ~BagFile() = default;
  const std::vector<Topic>& topics() const { return topics_; }
  const std::vector<Entry>& entries() const { return entries_; }  ///< in the order of the file
  /// What is to be said of the file; empty: nothing.
  const std::string& note() const { return note_; }
  /// What is wrong with the file, for when there are no messages at all.
  const std::string& problem() const { return problem_; }
  /// The bytes of a message, until the next call. Throws InputError when they cannot be had.
  virtual std::string_view Read(const Entry& entry) = 0;

 protected:
  std::vector<Topic> topics_;
  std::vector<Entry> entries_;
  std::string note_, problem_;
};

/// Most bytes that a chunk or a message may have.
constexpr uint64_t kMaxBlockSize = uint64_t{1} << 30;

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
      Reject("a length in it goes beyond its end (", count, " of ", size(), " bytes)");
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

/// The first bytes of files, and of what zstd has compressed.
constexpr std::string_view kRos1Magic = "#ROSBAG V";
constexpr std::string_view kMcapMagic("\x89MCAP0\r\n", 8);
constexpr std::string_view kSqliteMagic("SQLite format 3\0", 16);
constexpr std::string_view kZstdMagic = "\x28\xb5\x2f\xfd";

/// A file of a bag, by its first bytes: of ROS 1, mcap or a database of SQLite (.db3), whole or
/// compressed by zstd. Throws InputError naming the file.
std::unique_ptr<BagFile> OpenBagFile(const std::string& path);

/// The contents of zstd frames. Memory is taken as they unfold, up to `max_size`. Throws InputError
/// with the reason, without a name.
std::string DecompressZstd(std::string_view bytes, uint64_t max_size);

/// A bag of ROS 1, version 2.0. What is cut off, or has no index, is read as far as it is whole,
/// and `note()` says so. Throws InputError with `name`, the reason and the remedy.
std::unique_ptr<BagFile> OpenRos1(std::unique_ptr<InputFile> input, const std::string& name);

/// An mcap file. One that is cut off is read up to there, and `note()` says so. Throws InputError
/// with `name` and the place in the file when it is damaged otherwise.
std::unique_ptr<BagFile> OpenMcap(std::unique_ptr<InputFile> input, const std::string& name);

/// The database of rosbag2 (.db3) at `path`. Throws InputError with `name` and SQLite's words.
std::unique_ptr<BagFile> OpenSqlite(const std::string& path, const std::string& name);

/// "sensor_msgs/Imu" for "sensor_msgs/msg/Imu", with what it is encoded in unless that is "cdr".
std::string Ros1Type(std::string type, const std::string& encoding);

/// How a bag of ROS 2 is stored.
enum class Ros2Format { kMcap, kSqlite };

/// Where encoded messages go.
class Ros2Storage {
 public:
  virtual ~Ros2Storage() = default;
  /// Announces a topic, which gets the next number from 0 on.
  virtual void AddTopic(const std::string& name, const std::string& type,
                        const std::string& definition) = 0;
  /// In the order of time.
  virtual void Write(uint32_t topic, int64_t t_ns, const std::string& data) = 0;
  virtual void Close() = 0;
};

/// Both throw InputError with `path` when it cannot be written; so do their members.
std::unique_ptr<Ros2Storage> CreateMcap(const std::string& path);
std::unique_ptr<Ros2Storage> CreateSqlite(const std::string& path);

/// The files that hold the messages of a bag: itself or, of a folder, what its metadata.yaml names
/// or, without one, all files of ROS 2 in it; none when it is no bag. Throws InputError when that
/// names what is not there.
std::vector<std::string> MessageFiles(const std::string& path);

/// The bag's path without the ending that files of its kind have.
std::string WithoutBagEnding(const std::string& path);

/// "A.bag, B.bag" for error messages.
std::string FileNames(const std::vector<std::string>& paths);

/// Throws InputError when one of these is not there, or is given twice.
void CheckBagsExist(const std::vector<std::string>& paths);

}  // namespace imu_pose_calib
