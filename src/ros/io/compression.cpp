#include "imu_pose_calib/ros/io/compression.h"

#include <lz4frame.h>
#include <rosbag/chunked_file.h>
#include <rosbag/stream.h>
#include <zstd.h>

#include <algorithm>
#include <boost/interprocess/file_mapping.hpp>
#include <cerrno>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <memory>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {
namespace {

/// Unfolds zstd frames into a file.
void UnzstdInto(const std::string& path, std::string_view bytes) {
  const std::unique_ptr<ZSTD_DStream, size_t (*)(ZSTD_DStream*)> stream(ZSTD_createDStream(),
                                                                        ZSTD_freeDStream);
  std::ofstream file(path, std::ios::binary);
  std::string piece(ZSTD_DStreamOutSize(), '\0');
  ZSTD_inBuffer in{bytes.data(), bytes.size(), 0};
  const uint64_t max_size = kMaxBlockSize + 100 * bytes.size();
  uint64_t size = 0;
  for (bool has_more = true; has_more;) {
    ZSTD_outBuffer out{piece.data(), piece.size(), 0};
    const size_t wanted = ZSTD_decompressStream(stream.get(), &out, &in);
    if (ZSTD_isError(wanted)) throw InputError(std::string("zstd: ") + ZSTD_getErrorName(wanted));
    has_more = in.pos < in.size || (wanted != 0 && out.pos == out.size);
    if (!has_more && wanted != 0) throw InputError("zstd: it is cut off");
    if ((size += out.pos) > max_size)
      throw InputError("unfolds to more than " + std::to_string(max_size) + " bytes");
    file.write(piece.data(), static_cast<std::streamsize>(out.pos));
  }
  file.close();
  if (!file)
    throw InputError(std::string("cannot be unfolded into a temporary file: ") +
                     std::strerror(errno));
}

}  // namespace

bool IsZstd(std::string_view bytes) { return bytes.substr(0, 4) == "\x28\xb5\x2f\xfd"; }

std::string DecompressZstd(std::string_view bytes, uint64_t max_size) {
  const uint64_t stated = ZSTD_getFrameContentSize(bytes.data(), bytes.size());  // huge: not stated
  std::string contents(std::min(stated, max_size), '\0');
  const size_t size = ZSTD_decompress(contents.data(), contents.size(), bytes.data(), bytes.size());
  if (ZSTD_isError(size)) throw InputError(std::string("zstd: ") + ZSTD_getErrorName(size));
  contents.resize(size);
  return contents;
}

std::string DecompressLz4(std::string_view bytes, uint64_t max_size) {
  LZ4F_dctx* raw = nullptr;
  if (LZ4F_isError(LZ4F_createDecompressionContext(&raw, LZ4F_VERSION))) throw std::bad_alloc();
  const std::unique_ptr<LZ4F_dctx, LZ4F_errorCode_t (*)(LZ4F_dctx*)> context(
      raw, LZ4F_freeDecompressionContext);
  std::string contents(max_size, '\0');
  size_t end = 0, wanted = 1;
  for (size_t in = 1, out = 1; wanted != 0 && in + out > 0; end += out) {
    in = bytes.size();
    out = max_size - end;
    wanted =
        LZ4F_decompress(context.get(), contents.data() + end, &out, bytes.data(), &in, nullptr);
    if (LZ4F_isError(wanted)) throw InputError(std::string("lz4: ") + LZ4F_getErrorName(wanted));
    bytes.remove_prefix(in);
  }
  if (wanted != 0)
    throw InputError("lz4: it is cut off, or unfolds to more than " + std::to_string(max_size) +
                     " bytes");
  contents.resize(end);
  return contents;
}

std::string DecompressBz2(std::string_view bytes, uint64_t size) {
  std::string contents(size, '\0');
  rosbag::ChunkedFile none;
  try {
    rosbag::BZ2Stream(&none).decompress(reinterpret_cast<uint8_t*>(contents.data()),
                                        static_cast<unsigned>(size),
                                        reinterpret_cast<uint8_t*>(const_cast<char*>(bytes.data())),
                                        static_cast<unsigned>(bytes.size()));
  } catch (const rosbag::BagException& error) {
    throw InputError(std::string("bz2: ") + error.what());
  }
  return contents;
}

InputFile::InputFile(const std::string& path) : path_(path) {
  Map();
  if (!IsZstd(bytes())) return;
  folder_.emplace();
  path_ = folder_->path() / "unfolded";
  try {
    UnzstdInto(path_, bytes());
  } catch (const InputError& error) {
    throw InputError("'" + path + "': " + error.what());
  }
  Map();
}

void InputFile::Map() {
  namespace ipc = boost::interprocess;
  try {
    const ipc::file_mapping file(path_.c_str(), ipc::read_only);
    if (std::filesystem::file_size(path_) > 0) region_ = ipc::mapped_region(file, ipc::read_only);
  } catch (const std::exception& error) {
    throw InputError("'" + path_ + "' cannot be read: " + error.what());
  }
}

}  // namespace imu_pose_calib
