// Bags of ROS 1 without a usable index: chunk after chunk, as far as they are whole.

#include <rosbag/chunked_file.h>
#include <rosbag/stream.h>

#include <algorithm>
#include <cstring>
#include <filesystem>

#include "imu_pose_calib/ros/io/compression.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/message_source.h"

namespace imu_pose_calib {
namespace {

constexpr char kMagic[] = "#ROSBAG V2.0\n";
/// First bytes of records: what they are.
constexpr char kMessage = 0x02, kChunk = 0x05, kConnection = 0x07;

/// Cuts a number or so many bytes off the front. False when there are not enough.
bool Take(std::string_view* bytes, size_t size, std::string_view* taken) {
  if (bytes->size() < size) return false;
  *taken = bytes->substr(0, size);
  bytes->remove_prefix(size);
  return true;
}
bool Take(std::string_view* bytes, uint32_t* number) {
  std::string_view taken;
  if (!Take(bytes, sizeof(*number), &taken)) return false;
  std::memcpy(number, taken.data(), sizeof(*number));  // little endian, as here
  return true;
}

using Fields = std::map<std::string_view, std::string_view>;

bool ReadFields(std::string_view header, Fields* fields) {
  while (!header.empty()) {
    uint32_t size = 0;
    std::string_view field;
    if (!Take(&header, &size) || !Take(&header, size, &field)) return false;
    const size_t equals = field.find('=');
    if (equals == std::string_view::npos) return false;
    (*fields)[field.substr(0, equals)] = field.substr(equals + 1);
  }
  return true;
}

struct Record {
  Fields fields;
  std::string_view data;

  /// The value of a field of four bytes; the largest number when it has none.
  uint32_t Number(std::string_view name, size_t at = 0) const {
    uint32_t number = UINT32_MAX;
    const auto field = fields.find(name);
    if (field != fields.end() && field->second.size() >= at + sizeof(number))
      std::memcpy(&number, field->second.data() + at, sizeof(number));
    return number;
  }
  char Kind() const {
    const auto op = fields.find("op");
    return op == fields.end() || op->second.size() != 1 ? '\0' : op->second[0];
  }
};

/// The next record; false when there is no whole one.
bool Next(std::string_view* bytes, Record* record) {
  uint32_t size = 0;
  std::string_view header;
  record->fields.clear();
  return Take(bytes, &size) && Take(bytes, size, &header) && ReadFields(header, &record->fields) &&
         Take(bytes, &size) && Take(bytes, size, &record->data) && record->Kind() != '\0';
}

/// Whether a file that ends with these bytes, which are no whole record, has been cut off there:
/// else they are no record at all.
bool IsCutOff(std::string_view bytes) {
  constexpr uint32_t kLargestHeader = 1 << 16;
  uint32_t size = 0;
  std::string_view header;
  Fields fields;
  if (!Take(&bytes, &size)) return true;
  if (size == 0) return bytes.find_first_not_of('\0') == std::string_view::npos;  // never written
  if (size > kLargestHeader) return false;
  if (!Take(&bytes, size, &header)) return true;
  if (!ReadFields(header, &fields) || fields.count("op") == 0) return false;
  return !Take(&bytes, &size) || (size <= kMaxBlockSize && size > bytes.size());
}

/// The records in a chunk. False when they cannot be had.
bool Unfold(const Record& chunk, std::string* records) {
  const std::string_view compression =
      chunk.fields.count("compression") > 0 ? chunk.fields.at("compression") : std::string_view();
  const uint32_t size = chunk.Number("size");
  if (size > kMaxBlockSize) return false;
  if (compression == "none") {
    *records = chunk.data;
    return true;
  }
  if (compression != "bz2" && compression != "lz4") return false;
  records->assign(size, '\0');
  rosbag::ChunkedFile none;
  auto* from = reinterpret_cast<uint8_t*>(const_cast<char*>(chunk.data.data()));
  auto* to = reinterpret_cast<uint8_t*>(records->data());
  try {
    const auto unfold = [&](auto&& stream) {
      stream.decompress(to, size, from, static_cast<unsigned>(chunk.data.size()));
    };
    if (compression == "bz2")
      unfold(rosbag::BZ2Stream(&none));
    else
      unfold(rosbag::LZ4Stream(&none));
  } catch (const rosbag::BagException&) {
    return false;
  }
  return true;
}

class Ros1Scan : public MessageSource {
 public:
  explicit Ros1Scan(const std::vector<std::string>& paths) {
    for (const std::string& path : paths) Scan(path);
    std::stable_sort(messages_.begin(), messages_.end(),
                     [](const Message& a, const Message& b) { return a.t_ns < b.t_ns; });
  }

  bool IsEmpty() const { return messages_.empty(); }
  bool IsDamaged() const { return is_damaged_; }

  std::map<std::string, std::set<std::string>> Types() const override {
    std::map<std::string, std::set<std::string>> types;
    for (const File& file : files_)
      for (const auto& [id, connection] : file.connections)
        types[connection.topic].insert(connection.type);
    return types;
  }

  std::optional<std::pair<ros::Time, ros::Time>> Span() const override {
    if (IsEmpty()) return std::nullopt;
    return std::make_pair(FromNanoseconds(messages_.front().t_ns),
                          FromNanoseconds(messages_.back().t_ns));
  }

  std::map<std::string, uint32_t> Counts(const ros::Time& start,
                                         const ros::Time& end) const override {
    std::map<std::string, uint32_t> counts;
    Visit(start, end, [&](const Message& message) {
      ++counts[Of(message).topic];
      return true;
    });
    return counts;
  }

  void ForEach(const std::vector<std::string>& topics, const ros::Time& start, const ros::Time& end,
               const std::function<bool(const BagMessage&)>& use) const override {
    Visit(start, end, [&](const Message& message) {
      const Connection& connection = Of(message);
      if (std::count(topics.begin(), topics.end(), connection.topic) == 0) return true;
      const std::string& records = Records(message);
      return use({connection.topic, connection.type, FromNanoseconds(message.t_ns),
                  std::string_view(records).substr(message.at, message.size), &connection.md5sum});
    });
  }

  std::vector<std::string> Notes() const override { return notes_; }

 private:
  struct Connection {
    std::string topic, type, md5sum;
  };
  struct Message {
    int64_t t_ns;
    size_t chunk;  ///< where its record begins in the file
    uint32_t file, connection, at, size;
  };
  struct File {
    std::unique_ptr<InputFile> input;
    std::map<uint32_t, Connection> connections;
    // The chunk that was unfolded last.
    size_t chunk = 0;
    std::string records;
  };

  void Scan(const std::string& path) {
    File file;
    file.input = std::make_unique<InputFile>(path);
    const std::string_view all = file.input->bytes();
    const size_t magic = std::strlen(kMagic), before = messages_.size();
    std::string_view rest = all.substr(std::min(magic, all.size()));
    std::string_view whole = rest;  // from the end of the last record that is whole
    Record record;
    bool is_open = false;  // a chunk that is still written has no size yet
    while (Next(&rest, &record)) {
      is_open = record.Kind() == kChunk && record.data.empty();
      if (is_open) break;
      if (record.Kind() == kChunk &&
          !AddChunk(record, static_cast<size_t>(whole.data() - all.data()), &file)) {
        is_damaged_ = true;
        break;
      }
      whole = rest;
    }
    if (!whole.empty() && !is_open && !IsCutOff(whole)) is_damaged_ = true;
    if (!whole.empty())
      notes_.push_back("'" + path + "' is cut off: it is read up to byte " +
                       std::to_string(all.size() - whole.size()) + " of " +
                       std::to_string(all.size()) + ", " +
                       std::to_string(messages_.size() - before) + " messages");
    else
      notes_.push_back("'" + path + "' has no index: all of it is read, " +
                       std::to_string(messages_.size() - before) + " messages");
    files_.push_back(std::move(file));
  }

  /// Takes a chunk as far as it is whole. False when it is not.
  bool AddChunk(const Record& chunk, size_t place, File* file) {
    if (!Unfold(chunk, &file->records)) return false;
    file->chunk = place;
    std::string_view rest = file->records;
    Record record;
    while (Next(&rest, &record)) {
      const uint32_t id = record.Number("conn");
      Fields about;
      if (record.Kind() == kConnection && ReadFields(record.data, &about)) {
        const auto text = [](const Fields& fields, std::string_view name) {
          return fields.count(name) > 0 ? std::string(fields.at(name)) : std::string();
        };
        file->connections[id] = {text(record.fields, "topic"), text(about, "type"),
                                 text(about, "md5sum")};
      }
      if (record.Kind() != kMessage) continue;
      if (file->connections.count(id) == 0) return false;
      const auto at = static_cast<size_t>(record.data.data() - file->records.data());
      messages_.push_back({1'000'000'000 * static_cast<int64_t>(record.Number("time")) +
                               record.Number("time", sizeof(uint32_t)),
                           place, static_cast<uint32_t>(files_.size()), id,
                           static_cast<uint32_t>(at), static_cast<uint32_t>(record.data.size())});
    }
    return rest.empty();
  }

  const Connection& Of(const Message& message) const {
    return files_[message.file].connections.at(message.connection);
  }

  /// Of the chunk that a message is in.
  const std::string& Records(const Message& message) const {
    File& file = files_[message.file];
    if (file.chunk != message.chunk) {
      std::string_view rest = file.input->bytes().substr(message.chunk);
      Record chunk;
      if (!Next(&rest, &chunk) || !Unfold(chunk, &file.records))
        throw InputError("bag '" + file.input->path() + "' has changed");
      file.chunk = message.chunk;
    }
    return file.records;
  }

  /// Calls `use(message)` in the order of recording while it is true.
  template <typename Use>
  void Visit(const ros::Time& start, const ros::Time& end, Use use) const {
    const auto first = std::lower_bound(messages_.begin(), messages_.end(), ToNanoseconds(start),
                                        [](const Message& m, int64_t t) { return m.t_ns < t; });
    for (auto m = first; m != messages_.end() && m->t_ns <= ToNanoseconds(end); ++m)
      if (!use(*m)) return;
  }

  mutable std::vector<File> files_;
  std::vector<Message> messages_;  ///< in the order of recording
  std::vector<std::string> notes_;
  bool is_damaged_ = false;  ///< otherwise than by being cut off
};

}  // namespace

std::unique_ptr<MessageSource> ScanRos1(const std::vector<std::string>& paths) {
  auto source = std::make_unique<Ros1Scan>(paths);
  return source->IsEmpty() || source->IsDamaged() ? nullptr : std::move(source);
}

}  // namespace imu_pose_calib
