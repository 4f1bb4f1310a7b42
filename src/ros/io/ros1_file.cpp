// The format: http://wiki.ros.org/Bags/Format/2.0. All numbers are little endian.

#include <map>

#include "imu_pose_calib/ros/io/bag_file.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

constexpr std::string_view kFormat = "2.0";
constexpr size_t kBegin = kRos1Magic.size() + kFormat.size() + 1;  // of records, after the line
/// What the operation codes of records say that they are.
constexpr char kMessage = 0x02, kIndex = 0x04, kChunk = 0x05, kConnection = 0x07;

using Fields = std::map<std::string, std::string>;

Fields ReadFields(ByteReader header) {
  Fields fields;
  while (header.size() > 0) {
    const std::string field = header.Part().All();
    const size_t equals = field.find('=');
    if (equals == std::string::npos) Reject("a field has no name");
    fields[field.substr(0, equals)] = field.substr(equals + 1);
  }
  return fields;
}

constexpr size_t kTimeSize = 8;

int64_t ReadTime(ByteReader reader) {
  const auto seconds = reader.Number<uint32_t>(), nanoseconds = reader.Number<uint32_t>();
  return 1'000'000'000 * int64_t{seconds} + nanoseconds;
}

bool IsZero(ByteReader bytes) {
  while (bytes.size() > 0)
    if (bytes.Piece().find_first_not_of('\0') != std::string::npos) return false;
  return true;
}

/// The next record. Throws InputError when there is no whole one.
struct Record {
  Fields fields;  ///< those that there are not are empty
  ByteReader data;
  char kind = '\0';

  explicit Record(ByteReader* reader) : fields(ReadFields(reader->Part())), data(reader->Part()) {
    if (fields["op"].size() == 1) kind = fields["op"][0];
    if (kind == '\0') Reject("a record is of no kind");
  }

  template <typename T = uint32_t>
  T Number(const std::string& name) {
    return ByteReader(fields[name]).Number<T>();
  }
};

/// Whether a file that ends with these bytes, which are no whole record, has been cut off there:
/// else they are no record at all.
bool IsCutOff(ByteReader rest) {
  constexpr uint32_t kLargestHeader = 1 << 16;
  if (rest.size() < sizeof(uint32_t)) return true;
  const auto size = rest.Number<uint32_t>();
  if (size == 0) return IsZero(rest);  // never written
  if (size > kLargestHeader || size > rest.size()) return size <= kLargestHeader;
  try {
    if (ReadFields(rest.Skip(size)).count("op") == 0) return false;
  } catch (const InputError&) {
    return false;
  }
  if (rest.size() < sizeof(uint32_t)) return true;
  const auto data = rest.Number<uint32_t>();
  return data <= kMaxBlockSize && data > rest.size();
}

class Ros1File : public RecordFile {
 public:
  Ros1File(std::unique_ptr<InputFile> input, const std::string& path)
      : RecordFile(std::move(input)), path_(path), remedy_("; run: rosbag reindex " + path) {
    ByteReader rest = From(kBegin);  // from the end of the last record that is whole
    try {
      ByteReader first = rest;
      const auto index_at = Record(&first).Number<uint64_t>("index_pos");
      From(0).Skip(index_at);  // is there
      if (index_at > 0) {
        ReadRecords(true, &rest);
        return;
      }
      problem_ = "bag '" + path_ + "' has no index, its recording was cut off" + remedy_;
    } catch (const InputError& error) {
      problem_ = "bag '" + path_ + "' is damaged or cut off (" + error.what() + ")" + remedy_;
    }
    topics_.clear();
    entries_.clear();
    connections_.clear();
    rest = From(kBegin);
    try {
      ReadRecords(false, &rest);
    } catch (const InputError&) {
      if (!IsCutOff(rest)) Reject(problem_);
    }
    note_ = "'" + path_ + "' has no index: all of it is read, " + std::to_string(entries_.size()) +
            " messages";
    if (rest.size() > 0) NoteCutOff(path_, rest.at());
  }

  std::string_view Read(const Entry& entry) override {
    try {
      const std::string_view records = Records(entry.chunk);
      ByteReader reader(records);
      reader.Skip(entry.at);
      for (;;)
        if (Record record(&reader); record.kind == kMessage)
          return records.substr(record.data.at(), record.data.size());
    } catch (const InputError& error) {
      Reject("bag '", path_, "' is damaged (", error.what(), ")", remedy_);
    }
  }

 private:
  /// By the index after each chunk, of which none is unfolded, and the connections at the end;
  /// without a usable index by what the chunks hold, as far as they are whole.
  void ReadRecords(bool is_indexed, ByteReader* rest) {
    uint32_t chunk = 0;
    for (ByteReader reader = *rest; reader.size() > 0; *rest = reader) {
      Record record(&reader);
      if (record.kind == kConnection) ReadConnection(record);
      if (record.kind == kIndex && is_indexed) ReadIndex(record, chunk);
      if (record.kind != kChunk) continue;
      if (!is_indexed && record.data.size() == 0) return;  // still written, without size
      chunk = ReadChunk(record);
      if (!is_indexed) ScanChunk(chunk);
    }
    if (is_indexed)
      for (Entry& entry : entries_) entry.topic = TopicOf(entry.topic);
  }

  /// Of messages whose topic is the number of a connection, which comes later.
  void ReadIndex(Record& record, uint32_t chunk) {
    if (chunk == 0) Reject("an index is of no chunk");
    const auto connection = record.Number("conn");
    for (ByteReader index = record.data; index.size() > 0;) {
      const int64_t t_ns = ReadTime(index.Skip(kTimeSize));
      entries_.push_back({t_ns, connection, chunk, index.Number<uint32_t>(), 0});
    }
  }

  void ScanChunk(uint32_t chunk) {
    for (ByteReader reader(Records(chunk)); reader.size() > 0;) {
      const uint64_t at = reader.at();
      Record record(&reader);
      if (record.kind == kConnection) ReadConnection(record);
      if (record.kind != kMessage) continue;
      const int64_t t_ns = ReadTime(ByteReader(record.fields["time"]));
      entries_.push_back({t_ns, TopicOf(record.Number("conn")), chunk, at, 0});
    }
  }

  uint32_t ReadChunk(Record& record) {
    const std::string compression = record.fields["compression"];
    if (compression == "none") return AddChunk("", record.data, record.data.size());
    if (compression != "bz2" && compression != "lz4") Reject("a chunk is compressed otherwise");
    return AddChunk(compression, record.data, record.Number("size"));
  }

  void ReadConnection(Record& record) {
    const auto number = static_cast<uint32_t>(topics_.size());
    if (!connections_.emplace(record.Number("conn"), number).second) return;
    Fields about = ReadFields(record.data);
    topics_.push_back({record.fields["topic"], about["type"], about["md5sum"]});
  }

  uint32_t TopicOf(uint32_t connection) const {
    const auto topic = connections_.find(connection);
    if (topic == connections_.end()) Reject("a message is of no connection");
    return topic->second;
  }

  const std::string path_, remedy_;
  std::map<uint32_t, uint32_t> connections_;  ///< index of the topic
};

}  // namespace

std::unique_ptr<BagFile> OpenRos1(std::unique_ptr<InputFile> input, const std::string& name) {
  const std::string version = input->Start().substr(kRos1Magic.size(), kFormat.size());
  if (version != kFormat) Reject("bag '", name, "' is of version ", version, ", must be 2.0");
  return std::make_unique<Ros1File>(std::move(input), name);
}

}  // namespace imu_pose_calib
