// The format: http://wiki.ros.org/Bags/Format/2.0. All numbers are little endian.

#include <cerrno>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <map>

#include "imu_pose_calib/ros/io/record_file.h"

namespace imu_pose_calib {
namespace {

constexpr std::string_view kMagic = "#ROSBAG V", kFormat = "2.0";
constexpr size_t kMagicSize = kMagic.size() + kFormat.size() + 1;  // with the end of the line
/// What the operation codes of records say that they are.
constexpr char kMessage = 0x02, kIndex = 0x04, kChunk = 0x05, kConnection = 0x07;

using Fields = std::map<std::string, std::string, std::less<>>;

Fields ReadFields(std::string_view header) {
  Fields fields;
  for (FieldReader reader(header); reader.size() > 0;) {
    const std::string_view field = reader.Text();
    const size_t equals = field.find('=');
    if (equals == std::string_view::npos) throw InputError("a field has no name");
    fields[std::string(field.substr(0, equals))] = field.substr(equals + 1);
  }
  return fields;
}

/// The value of a field; empty when there is none.
std::string Value(const Fields& fields, std::string_view name) {
  const auto field = fields.find(name);
  return field == fields.end() ? "" : field->second;
}

constexpr size_t kTimeSize = 8;

int64_t ReadTime(std::string_view bytes) {
  FieldReader reader(bytes);
  const auto seconds = reader.Number<uint32_t>(), nanoseconds = reader.Number<uint32_t>();
  return 1'000'000'000 * int64_t{seconds} + nanoseconds;
}

bool IsZero(FileReader bytes) {
  while (bytes.size() > 0)
    if (bytes.Piece().find_first_not_of('\0') != std::string::npos) return false;
  return true;
}

/// What a record is.
struct Header {
  Fields fields;
  char kind;

  explicit Header(std::string_view bytes) : fields(ReadFields(bytes)) {
    const std::string operation = Value(fields, "op");
    if (operation.size() != 1 || operation[0] == '\0') throw InputError("a record is of no kind");
    kind = operation[0];
  }

  template <typename T = uint32_t>
  T Number(std::string_view name) const {
    return FieldReader(Value(fields, name)).Number<T>();
  }
};

/// The next record of a chunk. Throws InputError when there is no whole one.
struct Record : Header {
  std::string_view data;

  explicit Record(FieldReader* reader) : Header(reader->Text()), data(reader->Text()) {}
};

/// The same of a file, whose data are not read yet.
struct StoredRecord : Header {
  FileReader data;

  explicit StoredRecord(FileReader* reader)
      : Header(reader->Text()), data(reader->Skip(reader->Number<uint32_t>())) {}
};

/// Whether a file that ends with these bytes, which are no whole record, has been cut off there:
/// else they are no record at all.
bool IsCutOff(FileReader rest) {
  constexpr uint32_t kLargestHeader = 1 << 16;
  const auto is_short = [&](uint64_t size) { return rest.size() < size; };
  if (is_short(sizeof(uint32_t))) return true;
  const auto size = rest.Number<uint32_t>();
  if (size == 0) return IsZero(rest);  // never written
  if (size > kLargestHeader) return false;
  if (is_short(size)) return true;
  try {
    if (ReadFields(rest.Bytes(size)).count("op") == 0) return false;
  } catch (const InputError&) {
    return false;
  }
  if (is_short(sizeof(uint32_t))) return true;
  const auto data = rest.Number<uint32_t>();
  return data <= kMaxBlockSize && is_short(data);
}

class Ros1File : public RecordFile {
 public:
  Ros1File(std::unique_ptr<InputFile> input, const std::string& path)
      : RecordFile(std::move(input)), path_(path), remedy_("; run: rosbag reindex " + path) {
    try {
      if (ReadIndexed()) return;
      problem_ = "bag '" + path_ + "' has no index, its recording was cut off" + remedy_;
    } catch (const InputError& error) {
      problem_ = "bag '" + path_ + "' is damaged or cut off (" + error.what() + ")" + remedy_;
    }
    topics_.clear();
    entries_.clear();
    connections_.clear();
    Scan();
  }

  std::string_view Read(const Entry& entry) override {
    try {
      FieldReader reader(Records(entry.chunk));
      reader.Bytes(entry.at);
      for (;;)
        if (const Record record(&reader); record.kind == kMessage) return record.data;
    } catch (const InputError& error) {
      throw InputError("bag '" + path_ + "' is damaged (" + error.what() + ")" + remedy_);
    }
  }

 private:
  /// By the connections at the end and the index after each chunk, of which none is unfolded. False
  /// when the recorder has not come to write them.
  bool ReadIndexed() {
    FileReader first = From(kMagicSize);
    const auto end = StoredRecord(&first).Number<uint64_t>("index_pos");
    if (end == 0) return false;
    FileReader last = From(0);
    for (last.Skip(end); last.size() > 0;)
      if (StoredRecord record(&last); record.kind == kConnection)
        ReadConnection(record, record.data.Bytes(record.data.size()));
    uint32_t chunk = 0;
    for (FileReader reader = From(kMagicSize).Skip(end - kMagicSize); reader.size() > 0;) {
      StoredRecord record(&reader);
      if (record.kind == kChunk) chunk = ReadChunk(record);
      if (record.kind != kIndex) continue;
      if (chunk == 0) throw InputError("an index is of no chunk");
      const uint32_t topic = TopicOf(record);
      const std::string places = record.data.Bytes(record.data.size());
      for (FieldReader index(places); index.size() > 0;) {
        const int64_t t_ns = ReadTime(index.Bytes(kTimeSize));
        entries_.push_back({t_ns, topic, chunk, index.Number<uint32_t>(), 0});
      }
    }
    return true;
  }

  /// Without a usable index: chunk after chunk, as far as they are whole.
  void Scan() {
    FileReader reader = From(kMagicSize);
    FileReader rest = reader;  // from the end of the last record that is whole
    try {
      while (rest.size() > 0) {
        const StoredRecord record(&reader);
        if (record.kind == kChunk && record.data.size() == 0) break;  // still written, without size
        if (record.kind == kChunk) ScanChunk(ReadChunk(record));
        rest = reader;
      }
    } catch (const InputError&) {
      if (!IsCutOff(rest)) throw InputError(problem_);
    }
    const std::string messages = std::to_string(entries_.size()) + " messages";
    note_ = "'" + path_ + "' " +
            (rest.size() == 0 ? "has no index: all of it is read, " + messages
                              : "is cut off: it is read up to byte " + std::to_string(rest.at()) +
                                    " of " + std::to_string(size()) + ", " + messages);
  }

  void ScanChunk(uint32_t chunk) {
    const std::string_view records = Records(chunk);
    for (FieldReader reader(records); reader.size() > 0;) {
      const size_t at = records.size() - reader.size();
      const Record record(&reader);
      if (record.kind == kConnection) ReadConnection(record, record.data);
      if (record.kind != kMessage) continue;
      entries_.push_back({ReadTime(Value(record.fields, "time")), TopicOf(record), chunk, at, 0});
    }
  }

  uint32_t ReadChunk(const StoredRecord& record) {
    const std::string compression = Value(record.fields, "compression");
    if (compression == "none") return AddChunk("", record.data, record.data.size());
    if (compression != "bz2" && compression != "lz4")
      throw InputError("a chunk is compressed otherwise");
    return AddChunk(compression, record.data, record.Number("size"));
  }

  void ReadConnection(const Header& header, std::string_view data) {
    const auto number = static_cast<uint32_t>(topics_.size());
    if (!connections_.emplace(header.Number("conn"), number).second) return;
    const Fields about = ReadFields(data);
    topics_.push_back(
        {Value(header.fields, "topic"), Value(about, "type"), Value(about, "md5sum")});
  }

  uint32_t TopicOf(const Header& header) const {
    const auto topic = connections_.find(header.Number("conn"));
    if (topic == connections_.end()) throw InputError("a message is of no connection");
    return topic->second;
  }

  const std::string path_, remedy_;
  std::map<uint32_t, uint32_t> connections_;  ///< index of the topic
};

}  // namespace

std::unique_ptr<BagFile> OpenRos1(const std::string& path) {
  if (!std::filesystem::is_regular_file(path)) throw InputError("bag '" + path + "' is not a file");
  if (!std::ifstream(path))
    throw InputError("bag '" + path + "' cannot be read: " + std::strerror(errno));
  auto input = std::make_unique<InputFile>(path);
  const std::string start = input->Start().substr(0, kMagicSize - 1);
  if (start.compare(0, kMagic.size(), kMagic) != 0)
    throw InputError("'" + path + "' is not a ROS 1 bag, nor an .mcap or .db3 of ROS 2");
  const std::string version = start.substr(kMagic.size());
  if (version != kFormat)
    throw InputError("bag '" + path + "' is of version " + version + ", must be 2.0");
  return std::make_unique<Ros1File>(std::move(input), path);
}

}  // namespace imu_pose_calib
