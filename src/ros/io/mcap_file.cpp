// The format: https://mcap.dev/spec. All numbers are little endian.

#include <algorithm>
#include <boost/crc.hpp>
#include <cerrno>
#include <cstring>
#include <fstream>
#include <limits>
#include <map>
#include <utility>

#include "imu_pose_calib/ros/io/bag_file.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

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

uint32_t Crc32(ByteReader bytes) {
  boost::crc_32_type crc;
  for (std::string piece; !(piece = bytes.Piece()).empty();)
    crc.process_bytes(piece.data(), piece.size());
  return crc.checksum();
}

// --- Reading ---

struct Record {
  uint8_t opcode;
  ByteReader fields;
};

/// Takes the next record; none at the end, and where the rest is too short for one.
std::optional<Record> Next(ByteReader* reader) {
  ByteReader rest = *reader;
  if (rest.size() < kRecordHeader) return std::nullopt;
  const auto opcode = rest.Number<uint8_t>();
  const auto size = rest.Number<uint64_t>();
  if (size > rest.size()) return std::nullopt;
  const Record record{opcode, rest.Skip(size)};
  *reader = rest;
  return record;
}

void CheckCrc(ByteReader bytes, uint32_t crc, const char* what) {
  if (crc != 0 && crc != Crc32(bytes)) Reject("the checksum of the ", what, " is wrong");
}

class McapFile : public RecordFile {
 public:
  McapFile(std::unique_ptr<InputFile> input, const std::string& name)
      : RecordFile(std::move(input)) {
    ByteReader left = From(kMcapMagic.size());
    for (uint64_t begin = left.at(); auto record = Next(&left); begin = left.at()) {
      try {
        if (record->opcode == kFooter) return;
        if (record->opcode == kDataEnd) {
          CheckCrc(From(0).Skip(begin), record->fields.Number<uint32_t>(), "messages");
          return;
        }
        if (record->opcode == kChunk)
          ReadChunk(record->fields);
        else
          ReadRecord(*record, 0);
      } catch (const InputError& error) {
        Reject("'", name, "' is damaged, record at byte ", begin, ": ", error.what());
      }
    }
    NoteCutOff(name, left.at());
  }

 private:
  void ReadChunk(ByteReader fields) {
    fields.Skip(2 * sizeof(uint64_t));  // first and last time
    const auto size = fields.Number<uint64_t>();
    const auto crc = fields.Number<uint32_t>();
    const std::string compression = fields.Part().All();
    const ByteReader stored = fields.Skip(fields.Number<uint64_t>());
    if (!compression.empty() && compression != "lz4" && compression != "zstd")
      Reject("chunk is compressed by '", compression.substr(0, 20), "', must be lz4 or zstd");
    const uint32_t chunk = AddChunk(compression, stored, size);
    ByteReader left(Records(chunk));
    CheckCrc(left, crc, "chunk");
    while (const auto record = Next(&left)) ReadRecord(*record, chunk);
    if (left.size() > 0) Reject("chunk ends within a record");
  }

  /// A record that may stand in a chunk or outside of it; what is not needed is skipped.
  void ReadRecord(Record record, uint32_t chunk) {
    auto& [opcode, fields] = record;
    if (opcode == 0) Reject("its kind is 0, which there is none of");
    if (opcode == kSchema) {
      const auto id = fields.Number<uint16_t>();
      schemas_[id] = fields.Part().All();
    }
    if (opcode == kChannel) ReadChannel(fields);
    if (opcode == kMessage) ReadMessage(fields, chunk);
  }

  void ReadChannel(ByteReader fields) {
    const auto id = fields.Number<uint16_t>();
    const auto schema = fields.Number<uint16_t>();
    const std::string name = fields.Part().All(), encoding = fields.Part().All();
    if (schema != 0 && schemas_.count(schema) == 0)
      Reject("channel '", name, "' is of schema ", schema, ", which is unknown");
    const Topic topic{name, Ros1Type(schema == 0 ? "" : schemas_[schema], encoding), {}};
    const auto [known, is_new] = channels_.emplace(id, static_cast<uint32_t>(topics_.size()));
    if (is_new) return topics_.push_back(topic);
    const Topic& other = topics_[known->second];
    if (other.name != topic.name || other.type != topic.type)
      Reject("channel ", id, " is both '", other.name, "' and '", topic.name, "'");
  }

  void ReadMessage(ByteReader fields, uint32_t chunk) {
    const auto id = fields.Number<uint16_t>();
    fields.Number<uint32_t>();  // sequence
    const auto time = fields.Number<uint64_t>();
    fields.Number<uint64_t>();  // time of publishing
    const auto channel = channels_.find(id);
    if (channel == channels_.end()) Reject("a message is of channel ", id, ", which is unknown");
    if (time > uint64_t{std::numeric_limits<int64_t>::max()})
      Reject("a message is recorded at ", time, " ns");
    entries_.push_back(
        {static_cast<int64_t>(time), channel->second, chunk, fields.at(), fields.size()});
  }

  std::map<uint16_t, std::string> schemas_;
  std::map<uint16_t, uint32_t> channels_;  ///< index of the topic
};

// --- Writing ---

template <typename T>
void Append(std::string* to, T number) {
  for (size_t k = 0; k < sizeof(T); ++k)
    *to += static_cast<char>(static_cast<uint64_t>(number) >> (8 * k) & 0xff);
}
/// After its length.
void Append(std::string* to, const std::string& text) {
  Append(to, static_cast<uint32_t>(text.size()));
  *to += text;
}

template <typename... Fields>
std::string Pack(const Fields&... fields) {
  std::string packed;
  (Append(&packed, fields), ...);
  return packed;
}

std::string PackRecord(Opcode opcode, const std::string& content) {
  return Pack(uint8_t{opcode}, uint64_t{content.size()}) + content;
}

class McapStorage : public Ros2Storage {
 public:
  explicit McapStorage(const std::string& path)
      : path_(path), file_(path, std::ios::binary | std::ios::trunc) {
    Put(kMcapMagic);
    Put(PackRecord(kHeader, Pack(std::string("ros2"), std::string("imu_pose_calib"))));
  }

  void AddTopic(const std::string& name, const std::string& type,
                const std::string& definition) override {
    counts_.push_back(0);
    const auto id = static_cast<uint16_t>(counts_.size());
    const std::string encoding = "cdr", metadata;
    const std::string records =
        PackRecord(kSchema, Pack(id, type, std::string("ros2msg"), definition)) +
        PackRecord(kChannel, Pack(id, id, name, encoding, metadata));
    topics_ += records;
    chunk_ += records;
  }

  void Write(uint32_t topic, int64_t t_ns, const std::string& data) override {
    const auto time = static_cast<uint64_t>(t_ns);
    const auto channel = static_cast<uint16_t>(topic + 1);
    const auto sequence = static_cast<uint32_t>(counts_[topic]++);
    if (index_.empty()) chunk_begin_ = time;
    end_ = time;
    index_[channel] += Pack(time, uint64_t{chunk_.size()});
    chunk_ += PackRecord(kMessage, Pack(channel, sequence, time, time) + data);
    if (chunk_.size() >= kChunkSize) PutChunk();
  }

  void Close() override {
    PutChunk();
    const uint32_t no_checksum = 0, attachments = 0, metadata = 0;
    Put(PackRecord(kDataEnd, Pack(no_checksum)));
    const uint64_t summary = at_, no_offsets = 0;
    Put(topics_);
    std::string counts;
    uint64_t messages = 0;
    for (size_t k = 0; k < counts_.size(); ++k) {
      counts += Pack(static_cast<uint16_t>(k + 1), counts_[k]);
      messages += counts_[k];
    }
    const auto topics = static_cast<uint16_t>(counts_.size());
    Put(PackRecord(kStatistics, Pack(messages, topics, uint32_t{topics}, attachments, metadata,
                                     chunks_, begin_, end_, counts)));
    Put(chunk_indexes_);
    Put(PackRecord(kFooter, Pack(summary, no_offsets, no_checksum)));
    Put(kMcapMagic);
    file_.close();
    CheckFile();
  }

 private:
  static constexpr size_t kChunkSize = 786'432;  ///< [bytes] that end a chunk

  void CheckFile() const {
    if (!file_) Reject("cannot write bag '", path_, "': ", std::strerror(errno));
  }

  void Put(std::string_view bytes) {
    file_ << bytes;
    CheckFile();
    at_ += bytes.size();
  }

  /// Writes the chunk, which is not compressed, with the indexes of its messages.
  void PutChunk() {
    if (chunk_.empty()) return;
    const uint64_t size = chunk_.size();
    const uint32_t crc = Crc32(ByteReader(chunk_));
    const std::string compression;
    const std::string record =
        PackRecord(kChunk, Pack(chunk_begin_, end_, size, crc, compression, size) + chunk_);
    const uint64_t chunk_at = at_, indexes_at = at_ + record.size();
    Put(record);
    std::string offsets;
    for (const auto& [channel, entries] : index_) {
      offsets += Pack(channel, at_);
      Put(PackRecord(kMessageIndex, Pack(channel, entries)));
    }
    chunk_indexes_ +=
        PackRecord(kChunkIndex, Pack(chunk_begin_, end_, chunk_at, uint64_t{record.size()}, offsets,
                                     at_ - indexes_at, compression, size, size));
    if (chunks_++ == 0) begin_ = chunk_begin_;
    chunk_.clear();
    index_.clear();
  }

  std::string path_;
  std::ofstream file_;
  uint64_t at_ = 0;
  std::string topics_, chunk_, chunk_indexes_;      ///< records
  std::map<uint16_t, std::string> index_;           ///< of the chunk, of each channel
  std::vector<uint64_t> counts_;                    ///< messages of each topic
  uint64_t begin_ = 0, chunk_begin_ = 0, end_ = 0;  ///< [ns] times of messages
  uint32_t chunks_ = 0;
};

}  // namespace

std::unique_ptr<BagFile> OpenMcap(std::unique_ptr<InputFile> input, const std::string& name) {
  return std::make_unique<McapFile>(std::move(input), name);
}

std::unique_ptr<Ros2Storage> CreateMcap(const std::string& path) {
  return std::make_unique<McapStorage>(path);
}

}  // namespace imu_pose_calib
