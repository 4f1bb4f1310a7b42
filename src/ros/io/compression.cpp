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
#include <functional>
#include <memory>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kStep = 1 << 17;  // [bytes] unfolded at a time

void CheckSize(uint64_t size, uint64_t max_size) {
  if (size > max_size)
    throw InputError("unfolds to more than " + std::to_string(max_size) + " bytes");
}

/// Unfolds zstd frames, calling `use` with a piece at a time.
void Unzstd(std::string_view bytes, uint64_t max_size,
            const std::function<void(std::string_view)>& use) {
  const std::unique_ptr<ZSTD_DStream, size_t (*)(ZSTD_DStream*)> stream(ZSTD_createDStream(),
                                                                        ZSTD_freeDStream);
  std::string piece(kStep, '\0');
  ZSTD_inBuffer in{bytes.data(), bytes.size(), 0};
  for (uint64_t size = 0;;) {
    ZSTD_outBuffer out{piece.data(), piece.size(), 0};
    const size_t left = ZSTD_decompressStream(stream.get(), &out, &in);
    if (ZSTD_isError(left)) throw InputError(std::string("zstd: ") + ZSTD_getErrorName(left));
    CheckSize(size += out.pos, max_size);
    use(std::string_view(piece).substr(0, out.pos));
    if (in.pos < in.size || (left != 0 && out.pos == out.size)) continue;  // more to come
    if (left != 0) throw InputError("zstd: it is cut off");
    return;
  }
}

void UnzstdInto(const std::string& path, std::string_view bytes) {
  std::ofstream file(path, std::ios::binary);
  const auto check = [&] {
    if (!file)
      throw InputError(std::string("cannot be unfolded into a temporary file: ") +
                       std::strerror(errno));
  };
  Unzstd(bytes, kMaxBlockSize + 100 * bytes.size(), [&](std::string_view piece) {
    file << piece;
    check();
  });
  file.close();
  check();
}

}  // namespace

bool IsZstd(std::string_view bytes) { return bytes.substr(0, 4) == "\x28\xb5\x2f\xfd"; }

std::string DecompressZstd(std::string_view bytes, uint64_t max_size) {
  std::string contents;
  // As most messages are, for which a stream would take longer to set up than to run.
  const uint64_t stated = ZSTD_getFrameContentSize(bytes.data(), bytes.size());
  if (stated <= std::min<uint64_t>(kStep, max_size)) {
    contents.resize(stated);
    const size_t size = ZSTD_decompress(contents.data(), stated, bytes.data(), bytes.size());
    if (size == stated) return contents;
    contents.clear();  // damaged, or several frames
  }
  Unzstd(bytes, max_size, [&](std::string_view piece) { contents.append(piece); });
  return contents;
}

std::string DecompressLz4(std::string_view bytes, uint64_t max_size) {
  LZ4F_dctx* raw = nullptr;
  if (LZ4F_isError(LZ4F_createDecompressionContext(&raw, LZ4F_VERSION))) throw std::bad_alloc();
  const std::unique_ptr<LZ4F_dctx, LZ4F_errorCode_t (*)(LZ4F_dctx*)> context(
      raw, LZ4F_freeDecompressionContext);
  std::string contents, piece(kStep, '\0');
  size_t hint = 1;
  while (!bytes.empty() || hint != 0) {
    size_t out = piece.size(), in = bytes.size();
    hint = LZ4F_decompress(context.get(), piece.data(), &out, bytes.data(), &in, nullptr);
    if (LZ4F_isError(hint)) throw InputError(std::string("lz4: ") + LZ4F_getErrorName(hint));
    bytes.remove_prefix(in);
    CheckSize(contents.size() + out, max_size);
    contents.append(piece, 0, out);
    if (in == 0 && out == 0 && hint != 0) throw InputError("lz4: it is cut off");
  }
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
