// The format: https://mcap.dev/spec. All numbers are little endian.

#include <algorithm>
#include <boost/crc.hpp>
#include <cerrno>
#include <cstring>
#include <fstream>
#include <limits>
#include <map>
#include <utility>

#include "imu_pose_calib/ros/io/record_file.h"

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

struct Record {
  uint8_t opcode;
  FieldReader fields;
};

/// Cuts the next record off the front; none at the end, and where the rest is too short for one.
std::optional<Record> Next(std::string_view* bytes) {
  if (bytes->size() < kRecordHeader) return std::nullopt;
  FieldReader rest(*bytes);
  const auto opcode = rest.Number<uint8_t>();
  const auto size = rest.Number<uint64_t>();
  if (size > rest.left().size()) return std::nullopt;
  const Record record{opcode, FieldReader(rest.Bytes(size))};
  *bytes = rest.left();
  return record;
}

void CheckCrc(std::string_view bytes, uint32_t crc, const char* what) {
  if (crc != 0 && crc != Crc32(bytes))
    throw InputError(std::string("the checksum of the ") + what + " is wrong");
}

class McapFile : public RecordFile {
 public:
  McapFile(std::unique_ptr<InputFile> input, const std::string& name)
      : RecordFile(std::move(input)) {
    std::string_view left = bytes().substr(kMagic.size());
    const auto at = [&] { return bytes().size() - left.size(); };
    for (size_t begin = at(); auto record = Next(&left); begin = at()) {
      try {
        if (record->opcode == kFooter) return;
        if (record->opcode == kDataEnd) {
          CheckCrc(bytes().substr(0, begin), record->fields.Number<uint32_t>(), "messages");
          return;
        }
        if (record->opcode == kChunk)
          ReadChunk(record->fields);
        else
          ReadRecord(*record, 0);
      } catch (const InputError& error) {
        throw InputError("'" + name + "' is damaged, record at byte " + std::to_string(begin) +
                         ": " + error.what());
      }
    }
    note_ = "'" + name + "' is cut off: it is read up to byte " + std::to_string(at()) + " of " +
            std::to_string(bytes().size()) + ", " + std::to_string(entries_.size()) + " messages";
  }

 private:
  void ReadChunk(FieldReader fields) {
    fields.Bytes(2 * sizeof(uint64_t));  // first and last time
    const auto size = fields.Number<uint64_t>();
    const auto crc = fields.Number<uint32_t>();
    const std::string_view compression = fields.Text();
    const std::string_view stored = fields.Bytes(fields.Number<uint64_t>());
    if (!compression.empty() && compression != "lz4" && compression != "zstd")
      throw InputError("chunk is compressed by '" + std::string(compression.substr(0, 20)) +
                       "', must be lz4 or zstd");
    const uint32_t chunk = AddChunk(compression, stored, size);
    std::string_view left = Records(chunk);
    CheckCrc(left, crc, "chunk");
    while (const auto record = Next(&left)) ReadRecord(*record, chunk);
    if (!left.empty()) throw InputError("chunk ends within a record");
  }

  /// A record that may stand in a chunk or outside of it; what is not needed is skipped.
  void ReadRecord(const Record& record, uint32_t chunk) {
    FieldReader fields = record.fields;
    if (record.opcode == 0) throw InputError("its kind is 0, which there is none of");
    if (record.opcode == kSchema) {
      const auto id = fields.Number<uint16_t>();
      schemas_[id] = fields.Text();
    }
    if (record.opcode == kChannel) ReadChannel(fields);
    if (record.opcode == kMessage) ReadMessage(fields, chunk);
  }

  void ReadChannel(FieldReader fields) {
    const auto id = fields.Number<uint16_t>();
    const auto schema = fields.Number<uint16_t>();
    const std::string name(fields.Text()), encoding(fields.Text());
    if (schema != 0 && schemas_.count(schema) == 0)
      throw InputError("channel '" + name + "' is of schema " + std::to_string(schema) +
                       ", which is unknown");
    const Topic topic{name, Ros1Type(schema == 0 ? "" : schemas_[schema], encoding), {}};
    const auto [known, is_new] = channels_.emplace(id, static_cast<uint32_t>(topics_.size()));
    if (is_new) return topics_.push_back(topic);
    const Topic& other = topics_[known->second];
    if (other.name != topic.name || other.type != topic.type)
      throw InputError("channel " + std::to_string(id) + " is both '" + other.name + "' and '" +
                       topic.name + "'");
  }

  void ReadMessage(FieldReader fields, uint32_t chunk) {
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
                        static_cast<uint64_t>(data.data() - Records(chunk).data()), data.size()});
  }

  std::map<uint16_t, std::string> schemas_;
  std::map<uint16_t, uint32_t> channels_;  ///< index of the topic
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

/// First and last time of messages [ns]; 0 without any.
struct Span {
  uint64_t first = UINT64_MAX, end = 0;

  void Add(uint64_t time) {
    first = std::min(first, time);
    end = std::max(end, time);
  }
  uint64_t begin() const { return std::min(first, end); }
};

class McapStorage : public Ros2Storage {
 public:
  McapStorage(const std::string& path, const Ros2Format& format)
      : path_(path), format_(format), file_(path, std::ios::binary | std::ios::trunc) {
    Put(kMagic);
    Put(FieldWriter().String("ros2").String("imu_pose_calib").Record(kHeader));
  }

  void AddTopic(const std::string& name, const std::string& type,
                const std::string& definition) override {
    counts_.push_back(0);
    const auto id = static_cast<uint16_t>(counts_.size());
    const std::string records =
        FieldWriter().Number(id).String(type).String("ros2msg").String(definition).Record(kSchema) +
        FieldWriter().Number(id).Number(id).String(name).String("cdr").String("").Record(kChannel);
    topics_ += records;
    PutInChunk(records);
  }

  void Write(uint32_t topic, int64_t t_ns, const std::string& data) override {
    const auto time = static_cast<uint64_t>(t_ns);
    const auto channel = static_cast<uint16_t>(topic + 1);
    index_[channel].Number(time).Number(uint64_t{chunk_.size()});
    span_.Add(time);
    chunk_span_.Add(time);
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
    uint64_t messages = 0;
    for (size_t k = 0; k < counts_.size(); ++k) {
      counts.Number(static_cast<uint16_t>(k + 1)).Number(counts_[k]);
      messages += counts_[k];
    }
    Put(FieldWriter()
            .Number(messages)
            .Number(static_cast<uint16_t>(counts_.size()))
            .Number(static_cast<uint32_t>(counts_.size()))
            .Number(uint32_t{0})  // attachments
            .Number(uint32_t{0})  // metadata
            .Number(chunks_)
            .Number(span_.begin())
            .Number(span_.end)
            .String(counts.text())
            .Record(kStatistics));
    Put(chunk_indexes_);
    Put(FieldWriter().Number(summary).Number(uint64_t{0}).Number(uint32_t{0}).Record(kFooter));
    Put(kMagic);
    file_.close();
    CheckFile();
  }

 private:
  void CheckFile() const {
    if (!file_) throw InputError("cannot write bag '" + path_ + "': " + std::strerror(errno));
  }

  void Put(std::string_view bytes) {
    file_ << bytes;
    CheckFile();
    at_ += bytes.size();
  }

  void PutInChunk(const std::string& records) {
    if (format_.chunk_compression != "none")
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
                                   .Number(chunk_span_.begin())
                                   .Number(chunk_span_.end)
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
    for (const auto& [channel, entries] : index_) {
      offsets.Number(channel).Number(at_);
      Put(FieldWriter().Number(channel).String(entries.text()).Record(kMessageIndex));
    }
    chunk_indexes_ += FieldWriter()
                          .Number(chunk_span_.begin())
                          .Number(chunk_span_.end)
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
    chunk_span_ = {};
  }

  std::string path_;
  Ros2Format format_;
  std::ofstream file_;
  uint64_t at_ = 0;
  std::string topics_, chunk_, chunk_indexes_;  ///< records
  std::map<uint16_t, FieldWriter> index_;       ///< of the chunk, of each channel
  std::vector<uint64_t> counts_;                ///< messages of each topic
  Span span_, chunk_span_;
  uint32_t chunks_ = 0;
};

}  // namespace

bool IsMcap(std::string_view bytes) { return bytes.substr(0, kMagic.size()) == kMagic; }

std::unique_ptr<BagFile> OpenMcap(std::unique_ptr<InputFile> input, const std::string& name) {
  return std::make_unique<McapFile>(std::move(input), name);
}

std::unique_ptr<Ros2Storage> CreateMcap(const std::string& path, const Ros2Format& format) {
  return std::make_unique<McapStorage>(path, format);
}

}  // namespace imu_pose_calib
