#include "imu_pose_calib/ros/io/record_file.h"

namespace imu_pose_calib {

uint32_t RecordFile::AddChunk(std::string_view compression, FileReader stored, uint64_t size) {
  if (compression.empty() && stored.size() != size)
    throw InputError("chunk has " + std::to_string(stored.size()) + " bytes, must have " +
                     std::to_string(size));
  if (size > kMaxBlockSize && !compression.empty())
    throw InputError("chunk is of " + std::to_string(size) + " bytes, must be at most " +
                     std::to_string(kMaxBlockSize));
  chunks_.push_back({std::string(compression), stored, size});
  return static_cast<uint32_t>(chunks_.size());
}

std::string_view RecordFile::Records(uint32_t chunk) {
  for (const auto& [kept, records] : kept_)
    if (kept == chunk) return records;
  auto [compression, stored, size] = chunks_.at(chunk - 1);
  std::string records = stored.Bytes(stored.size());
  if (compression == "lz4") records = DecompressLz4(records, size);
  if (compression == "zstd") records = DecompressZstd(records, size);
  if (compression == "bz2") records = DecompressBz2(records, size);
  if (records.size() != size)
    throw InputError("chunk unfolds to " + std::to_string(records.size()) + " bytes, must be " +
                     std::to_string(size));
  auto& slot = kept_[next_slot_++ % kKept];
  slot = {chunk, std::move(records)};
  return slot.second;
}

}  // namespace imu_pose_calib
