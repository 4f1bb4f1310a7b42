#include "imu_pose_calib/ros/io/compression.h"

#include <fcntl.h>
#include <lz4frame.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>
#include <zstd.h>

#include <algorithm>
#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <functional>
#include <memory>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kStep = 1 << 17;  // [bytes] unfolded at a time

[[noreturn]] void FailTooLarge(uint64_t max_size) {
  throw InputError("unfolds to more than " + std::to_string(max_size) + " bytes");
}

/// Unfolds zstd frames, calling `use` with a piece at a time.
void Unzstd(std::string_view bytes, const std::function<void(std::string_view)>& use) {
  const std::unique_ptr<ZSTD_DStream, size_t (*)(ZSTD_DStream*)> stream(ZSTD_createDStream(),
                                                                        ZSTD_freeDStream);
  std::string piece(kStep, '\0');
  ZSTD_inBuffer in{bytes.data(), bytes.size(), 0};
  for (;;) {
    ZSTD_outBuffer out{piece.data(), piece.size(), 0};
    const size_t left = ZSTD_decompressStream(stream.get(), &out, &in);
    if (ZSTD_isError(left)) throw InputError(std::string("zstd: ") + ZSTD_getErrorName(left));
    use(std::string_view(piece).substr(0, out.pos));
    if (in.pos < in.size || out.pos == out.size) continue;  // more to come
    if (left != 0) throw InputError("zstd: it is cut off");
    return;
  }
}

[[noreturn]] void Fail(const std::string& path, const std::string& what) {
  throw InputError("'" + path + "' " + what + ": " + std::strerror(errno));
}

/// Writes what a file of zstd frames unfolds to into the open file.
void UnzstdInto(int file, std::string_view bytes, const std::string& path) {
  const uint64_t max_size = kMaxBlockSize + 100 * bytes.size();
  uint64_t size = 0;
  const auto write_all = [&](std::string_view piece) {
    size += piece.size();
    if (size > max_size) FailTooLarge(max_size);
    while (!piece.empty()) {
      const ssize_t written = write(file, piece.data(), piece.size());
      if (written < 0 && errno != EINTR) Fail(path, "cannot be unfolded into a temporary file");
      if (written > 0) piece.remove_prefix(static_cast<size_t>(written));
    }
  };
  Unzstd(bytes, write_all);
}

}  // namespace

bool IsZstd(std::string_view bytes) { return bytes.substr(0, 4) == "\x28\xb5\x2f\xfd"; }

std::string DecompressZstd(std::string_view bytes, uint64_t max_size) {
  std::string contents;
  // As most messages are, for which a stream would take longer to set up than to run.
  const uint64_t stated = ZSTD_getFrameContentSize(bytes.data(), bytes.size());
  if (stated <= std::min<uint64_t>(kStep, max_size)) {
    contents.resize(stated);
    const size_t size =
        ZSTD_decompress(contents.data(), contents.size(), bytes.data(), bytes.size());
    if (size == stated) return contents;
    contents.clear();  // damaged, or several frames
  }
  Unzstd(bytes, [&](std::string_view piece) {
    if (piece.size() > max_size - contents.size()) FailTooLarge(max_size);
    contents.append(piece);
  });
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
    if (out > max_size - contents.size()) FailTooLarge(max_size);
    contents.append(piece, 0, out);
    if (in == 0 && out == 0 && hint != 0) throw InputError("lz4: it is cut off");
  }
  return contents;
}

std::string CompressZstd(std::string_view bytes) {
  std::string frame(ZSTD_compressBound(bytes.size()), '\0');
  const size_t size = ZSTD_compress(frame.data(), frame.size(), bytes.data(), bytes.size(), 1);
  if (ZSTD_isError(size)) throw InputError(std::string("zstd: ") + ZSTD_getErrorName(size));
  frame.resize(size);
  return frame;
}

std::string CompressLz4(std::string_view bytes) {
  std::string frame(LZ4F_compressFrameBound(bytes.size(), nullptr), '\0');
  const size_t size =
      LZ4F_compressFrame(frame.data(), frame.size(), bytes.data(), bytes.size(), nullptr);
  if (LZ4F_isError(size)) throw InputError(std::string("lz4: ") + LZ4F_getErrorName(size));
  frame.resize(size);
  return frame;
}

namespace {

/// A file in memory; nothing for an empty one.
std::string_view Map(const std::string& path) {
  const int file = open(path.c_str(), O_RDONLY | O_CLOEXEC);
  if (file < 0) Fail(path, "cannot be read");
  struct stat status {};
  fstat(file, &status);
  const auto size = static_cast<size_t>(status.st_size);
  void* bytes = size == 0 ? nullptr : mmap(nullptr, size, PROT_READ, MAP_PRIVATE, file, 0);
  const int error = errno;
  close(file);
  errno = error;
  if (bytes == MAP_FAILED) Fail(path, "cannot be read");
  return {static_cast<const char*>(bytes), size};
}

void Unmap(std::string_view bytes) {
  if (!bytes.empty()) munmap(const_cast<char*>(bytes.data()), bytes.size());
}

}  // namespace

InputFile::InputFile(const std::string& path) : path_(path), bytes_(Map(path)) {
  if (!IsZstd(bytes_)) return;
  const std::string_view frames = bytes_;
  bytes_ = {};
  temporary_ = (std::filesystem::temp_directory_path() / "imu_pose_calib_XXXXXX").string();
  const int file = mkstemp(temporary_.data());
  try {
    if (file < 0) Fail(temporary_, "cannot be written");
    UnzstdInto(file, frames, path);
  } catch (const InputError& error) {
    Unmap(frames);
    if (file >= 0) {
      close(file);
      unlink(temporary_.c_str());
    }
    throw InputError("'" + path + "': " + error.what());
  }
  close(file);
  Unmap(frames);
  path_ = temporary_;
  bytes_ = Map(path_);
}

InputFile::~InputFile() {
  Unmap(bytes_);
  RemoveTemporary();
}

void InputFile::RemoveTemporary() {
  if (!temporary_.empty()) unlink(temporary_.c_str());
  temporary_.clear();
}

}  // namespace imu_pose_calib
