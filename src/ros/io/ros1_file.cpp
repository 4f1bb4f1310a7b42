// The format: http://wiki.ros.org/Bags/Format/2.0. All numbers are little endian.

#include <boost/algorithm/string/predicate.hpp>
#include <filesystem>
#include <map>

#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/record_file.h"

namespace imu_pose_calib {
namespace {

constexpr std::string_view kMagic = "#ROSBAG V", kFormat = "2.0";
constexpr uint64_t kMaxHeader = 1 << 16;  // [bytes] of the fields of a record
/// What the operation codes of records say that they are.
constexpr char kMessage = 0x02, kBag = 0x03, kChunk = 0x05, kConnection = 0x07;

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
std::string Value(const Fields& fields, std::string_view name) {
  const auto field = fields.find(name);
  return std::string(field == fields.end() ? std::string_view() : field->second);
}

template <typename T>
T Number(const Fields& fields, std::string_view name) {
  const auto field = fields.find(name);
  if (field == fields.end()) throw InputError("it has no field " + std::string(name));
  return FieldReader(field->second).Number<T>();
}

/// Bytes after their number; none when the file ends before they do. Throws InputError when there
/// are never that many.
std::optional<std::string_view> Block(FieldReader* reader, uint64_t max_size) {
  if (reader->left().size() < sizeof(uint32_t)) return std::nullopt;
  const auto size = reader->Number<uint32_t>();
  if (size > max_size)
    throw InputError("a length in it is " + std::to_string(size) + ", must be at most " +
                     std::to_string(max_size));
  if (size > reader->left().size()) return std::nullopt;
  return reader->Bytes(size);
}

class Ros1File final : public RecordFile {
 public:
  Ros1File(std::unique_ptr<InputFile> input, const std::string& path)
      : RecordFile(std::move(input), path, "; run: rosbag reindex " + path) {
    ReadFile(kMagic.size() + kFormat.size() + 1);
  }

 private:
  bool ReadRecord(uint32_t chunk, std::string_view* left) override {
    FieldReader reader(*left);
    const std::optional<std::string_view> header = Block(&reader, kMaxHeader);
    const bool is_blank = left->find_first_not_of('\0') == std::string_view::npos;  // never written
    if (!header || is_blank) return false;
    const Fields fields = ReadFields(*header);
    const auto kind = Number<char>(fields, "op");
    const std::optional<std::string_view> data = Block(&reader, kMaxBlockSize);
    if (!data || (kind == kChunk && data->empty())) return false;  // still written, without size
    if (kind == kBag) is_complete_ = IsIndexed(Number<uint64_t>(fields, "index_pos"));
    if (kind == kChunk && chunk == 0) {
      const std::string compression = Value(fields, "compression");
      AddChunk(compression == "none" ? "" : compression, *data, Number<uint32_t>(fields, "size"),
               0);
    }
    if (kind == kConnection) {
      const Fields about = ReadFields(*data);
      AddChannel(Number<uint32_t>(fields, "conn"),
                 {Value(fields, "topic"), Value(about, "type"), Value(about, "md5sum")});
    }
    if (kind == kMessage) {
      ros::Time time;
      const auto halves = Number<uint64_t>(fields, "time");
      time.sec = static_cast<uint32_t>(halves);
      time.nsec = static_cast<uint32_t>(halves >> 32);
      AddMessage(Number<uint32_t>(fields, "conn"), ToNanoseconds(time), chunk, *data);
    }
    *left = reader.left();
    return true;
  }

  /// Whether the recorder has come to write an index.
  bool IsIndexed(uint64_t index_at) const { return index_at > 0 && index_at < bytes().size(); }
};

}  // namespace

std::unique_ptr<BagFile> OpenRos1(const std::string& path) {
  if (!std::filesystem::is_regular_file(path)) throw InputError("bag '" + path + "' is not a file");
  auto input = std::make_unique<InputFile>(path);
  const std::string_view start = input->bytes().substr(0, kMagic.size() + kFormat.size());
  if (!boost::starts_with(start, kMagic))
    throw InputError("'" + path + "' is not a ROS 1 bag, nor an .mcap or .db3 of ROS 2");
  const std::string version(start.substr(kMagic.size()));
  if (version != kFormat)
    throw InputError("bag '" + path + "' is of version " + version +
                     ", must be 2.0; run: " + "rosbag reindex " + path);
  return std::make_unique<Ros1File>(std::move(input), path);
}

}  // namespace imu_pose_calib
