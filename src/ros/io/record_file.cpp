#include "imu_pose_calib/ros/io/record_file.h"

namespace imu_pose_calib {

uint32_t RecordFile::AddChunk(std::string_view compression, std::string_view stored,
                              uint64_t size) {
  if (compression.empty() && stored.size() != size)
    throw InputError("chunk has " + std::to_string(stored.size()) + " bytes, must have " +
                     std::to_string(size));
  if (size > kMaxBlockSize && !compression.empty())
    throw InputError("chunk is of " + std::to_string(size) + " bytes, must be at most " +
                     std::to_string(kMaxBlockSize));
  chunks_.push_back({compression, stored, size});
  return static_cast<uint32_t>(chunks_.size());
}

std::string_view RecordFile::Records(uint32_t chunk) {
  if (chunk == 0) return bytes();
  const auto& [compression, stored, size] = chunks_[chunk - 1];
  if (compression.empty()) return stored;
  for (const auto& [kept, records] : kept_)
    if (kept == chunk) return records;
  std::string records = compression == "lz4"    ? DecompressLz4(stored, size)
                        : compression == "zstd" ? DecompressZstd(stored, size)
                                                : DecompressBz2(stored, size);
  if (records.size() != size)
    throw InputError("chunk unfolds to " + std::to_string(records.size()) + " bytes, must be " +
                     std::to_string(size));
  auto& slot = kept_[next_slot_++ % kKept];
  slot = {chunk, std::move(records)};
  return slot.second;
}

}  // namespace imu_pose_calib
