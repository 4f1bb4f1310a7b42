// The format: https://mcap.dev/spec. All numbers are little endian.

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
  kDataEnd = 0x0f
};

// --- Reading ---

class McapFile final : public RecordFile {
 public:
  McapFile(std::unique_ptr<InputFile> input, const std::string& name)
      : RecordFile(std::move(input), name, "") {
    ReadFile(kMagic.size());
  }

 private:
  /// What is not needed is skipped, and so is all that follows the messages.
  bool ReadRecord(uint32_t chunk, std::string_view* left) override {
    if (left->size() < kRecordHeader) return false;
    FieldReader rest(*left);
    const auto opcode = rest.Number<uint8_t>();
    const auto size = rest.Number<uint64_t>();
    if (size > rest.left().size()) return false;
    FieldReader fields(rest.Bytes(size));
    if (opcode == 0) throw InputError("its kind is 0, which there is none of");
    if (opcode == kSchema) {
      const auto id = fields.Number<uint16_t>();
      schemas_[id] = fields.Text();
    }
    if (opcode == kChannel) ReadChannel(fields);
    if (opcode == kMessage) ReadMessage(fields, chunk);
    if (opcode == kChunk && chunk == 0) ReadChunk(fields);
    if (opcode == kDataEnd && chunk == 0)
      CheckCrc(bytes().substr(0, static_cast<size_t>(left->data() - bytes().data())),
               fields.Number<uint32_t>(), "messages");
    is_complete_ = chunk == 0 && (opcode == kDataEnd || opcode == kFooter);
    *left = is_complete_ ? std::string_view() : rest.left();
    return true;
  }

  void ReadChunk(FieldReader fields) {
    fields.Bytes(2 * sizeof(uint64_t));  // first and last time
    const auto size = fields.Number<uint64_t>();
    const auto crc = fields.Number<uint32_t>();
    const std::string compression(fields.Text());
    const auto stored = fields.Number<uint64_t>();
    AddChunk(compression, fields.Bytes(stored), size, crc);
  }

  void ReadChannel(FieldReader fields) {
    const auto id = fields.Number<uint16_t>();
    const auto schema = fields.Number<uint16_t>();
    const std::string name(fields.Text()), encoding(fields.Text());
    if (schema != 0 && schemas_.count(schema) == 0)
      throw InputError("channel '" + name + "' is of schema " + std::to_string(schema) +
                       ", which is unknown");
    AddChannel(id, {name, Ros1Type(schema == 0 ? "" : schemas_[schema], encoding), {}});
  }

  void ReadMessage(FieldReader fields, uint32_t chunk) {
    const auto id = fields.Number<uint16_t>();
    fields.Number<uint32_t>();  // sequence
    const auto time = fields.Number<uint64_t>();
    fields.Number<uint64_t>();  // time of publishing
    if (time > uint64_t{std::numeric_limits<int64_t>::max()})
      throw InputError("a message is recorded at " + std::to_string(time) + " ns");
    AddMessage(id, static_cast<int64_t>(time), chunk, fields.left());
  }

  std::map<uint16_t, std::string> schemas_;
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

/// Without chunks and index, which readers can do without.
class McapStorage final : public Ros2Storage {
 public:
  explicit McapStorage(const std::string& path)
      : path_(path), file_(path, std::ios::binary | std::ios::trunc) {
    file_ << kMagic;
    Put(kHeader, Pack(std::string("ros2"), std::string("imu_pose_calib")));
  }

  void AddTopic(const std::string& name, const std::string& type,
                const std::string& definition) override {
    ++topics_;
    const std::string encoding = "cdr", metadata;
    Put(kSchema, Pack(topics_, type, std::string("ros2msg"), definition));
    Put(kChannel, Pack(topics_, topics_, name, encoding, metadata));
  }

  void Write(uint32_t topic, int64_t t_ns, const std::string& data) override {
    const auto channel = static_cast<uint16_t>(topic + 1);
    const uint32_t sequence = 0;
    Put(kMessage, Pack(channel, sequence, t_ns, t_ns) + data);
  }

  void Close() override {
    const uint32_t no_checksum = 0;
    const uint64_t no_summary = 0, no_offsets = 0;
    Put(kDataEnd, Pack(no_checksum));
    Put(kFooter, Pack(no_summary, no_offsets, no_checksum));
    file_ << kMagic;
    file_.close();
    CheckFile();
  }

 private:
  void CheckFile() const {
    if (!file_) throw InputError("cannot write bag '" + path_ + "': " + std::strerror(errno));
  }

  void Put(Opcode opcode, const std::string& content) {
    file_ << Pack(uint8_t{opcode}, uint64_t{content.size()}) << content;
    CheckFile();
  }

  std::string path_;
  std::ofstream file_;
  uint16_t topics_ = 0;
};

}  // namespace

bool IsMcap(std::string_view bytes) { return bytes.substr(0, kMagic.size()) == kMagic; }

std::unique_ptr<BagFile> OpenMcap(std::unique_ptr<InputFile> input, const std::string& name) {
  return std::make_unique<McapFile>(std::move(input), name);
}

std::unique_ptr<Ros2Storage> CreateMcap(const std::string& path) {
  return std::make_unique<McapStorage>(path);
}

}  // namespace imu_pose_calib
