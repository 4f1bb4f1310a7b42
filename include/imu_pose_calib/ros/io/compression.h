#pragma once

#include <boost/interprocess/mapped_region.hpp>
#include <cstdint>
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

/// A file to read from, as if all of it were in memory. What is compressed by zstd as a whole is
/// first unfolded into a temporary file.
class InputFile {
 public:
  /// Throws InputError naming the file.
  explicit InputFile(const std::string& path);

  std::string_view bytes() const {
    return {static_cast<const char*>(region_.get_address()), region_.get_size()};
  }
  /// Where the bytes are: the path given, or that of the temporary file.
  const std::string& path() const { return path_; }
  /// So that none is left behind whatever becomes of this process; the bytes stay.
  void RemoveTemporary() { folder_.reset(); }

 private:
  void Map();

  std::string path_;
  std::optional<TemporaryFolder> folder_;
  boost::interprocess::mapped_region region_;
};

}  // namespace imu_pose_calib
