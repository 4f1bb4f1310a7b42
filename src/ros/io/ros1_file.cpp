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

using Fields = std::map<std::string_view, std::string_view>;

Fields ReadFields(std::string_view header) {
  Fields fields;
  for (FieldReader reader(header); !reader.left().empty();) {
    const std::string_view field = reader.Text();
    const size_t equals = field.find('=');
    if (equals == std::string_view::npos) throw InputError("a field has no name");
    fields[field.substr(0, equals)] = field.substr(equals + 1);
  }
  return fields;
}

/// The value of a field; empty when there is none.
std::string_view Value(const Fields& fields, std::string_view name) {
  const auto field = fields.find(name);
  return field == fields.end() ? std::string_view() : field->second;
}

template <typename T = uint32_t>
T Number(const Fields& fields, std::string_view name) {
  return FieldReader(Value(fields, name)).Number<T>();
}

int64_t ReadTime(FieldReader* reader) {
  const auto seconds = reader->Number<uint32_t>(), nanoseconds = reader->Number<uint32_t>();
  return 1'000'000'000 * int64_t{seconds} + nanoseconds;
}

struct Record {
  Fields fields;
  std::string_view data;
  char kind;

  /// The next record. Throws InputError when there is no whole one.
  explicit Record(FieldReader* reader)
      : fields(ReadFields(reader->Text())),
        data(reader->Text()),
        kind(Value(fields, "op").size() == 1 ? Value(fields, "op")[0] : '\0') {
    if (kind == '\0') throw InputError("a record is of no kind");
  }
};

/// Whether a file that ends with these bytes, which are no whole record, has been cut off there:
/// else they are no record at all.
bool IsCutOff(std::string_view bytes) {
  constexpr uint32_t kLargestHeader = 1 << 16;
  FieldReader rest(bytes);
  const auto is_short = [&](uint64_t size) { return rest.left().size() < size; };
  if (is_short(sizeof(uint32_t))) return true;
  const auto size = rest.Number<uint32_t>();
  if (size == 0) return bytes.find_first_not_of('\0') == std::string_view::npos;  // never written
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
    FieldReader all(bytes());
    all.Bytes(kMagicSize);
    FieldReader first = all;
    const auto end = Number<uint64_t>(Record(&first).fields, "index_pos");
    if (end == 0) return false;
    FieldReader last(bytes());
    for (last.Bytes(end); !last.left().empty();)
      if (const Record record(&last); record.kind == kConnection) ReadConnection(record);
    uint32_t chunk = 0;
    for (FieldReader reader(all.Bytes(end - kMagicSize)); !reader.left().empty();) {
      const Record record(&reader);
      if (record.kind == kChunk) chunk = ReadChunk(record);
      if (record.kind != kIndex) continue;
      const uint32_t topic = TopicOf(record);
      for (FieldReader index(record.data); !index.left().empty();) {
        const int64_t t_ns = ReadTime(&index);
        entries_.push_back({t_ns, topic, chunk, index.Number<uint32_t>(), 0});
      }
    }
    return true;
  }

  /// Without a usable index: chunk after chunk, as far as they are whole.
  void Scan() {
    FieldReader reader(bytes());
    reader.Bytes(std::min(kMagicSize, bytes().size()));
    std::string_view rest = reader.left();  // from the end of the last record that is whole
    try {
      while (!rest.empty()) {
        const Record record(&reader);
        if (record.kind == kChunk && record.data.empty()) break;  // still written, without size
        if (record.kind == kChunk) ScanChunk(ReadChunk(record));
        rest = reader.left();
      }
    } catch (const InputError&) {
      if (!IsCutOff(rest)) throw InputError(problem_);
    }
    const std::string messages = std::to_string(entries_.size()) + " messages";
    const size_t all = bytes().size(), read = all - rest.size();
    note_ = "'" + path_ + "' " +
            (rest.empty() ? "has no index: all of it is read, " + messages
                          : "is cut off: it is read up to byte " + std::to_string(read) + " of " +
                                std::to_string(all) + ", " + messages);
  }

  void ScanChunk(uint32_t chunk) {
    const std::string_view records = Records(chunk);
    for (FieldReader reader(records); !reader.left().empty();) {
      const size_t at = records.size() - reader.left().size();
      const Record record(&reader);
      if (record.kind == kConnection) ReadConnection(record);
      if (record.kind != kMessage) continue;
      FieldReader time(Value(record.fields, "time"));
      entries_.push_back({ReadTime(&time), TopicOf(record), chunk, at, 0});
    }
  }

  uint32_t ReadChunk(const Record& record) {
    const std::string_view compression = Value(record.fields, "compression");
    if (compression == "none") return AddChunk("", record.data, record.data.size());
    if (compression != "bz2" && compression != "lz4")
      throw InputError("a chunk is compressed otherwise");
    return AddChunk(compression, record.data, Number(record.fields, "size"));
  }

  void ReadConnection(const Record& record) {
    const auto number = static_cast<uint32_t>(topics_.size());
    if (!connections_.emplace(Number(record.fields, "conn"), number).second) return;
    const Fields about = ReadFields(record.data);
    topics_.push_back({std::string(Value(record.fields, "topic")),
                       std::string(Value(about, "type")), std::string(Value(about, "md5sum"))});
  }

  uint32_t TopicOf(const Record& record) const {
    const auto topic = connections_.find(Number(record.fields, "conn"));
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
  const std::string_view start = input->bytes().substr(0, kMagicSize - 1);
  if (start.substr(0, kMagic.size()) != kMagic)
    throw InputError("'" + path + "' is not a ROS 1 bag, nor an .mcap or .db3 of ROS 2");
  const std::string version(start.substr(kMagic.size()));
  if (version != kFormat)
    throw InputError("bag '" + path + "' is of version " + version + ", must be 2.0");
  return std::make_unique<Ros1File>(std::move(input), path);
}

}  // namespace imu_pose_calib
