#pragma once

#include <cstdint>
#include <string>
#include <string_view>

namespace imu_pose_calib {

/// Most bytes that a chunk or a message may have.
constexpr uint64_t kMaxBlockSize = uint64_t{1} << 30;

/// Whether these are the first bytes of a zstd frame.
bool IsZstd(std::string_view bytes);

/// The contents of zstd or lz4 frames. Memory is taken as they unfold, up to `max_size`. Throws
/// InputError with the reason, without a name.
std::string DecompressZstd(std::string_view bytes, uint64_t max_size);
std::string DecompressLz4(std::string_view bytes, uint64_t max_size);

/// One frame.
std::string CompressZstd(std::string_view bytes);
std::string CompressLz4(std::string_view bytes);

/// A file to read from, as if all of it were in memory. What is compressed by zstd as a whole is
/// first unfolded into a temporary file.
class InputFile {
 public:
  /// Throws InputError naming the file.
  explicit InputFile(const std::string& path);
  InputFile(const InputFile&) = delete;
  InputFile& operator=(const InputFile&) = delete;
  ~InputFile();

  std::string_view bytes() const { return bytes_; }
  /// Where the bytes are: the path given, or that of the temporary file.
  const std::string& path() const { return path_; }
  /// Lets go of the name of the temporary file, if there is one, so that none is left behind
  /// whatever becomes of this process. At the latest this is done when the object goes.
  void RemoveTemporary();

 private:
  std::string path_, temporary_;
  std::string_view bytes_;
};

}  // namespace imu_pose_calib
