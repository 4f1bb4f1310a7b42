#pragma once

#include <cstdint>
#include <fstream>
#include <optional>
#include <string>
#include <string_view>

#include "imu_pose_calib/ros/io/output_files.h"

namespace imu_pose_calib {

/// Most bytes that a chunk or a message may have.
constexpr uint64_t kMaxBlockSize = uint64_t{1} << 30;

/// Whether these are the first bytes of a zstd frame.
bool IsZstd(std::string_view bytes);

/// The contents of zstd or lz4 frames. Memory is taken as they unfold, up to `max_size`. Throws
/// InputError with the reason, without a name.
std::string DecompressZstd(std::string_view bytes, uint64_t max_size);
std::string DecompressLz4(std::string_view bytes, uint64_t max_size);
/// The same of bz2, filled up to `size`.
std::string DecompressBz2(std::string_view bytes, uint64_t size);

/// A file to read from. What is compressed by zstd as a whole is first unfolded into a temporary
/// file.
class InputFile {
 public:
  /// Throws InputError naming the file.
  explicit InputFile(const std::string& path);

  uint64_t size() const { return size_; }  ///< when it was opened
  /// Bytes of it. Throws InputError naming the file when they cannot be read, as after it has
  /// become shorter.
  std::string Read(uint64_t at, uint64_t size);
  /// The first bytes, which tell what it is.
  std::string Start();
  /// Where the bytes are: the path given, or that of the temporary file.
  const std::string& path() const { return path_; }
  /// So that none is left behind whatever becomes of this process; the bytes stay.
  void RemoveTemporary() { folder_.reset(); }

 private:
  void Open();

  std::string path_;
  std::optional<TemporaryFolder> folder_;
  std::ifstream file_;
  uint64_t next_ = 0;  ///< where `file_` goes on
  uint64_t size_ = 0;
};

}  // namespace imu_pose_calib
