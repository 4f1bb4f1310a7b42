// The format: https://mcap.dev/spec. All numbers are little endian.

#include <algorithm>
#include <boost/crc.hpp>
#include <cerrno>
#include <cstring>
#include <fstream>
#include <map>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/types.h"
#include "imu_pose_calib/ros/io/compression.h"
#include "imu_pose_calib/ros/io/ros2_writer.h"

namespace imu_pose_calib {
namespace {

constexpr char kMagic[] = "\x89MCAP0\r\n";

/// The fields of a record.
class Fields {
 public:
  template <typename T>
  Fields& Number(T value) {
    for (size_t k = 0; k < sizeof(T); ++k)
      text_ += static_cast<char>(static_cast<uint64_t>(value) >> (8 * k) & 0xff);
    return *this;
  }
  Fields& Bytes(const std::string& bytes) {
    text_ += bytes;
    return *this;
  }
  Fields& String(const std::string& text) {
    return Number(static_cast<uint32_t>(text.size())).Bytes(text);
  }

  /// A record of these fields.
  std::string Record(uint8_t opcode) const {
    return Fields().Number(opcode).Number(uint64_t{text_.size()}).Bytes(text_).text_;
  }

  const std::string& text() const { return text_; }

 private:
  std::string text_;
};

class McapStorage : public Ros2Storage {
 public:
  McapStorage(const std::string& path, const Ros2Format& format)
      : path_(path),
        format_(format),
        has_chunks_(format.chunk_compression != "none"),
        file_(path, std::ios::binary | std::ios::trunc) {
    Put(kMagic);
    Put(Fields().String("ros2").String("imu_pose_calib").Record(0x01));
  }

  void AddTopic(const std::string& name,
                const std::string& type,
                const std::string& definition) override {
    const auto id = static_cast<uint16_t>(counts_.size() + 1);
    const std::string records =
        Fields().Number(id).String(type).String("ros2msg").String(definition).Record(0x03) +
        Fields().Number(id).Number(id).String(name).String("cdr").String("").Record(0x04);
    counts_.push_back(0);
    topics_ += records;
    PutInChunk(records);
  }

  void Write(uint32_t topic, int64_t t_ns, const std::string& data) override {
    const auto time = static_cast<uint64_t>(t_ns);
    const auto channel = static_cast<uint16_t>(topic + 1);
    if (has_chunks_) index_[channel].emplace_back(time, chunk_.size());
    begin_ = messages_ == 0 ? time : std::min(begin_, time);
    end_ = std::max(end_, time);
    chunk_begin_ = in_chunk_ == 0 ? time : std::min(chunk_begin_, time);
    chunk_end_ = in_chunk_ == 0 ? time : std::max(chunk_end_, time);
    ++in_chunk_;
    ++messages_;
    PutInChunk(Fields()
                   .Number(channel)
                   .Number(static_cast<uint32_t>(counts_[topic]++))
                   .Number(time)
                   .Number(time)
                   .Bytes(data)
                   .Record(0x05));
    if (chunk_.size() >= format_.chunk_size) PutChunk();
  }

  void Close() override {
    PutChunk();
    Put(Fields().Number(uint32_t{0}).Record(0x0f));  // no checksum
    const uint64_t summary = at_;
    Put(topics_);
    Fields counts;
    for (size_t k = 0; k < counts_.size(); ++k)
      counts.Number(static_cast<uint16_t>(k + 1)).Number(counts_[k]);
    Put(Fields()
            .Number(messages_)
            .Number(static_cast<uint16_t>(counts_.size()))
            .Number(static_cast<uint32_t>(counts_.size()))
            .Number(uint32_t{0})  // attachments
            .Number(uint32_t{0})  // metadata
            .Number(chunks_)
            .Number(begin_)
            .Number(end_)
            .String(counts.text())
            .Record(0x0b));
    Put(chunk_indexes_);
    Put(Fields().Number(summary).Number(uint64_t{0}).Number(uint32_t{0}).Record(0x02));
    Put(kMagic);
    file_.close();
    if (!file_) Fail();
  }

 private:
  [[noreturn]] void Fail() const {
    throw InputError("cannot write bag '" + path_ + "': " + std::strerror(errno));
  }

  void Put(const std::string& bytes) {
    file_ << bytes;
    if (!file_) Fail();
    at_ += bytes.size();
  }

  void PutInChunk(const std::string& records) {
    if (has_chunks_)
      chunk_ += records;
    else
      Put(records);
  }

  /// Writes the chunk with the indexes of its messages.
  void PutChunk() {
    if (chunk_.empty()) return;
    const std::string& compression = format_.chunk_compression;
    const std::string stored = compression == "lz4"    ? CompressLz4(chunk_)
                               : compression == "zstd" ? CompressZstd(chunk_)
                                                       : chunk_;
    boost::crc_32_type crc;
    crc.process_bytes(chunk_.data(), chunk_.size());
    const std::string record = Fields()
                                   .Number(chunk_begin_)
                                   .Number(chunk_end_)
                                   .Number(uint64_t{chunk_.size()})
                                   .Number(uint32_t{crc.checksum()})
                                   .String(compression)
                                   .Number(uint64_t{stored.size()})
                                   .Bytes(stored)
                                   .Record(0x06);
    const uint64_t chunk_at = at_;
    Put(record);
    const uint64_t indexes_at = at_;
    Fields offsets;
    for (const auto& [channel, messages] : index_) {
      offsets.Number(channel).Number(at_);
      Fields entries;
      for (const auto& [time, at] : messages) entries.Number(time).Number(at);
      Put(Fields().Number(channel).String(entries.text()).Record(0x07));
    }
    chunk_indexes_ += Fields()
                          .Number(chunk_begin_)
                          .Number(chunk_end_)
                          .Number(chunk_at)
                          .Number(uint64_t{record.size()})
                          .String(offsets.text())
                          .Number(at_ - indexes_at)
                          .String(compression)
                          .Number(uint64_t{stored.size()})
                          .Number(uint64_t{chunk_.size()})
                          .Record(0x08);
    ++chunks_;
    chunk_.clear();
    index_.clear();
    in_chunk_ = 0;
    chunk_begin_ = chunk_end_ = 0;
  }

  std::string path_;
  Ros2Format format_;
  bool has_chunks_;
  std::ofstream file_;
  uint64_t at_ = 0;
  std::string topics_, chunk_, chunk_indexes_;  ///< records
  /// Time and place in the chunk of the messages of each channel.
  std::map<uint16_t, std::vector<std::pair<uint64_t, uint64_t>>> index_;
  std::vector<uint64_t> counts_;  ///< messages of each topic
  uint64_t messages_ = 0, in_chunk_ = 0;
  uint64_t begin_ = 0, end_ = 0, chunk_begin_ = 0, chunk_end_ = 0;  ///< [ns]
  uint32_t chunks_ = 0;
};

}  // namespace

std::unique_ptr<Ros2Storage> CreateMcap(const std::string& path, const Ros2Format& format) {
  return std::make_unique<McapStorage>(path, format);
}

}  // namespace imu_pose_calib
