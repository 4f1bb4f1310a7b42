#include "imu_pose_calib/ros/io/record_file.h"

#include <algorithm>
#include <boost/crc.hpp>

namespace imu_pose_calib {

void RecordFile::ReadFile(size_t begin) {
  std::string_view left = bytes().substr(std::min(begin, bytes().size()));
  const auto at = [&] { return std::to_string(bytes().size() - left.size()); };
  try {
    while (!left.empty() && ReadRecord(0, &left)) continue;
  } catch (const InputError& error) {
    throw InputError("'" + name_ + "' is damaged, record at byte " + at() + ": " + error.what() +
                     remedy_);
  }
  if (left.empty() && is_complete_) return;
  note_ = "'" + name_ + "' " +
          (left.empty() ? "has no index: all of it is read, "
                        : "is cut off: it is read up to byte " + at() + " of " +
                              std::to_string(bytes().size()) + ", ") +
          std::to_string(entries_.size()) + " messages" + (entries_.empty() ? remedy_ : "");
}

void RecordFile::AddChunk(const std::string& compression, std::string_view stored, uint64_t size,
                          uint32_t crc) {
  if (!compression.empty() && compression != "bz2" && compression != "lz4" && compression != "zstd")
    throw InputError("chunk is compressed by '" + compression.substr(0, 20) +
                     "', must be bz2, lz4 or zstd");
  if (compression.empty() && stored.size() != size)
    throw InputError("chunk has " + std::to_string(stored.size()) + " bytes, must have " +
                     std::to_string(size));
  if (size > kMaxBlockSize && !compression.empty())
    throw InputError("chunk is of " + std::to_string(size) + " bytes, must be at most " +
                     std::to_string(kMaxBlockSize));
  chunks_.push_back({compression, stored, size});
  const auto chunk = static_cast<uint32_t>(chunks_.size());
  std::string_view left = Records(chunk);
  CheckCrc(left, crc, "chunk");
  while (!left.empty())
    if (!ReadRecord(chunk, &left)) throw InputError("chunk ends within a record");
}

void RecordFile::CheckCrc(std::string_view checked, uint32_t expected, const char* what) {
  boost::crc_32_type crc;
  if (expected != 0) crc.process_bytes(checked.data(), checked.size());
  if (expected != 0 && crc.checksum() != expected)
    throw InputError(std::string("the checksum of the ") + what + " is wrong");
}

void RecordFile::AddChannel(uint32_t id, const Topic& topic) {
  const auto [known, is_new] = channels_.emplace(id, static_cast<uint32_t>(topics_.size()));
  if (is_new) return topics_.push_back(topic);
  const Topic& other = topics_[known->second];
  if (other.name != topic.name || other.type != topic.type)
    throw InputError("channel " + std::to_string(id) + " is both '" + other.name + "' and '" +
                     topic.name + "'");
}

void RecordFile::AddMessage(uint32_t channel, int64_t t_ns, uint32_t chunk, std::string_view data) {
  const auto topic = channels_.find(channel);
  if (topic == channels_.end())
    throw InputError("a message is of channel " + std::to_string(channel) + ", which is unknown");
  const auto at = static_cast<uint64_t>(data.data() - Records(chunk).data());
  entries_.push_back({t_ns, topic->second, chunk, at, data.size()});
}

std::string_view RecordFile::Records(uint32_t number) {
  if (number == 0) return bytes();
  Chunk& chunk = chunks_[number - 1];
  const auto& [compression, stored, size, records] = chunk;
  if (compression.empty()) return stored;
  if (!records.empty()) return records;
  chunk.records = compression == "lz4"    ? DecompressLz4(stored, size)
                  : compression == "zstd" ? DecompressZstd(stored, size)
                                          : DecompressBz2(stored, size);
  if (records.size() != size)
    throw InputError("chunk unfolds to " + std::to_string(records.size()) + " bytes, must be " +
                     std::to_string(size));
  kept_.push_back(&chunk);
  for (kept_size_ += size; kept_size_ > kMaxKept && kept_.size() > 1; kept_.pop_front()) {
    kept_size_ -= kept_.front()->size;
    std::string().swap(kept_.front()->records);  // gives its memory back
  }
  return records;
}

}  // namespace imu_pose_calib
