// The format: https://mcap.dev/spec. All numbers are little endian.

#include <algorithm>
#include <array>
#include <boost/crc.hpp>
#include <cerrno>
#include <cstring>
#include <fstream>
#include <limits>
#include <map>
#include <utility>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/compression.h"
#include "imu_pose_calib/ros/io/ros2_file.h"

namespace imu_pose_calib {
namespace {

constexpr std::string_view kMagic("\x89MCAP0\r\n", 8);
constexpr size_t kRecordHeader = 9;  // opcode, length

enum Opcode : uint8_t {
  kHeader = 0x01,
  kFooter = 0x02,
  kSchema = 0x03,
  kChannel = 0x04,
  kMessage = 0x05,
  kChunk = 0x06,
  kMessageIndex = 0x07,
  kChunkIndex = 0x08,
  kStatistics = 0x0b,
  kDataEnd = 0x0f
};

uint32_t Crc32(std::string_view bytes) {
  boost::crc_32_type crc;
  crc.process_bytes(bytes.data(), bytes.size());
  return crc.checksum();
}

// --- Reading ---

/// The fields of a record, one after the other.
class FieldReader {
 public:
  explicit FieldReader(std::string_view left) : left_(left) {}

  template <typename T>
  T Number() {
    const std::string_view bytes = Bytes(sizeof(T));
    uint64_t value = 0;
    for (size_t k = sizeof(T); k-- > 0;) value = value << 8 | static_cast<unsigned char>(bytes[k]);
    return static_cast<T>(value);
  }

  std::string_view Bytes(uint64_t size) {
    if (size > left_.size())
      throw InputError("a length in it goes beyond its end (" + std::to_string(size) + " of " +
                       std::to_string(left_.size()) + " bytes)");
    const std::string_view bytes = left_.substr(0, size);
    left_.remove_prefix(size);
    return bytes;
  }

  std::string String() { return std::string(Bytes(Number<uint32_t>())); }

  std::string_view left() const { return left_; }

 private:
  std::string_view left_;
};

/// One record of a sequence of them.
struct Record {
  uint8_t opcode;
  std::string_view content;
  size_t at;  ///< of its opcode
};

/// The records of a part of a file.
class Records {
 public:
  Records(std::string_view bytes, size_t at) : bytes_(bytes), at_(at) {}

  /// False at the end, and where the rest is too short for a record.
  bool Next(Record* record) {
    if (bytes_.size() - at_ < kRecordHeader) return false;
    FieldReader header(bytes_.substr(at_, kRecordHeader));
    const auto opcode = header.Number<uint8_t>();
    const auto size = header.Number<uint64_t>();
    if (size > bytes_.size() - at_ - kRecordHeader) return false;
    *record = {opcode, bytes_.substr(at_ + kRecordHeader, size), at_};
    at_ += kRecordHeader + size;
    return true;
  }

  size_t at() const { return at_; }

 private:
  std::string_view bytes_;
  size_t at_;
};

class McapFile : public Ros2File {
 public:
  McapFile(std::string_view bytes, const std::string& name) : bytes_(bytes), name_(name) {
    if (!IsMcap(bytes)) throw InputError("'" + name + "' is not an mcap file");
    ReadAll();
  }

  std::string_view Read(const Entry& entry) override {
    if (entry.chunk == 0) return bytes_.substr(entry.at, entry.size);
    return Unfold(entry.chunk).substr(entry.at, entry.size);
  }

 private:
  /// Compressed records; entries count them from 1.
  struct Chunk {
    std::string_view compression, records;
    uint64_t size;  ///< of the records that it unfolds to
  };

  /// Chunks that overlap in time are read in turns; this many are kept.
  static constexpr size_t kKept = 4;

  void ReadAll() {
    Records records(bytes_, kMagic.size());
    Record record{};
    while (records.Next(&record)) {
      if (record.opcode == kFooter) return;
      try {
        if (record.opcode == kDataEnd) return CheckDataEnd(record);
        if (record.opcode == kChunk)
          ReadChunk(record);
        else
          ReadRecord(record, 0, bytes_);
      } catch (const InputError& error) {
        throw InputError("'" + name_ + "' is damaged, record at byte " + std::to_string(record.at) +
                         ": " + error.what());
      }
    }
    note_ = "'" + name_ + "' is cut off: it is read up to byte " + std::to_string(records.at()) +
            " of " + std::to_string(bytes_.size()) + ", " + std::to_string(entries_.size()) +
            " messages";
  }

  static std::string Unfold(const Chunk& chunk) {
    std::string records = chunk.compression == "lz4" ? DecompressLz4(chunk.records, chunk.size)
                                                     : DecompressZstd(chunk.records, chunk.size);
    if (records.size() != chunk.size)
      throw InputError("chunk unfolds to " + std::to_string(records.size()) + " bytes, must be " +
                       std::to_string(chunk.size));
    return records;
  }

  std::string_view Unfold(uint32_t number) {
    for (const auto& [kept, records] : kept_)
      if (kept == number) return records;
    auto& slot = kept_[next_slot_++ % kKept];
    slot = {number, Unfold(chunks_[number - 1])};
    return slot.second;
  }

  void ReadChunk(const Record& record) {
    FieldReader fields(record.content);
    fields.Bytes(2 * sizeof(uint64_t));  // first and last time
    const auto size = fields.Number<uint64_t>();
    const auto crc = fields.Number<uint32_t>();
    const std::string_view compression = fields.Bytes(fields.Number<uint32_t>());
    const std::string_view stored = fields.Bytes(fields.Number<uint64_t>());
    if (compression.empty()) {
      if (stored.size() != size)
        throw InputError("chunk has " + std::to_string(stored.size()) + " bytes, must have " +
                         std::to_string(size));
      CheckCrc(stored, crc);
      const auto begin = static_cast<size_t>(stored.data() - bytes_.data());
      return ReadChunk(0, bytes_.substr(0, begin + stored.size()), begin);
    }
    if (compression != "lz4" && compression != "zstd")
      throw InputError("chunk is compressed by '" + std::string(compression.substr(0, 20)) +
                       "', must be lz4 or zstd");
    if (size > kMaxBlockSize)
      throw InputError("chunk is of " + std::to_string(size) + " bytes, must be at most " +
                       std::to_string(kMaxBlockSize));
    chunks_.push_back({compression, stored, size});
    const std::string records = Unfold(chunks_.back());
    CheckCrc(records, crc);
    ReadChunk(static_cast<uint32_t>(chunks_.size()), records, 0);
  }

  /// Reads the records of a chunk, which begin at `begin` of the bytes and last to their end.
  void ReadChunk(uint32_t chunk, std::string_view bytes, size_t begin) {
    Records records(bytes, begin);
    Record record{};
    while (records.Next(&record)) ReadRecord(record, chunk, bytes);
    if (records.at() != bytes.size()) throw InputError("chunk ends within a record");
  }

  static void CheckCrc(std::string_view bytes, uint32_t crc) {
    if (crc != 0 && crc != Crc32(bytes)) throw InputError("the checksum of the chunk is wrong");
  }

  void CheckDataEnd(const Record& record) const {
    const auto crc = FieldReader(record.content).Number<uint32_t>();
    if (crc != 0 && crc != Crc32(bytes_.substr(0, record.at)))
      throw InputError("the checksum of the messages is wrong");
  }

  /// A record that may stand in a chunk or outside of it; what is not needed is skipped.
  void ReadRecord(const Record& record, uint32_t chunk, std::string_view bytes) {
    FieldReader fields(record.content);
    switch (record.opcode) {
      case 0:
        throw InputError("its kind is 0, which there is none of");
      case kSchema: {
        const auto id = fields.Number<uint16_t>();
        schemas_[id] = fields.String();
        return;
      }
      case kChannel:
        return ReadChannel(&fields);
      case kMessage: {
        const auto id = fields.Number<uint16_t>();
        fields.Number<uint32_t>();  // sequence
        const auto time = fields.Number<uint64_t>();
        fields.Number<uint64_t>();  // time of publishing
        const auto channel = channels_.find(id);
        if (channel == channels_.end())
          throw InputError("a message is of channel " + std::to_string(id) + ", which is unknown");
        if (time > uint64_t{std::numeric_limits<int64_t>::max()})
          throw InputError("a message is recorded at " + std::to_string(time) + " ns");
        const std::string_view data = fields.left();
        entries_.push_back({static_cast<int64_t>(time), channel->second, chunk,
                            static_cast<uint64_t>(data.data() - bytes.data()), data.size()});
        return;
      }
      default:
        return;
    }
  }

  void ReadChannel(FieldReader* fields) {
    const auto id = fields->Number<uint16_t>();
    const auto schema = fields->Number<uint16_t>();
    Topic topic;
    topic.name = fields->String();
    topic.encoding = fields->String();
    const auto type = schemas_.find(schema);
    if (schema != 0 && type == schemas_.end())
      throw InputError("channel '" + topic.name + "' is of schema " + std::to_string(schema) +
                       ", which is unknown");
    if (schema != 0) topic.type = type->second;
    const auto known = channels_.find(id);
    if (known == channels_.end()) {
      channels_[id] = static_cast<uint32_t>(topics_.size());
      topics_.push_back(topic);
      return;
    }
    const Topic& other = topics_[known->second];
    if (other.name != topic.name || other.type != topic.type || other.encoding != topic.encoding)
      throw InputError("channel " + std::to_string(id) + " is both '" + other.name + "' and '" +
                       topic.name + "'");
  }

  std::string_view bytes_;
  std::string name_;
  std::map<uint16_t, std::string> schemas_;
  std::map<uint16_t, uint32_t> channels_;  ///< index of the topic
  std::vector<Chunk> chunks_;
  std::array<std::pair<uint32_t, std::string>, kKept> kept_;
  size_t next_slot_ = 0;
};

// --- Writing ---

/// The fields of a record.
class FieldWriter {
 public:
  template <typename T>
  FieldWriter& Number(T value) {
    for (size_t k = 0; k < sizeof(T); ++k)
      text_ += static_cast<char>(static_cast<uint64_t>(value) >> (8 * k) & 0xff);
    return *this;
  }
  FieldWriter& Bytes(const std::string& bytes) {
    text_ += bytes;
    return *this;
  }
  FieldWriter& String(const std::string& text) {
    return Number(static_cast<uint32_t>(text.size())).Bytes(text);
  }

  /// A record of these fields.
  std::string Record(uint8_t opcode) const {
    return FieldWriter().Number(opcode).Number(uint64_t{text_.size()}).Bytes(text_).text_;
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
    Put(FieldWriter().String("ros2").String("imu_pose_calib").Record(kHeader));
  }

  void AddTopic(const std::string& name, const std::string& type,
                const std::string& definition) override {
    const auto id = static_cast<uint16_t>(counts_.size() + 1);
    const std::string records =
        FieldWriter().Number(id).String(type).String("ros2msg").String(definition).Record(kSchema) +
        FieldWriter().Number(id).Number(id).String(name).String("cdr").String("").Record(kChannel);
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
    PutInChunk(FieldWriter()
                   .Number(channel)
                   .Number(static_cast<uint32_t>(counts_[topic]++))
                   .Number(time)
                   .Number(time)
                   .Bytes(data)
                   .Record(kMessage));
    if (chunk_.size() >= format_.chunk_size) PutChunk();
  }

  void Close() override {
    PutChunk();
    Put(FieldWriter().Number(uint32_t{0}).Record(kDataEnd));  // no checksum
    const uint64_t summary = at_;
    Put(topics_);
    FieldWriter counts;
    for (size_t k = 0; k < counts_.size(); ++k)
      counts.Number(static_cast<uint16_t>(k + 1)).Number(counts_[k]);
    Put(FieldWriter()
            .Number(messages_)
            .Number(static_cast<uint16_t>(counts_.size()))
            .Number(static_cast<uint32_t>(counts_.size()))
            .Number(uint32_t{0})  // attachments
            .Number(uint32_t{0})  // metadata
            .Number(chunks_)
            .Number(begin_)
            .Number(end_)
            .String(counts.text())
            .Record(kStatistics));
    Put(chunk_indexes_);
    Put(FieldWriter().Number(summary).Number(uint64_t{0}).Number(uint32_t{0}).Record(kFooter));
    Put(kMagic);
    file_.close();
    if (!file_) Fail();
  }

 private:
  [[noreturn]] void Fail() const {
    throw InputError("cannot write bag '" + path_ + "': " + std::strerror(errno));
  }

  void Put(std::string_view bytes) {
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
    const std::string record = FieldWriter()
                                   .Number(chunk_begin_)
                                   .Number(chunk_end_)
                                   .Number(uint64_t{chunk_.size()})
                                   .Number(Crc32(chunk_))
                                   .String(compression)
                                   .Number(uint64_t{stored.size()})
                                   .Bytes(stored)
                                   .Record(kChunk);
    const uint64_t chunk_at = at_;
    Put(record);
    const uint64_t indexes_at = at_;
    FieldWriter offsets;
    for (const auto& [channel, messages] : index_) {
      offsets.Number(channel).Number(at_);
      FieldWriter entries;
      for (const auto& [time, at] : messages) entries.Number(time).Number(at);
      Put(FieldWriter().Number(channel).String(entries.text()).Record(kMessageIndex));
    }
    chunk_indexes_ += FieldWriter()
                          .Number(chunk_begin_)
                          .Number(chunk_end_)
                          .Number(chunk_at)
                          .Number(uint64_t{record.size()})
                          .String(offsets.text())
                          .Number(at_ - indexes_at)
                          .String(compression)
                          .Number(uint64_t{stored.size()})
                          .Number(uint64_t{chunk_.size()})
                          .Record(kChunkIndex);
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

bool IsMcap(std::string_view bytes) { return bytes.substr(0, kMagic.size()) == kMagic; }

std::unique_ptr<Ros2File> OpenMcap(std::string_view bytes, const std::string& name) {
  return std::make_unique<McapFile>(bytes, name);
}

std::unique_ptr<Ros2Storage> CreateMcap(const std::string& path, const Ros2Format& format) {
  return std::make_unique<McapStorage>(path, format);
}

}  // namespace imu_pose_calib
