#include <rosbag/bag.h>
#include <rosbag/view.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <map>
#include <vector>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/record_file.h"

namespace imu_pose_calib {
namespace {

void CheckVersion(const std::string& path) {
  if (!std::filesystem::is_regular_file(path)) throw InputError("bag '" + path + "' is not a file");
  std::ifstream file(path, std::ios::binary);
  if (!file) throw InputError("bag '" + path + "' cannot be read: " + std::strerror(errno));

  const std::string magic = "#ROSBAG V";
  std::string header(magic.size() + 3, '\0');
  file.read(header.data(), static_cast<std::streamsize>(header.size()));
  if (header.compare(0, magic.size(), magic) != 0)
    throw InputError("'" + path + "' is not a ROS 1 bag, nor an .mcap or .db3 of ROS 2");
  const std::string version = header.substr(magic.size());
  if (version != "1.2" && version != "2.0")
    throw InputError("bag '" + path + "' is of version " + version + ", must be 1.2 or 2.0");
}

// --- With an index ---

class Ros1File : public BagFile {
 public:
  explicit Ros1File(std::unique_ptr<rosbag::Bag> bag) : bag_(std::move(bag)) {
    for (const rosbag::ConnectionInfo* connection : rosbag::View(*bag_).getConnections()) {
      const auto topic = static_cast<uint32_t>(topics_.size());
      topics_.push_back({connection->topic, connection->datatype, connection->md5sum});
      const auto is_its = [&](const rosbag::ConnectionInfo* other) { return other == connection; };
      rosbag::View view(*bag_, is_its);
      for (const rosbag::MessageInstance& message : view) {
        entries_.push_back({ToNanoseconds(message.getTime()), topic, 0, messages_.size(), 0});
        messages_.push_back(message);
      }
    }
  }

  std::string_view Read(const Entry& entry) override {
    const rosbag::MessageInstance& message = messages_[entry.at];
    data_.resize(message.size());
    ros::serialization::OStream stream(data_.data(), static_cast<uint32_t>(data_.size()));
    message.write(stream);
    return {reinterpret_cast<const char*>(data_.data()), data_.size()};
  }

 private:
  std::unique_ptr<rosbag::Bag> bag_;
  std::vector<rosbag::MessageInstance> messages_;
  std::vector<uint8_t> data_;
};

// --- Without a usable index: chunk after chunk, as far as they are whole ---

constexpr size_t kMagicSize = 13;  // "#ROSBAG V2.0\n"
/// What the operation codes of records say that they are.
constexpr char kMessage = 0x02, kChunk = 0x05, kConnection = 0x07;

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

uint32_t Number(const Fields& fields, std::string_view name) {
  return FieldReader(Value(fields, name)).Number<uint32_t>();
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

class Ros1Scan : public RecordFile {
 public:
  /// `problem` is thrown when the file is damaged otherwise.
  Ros1Scan(const std::string& path, const std::string& problem)
      : RecordFile(std::make_unique<InputFile>(path)) {
    problem_ = problem;
    FieldReader reader(bytes().substr(std::min(kMagicSize, bytes().size())));
    std::string_view rest = reader.left();  // from the end of the last record that is whole
    try {
      while (!rest.empty()) {
        const Record record(&reader);
        if (record.kind == kChunk && record.data.empty()) break;  // still written, without size
        if (record.kind == kChunk) ReadChunk(record);
        rest = reader.left();
      }
    } catch (const InputError&) {
      if (!IsCutOff(rest)) throw InputError(problem);
    }
    const std::string messages = std::to_string(entries_.size()) + " messages";
    const size_t all = bytes().size(), read = all - rest.size();
    note_ = "'" + path + "' " +
            (rest.empty() ? "has no index: all of it is read, " + messages
                          : "is cut off: it is read up to byte " + std::to_string(read) + " of " +
                                std::to_string(all) + ", " + messages);
  }

 private:
  void ReadChunk(const Record& record) {
    const std::string_view compression = Value(record.fields, "compression");
    if (compression != "none" && compression != "bz2" && compression != "lz4")
      throw InputError("a chunk is compressed otherwise");
    const uint32_t chunk = compression == "none"
                               ? AddChunk("", record.data, record.data.size())
                               : AddChunk(compression, record.data, Number(record.fields, "size"));
    const std::string_view records = Records(chunk);
    for (FieldReader reader(records); !reader.left().empty();) {
      const Record inner(&reader);
      if (inner.kind == kConnection) ReadConnection(inner);
      if (inner.kind != kMessage) continue;
      const auto topic = connections_.find(Number(inner.fields, "conn"));
      if (topic == connections_.end()) throw InputError("a message is of no connection");
      FieldReader time(Value(inner.fields, "time"));
      const auto seconds = time.Number<uint32_t>(), nanoseconds = time.Number<uint32_t>();
      entries_.push_back({1'000'000'000 * int64_t{seconds} + nanoseconds, topic->second, chunk,
                          static_cast<uint64_t>(inner.data.data() - records.data()),
                          inner.data.size()});
    }
  }

  void ReadConnection(const Record& record) {
    const auto number = static_cast<uint32_t>(topics_.size());
    if (!connections_.emplace(Number(record.fields, "conn"), number).second) return;
    const Fields about = ReadFields(record.data);
    topics_.push_back({std::string(Value(record.fields, "topic")),
                       std::string(Value(about, "type")), std::string(Value(about, "md5sum"))});
  }

  std::map<uint32_t, uint32_t> connections_;  ///< index of the topic
};

}  // namespace

std::unique_ptr<BagFile> OpenRos1(const std::string& path) {
  CheckVersion(path);
  auto bag = std::make_unique<rosbag::Bag>();
  try {
    bag->open(path);
  } catch (const rosbag::BagUnindexedException&) {
    return std::make_unique<Ros1Scan>(path, "bag '" + path +
                                                "' has no index, its recording was cut off; " +
                                                "run: rosbag reindex " + path);
  } catch (const rosbag::BagException& error) {
    return std::make_unique<Ros1Scan>(path, "bag '" + path + "' is damaged or cut off (" +
                                                error.what() + "); run: rosbag reindex " + path);
  }
  return std::make_unique<Ros1File>(std::move(bag));
}

}  // namespace imu_pose_calib
