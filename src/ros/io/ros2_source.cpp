#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <array>
#include <filesystem>
#include <fstream>

#include "imu_pose_calib/ros/io/compression.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/message_source.h"
#include "imu_pose_calib/ros/io/ros2_file.h"
#include "imu_pose_calib/ros/io/yaml_file.h"

namespace imu_pose_calib {
namespace {

namespace fs = std::filesystem;

/// Of the files that a bag of ROS 2 is made of, the longer ones first.
const std::array<std::string, 4> kEndings = {".mcap.zstd", ".db3.zstd", ".mcap", ".db3"};
constexpr size_t kMaxMetadata = 10'000'000;  // [bytes] grows with the topics and their QoS

bool EndsWith(const std::string& text, const std::string& ending) {
  return text.size() > ending.size() &&
         text.compare(text.size() - ending.size(), ending.size(), ending) == 0;
}

bool HasBagEnding(const fs::path& path) {
  return std::any_of(kEndings.begin(), kEndings.end(),
                     [&](const std::string& ending) { return EndsWith(path.filename(), ending); });
}

/// Files of a bag in a folder, by name.
std::vector<fs::path> FindBagFiles(const fs::path& folder) {
  std::vector<fs::path> files;
  std::error_code ignored;
  for (const fs::directory_entry& entry : fs::directory_iterator(folder, ignored))
    if (HasBagEnding(entry.path()) && entry.is_regular_file(ignored)) files.push_back(entry.path());
  std::sort(files.begin(), files.end());
  return files;
}

/// The files that a metadata.yaml names, which lie beside it whatever folder it gives them.
std::vector<fs::path> ReadMetadata(const fs::path& metadata) {
  std::vector<fs::path> files;
  try {
    const YAML::Node root = ParseYaml(ReadYamlFile(metadata, kMaxMetadata));
    const YAML::Node names = root["rosbag2_bagfile_information"]["relative_file_paths"];
    if (!names || !names.IsSequence() || names.size() == 0)
      throw InputError("relative_file_paths names no files");
    for (const YAML::Node& name : names) {
      const fs::path given = name.as<std::string>();
      fs::path file = metadata.parent_path() / given.filename();
      if (!fs::exists(file) && fs::exists(file.string() + ".zstd")) file += ".zstd";
      if (!given.has_filename() || !fs::is_regular_file(file))
        throw InputError("the file '" + given.string() + "' that it names is missing");
      files.push_back(file);
    }
  } catch (const YAML::Exception& error) {
    throw InputError("'" + metadata.string() + "': rosbag2_bagfile_information: " + error.msg);
  } catch (const InputError& error) {
    throw InputError("'" + metadata.string() + "': " + error.what());
  }
  return files;
}

/// The files of the bag at `path`. Without a metadata.yaml, which is written last, all that there
/// are.
std::vector<fs::path> BagFiles(const fs::path& path) {
  if (!fs::is_directory(path)) return {path};
  const fs::path metadata = path / "metadata.yaml";
  return fs::exists(metadata) ? ReadMetadata(metadata) : FindBagFiles(path);
}

/// "sensor_msgs/Imu" for "sensor_msgs/msg/Imu".
std::string Ros1Type(const Ros2File::Topic& topic) {
  std::string type = topic.type;
  const size_t at = type.find("/msg/");
  if (at != std::string::npos) type.erase(at, 4);
  return topic.encoding == "cdr" ? type : type + " in " + topic.encoding;
}

class Ros2Source : public MessageSource {
 public:
  explicit Ros2Source(const std::vector<std::string>& paths) {
    for (const std::string& path : paths)
      for (const fs::path& file : BagFiles(path)) Open(file);
    std::stable_sort(index_.begin(), index_.end(),
                     [](const Place& a, const Place& b) { return a.entry.t_ns < b.entry.t_ns; });
  }

  std::map<std::string, std::set<std::string>> Types() const override {
    std::map<std::string, std::set<std::string>> types;
    for (const File& file : files_)
      for (size_t k = 0; k < file.types.size(); ++k)
        types[file.reader->topics()[k].name].insert(file.types[k]);
    return types;
  }

  std::optional<std::pair<ros::Time, ros::Time>> Span() const override {
    if (index_.empty()) return std::nullopt;
    return std::make_pair(Time(index_.front()), Time(index_.back()));
  }

  std::map<std::string, uint32_t> Counts(const ros::Time& start,
                                         const ros::Time& end) const override {
    std::map<std::string, uint32_t> counts;
    const auto all = [](const Ros2File::Topic&) { return true; };
    Visit(all, start, end, [&](const Place& place) {
      ++counts[files_[place.file].reader->topics()[place.entry.topic].name];
      return true;
    });
    return counts;
  }

  void ForEach(const std::vector<std::string>& topics, const ros::Time& start, const ros::Time& end,
               const std::function<bool(const BagMessage&)>& use) const override {
    std::string unfolded;
    const auto is_wanted = [&topics](const Ros2File::Topic& topic) {
      return std::count(topics.begin(), topics.end(), topic.name) > 0;
    };
    Visit(is_wanted, start, end, [&](const Place& place) {
      const File& file = files_[place.file];
      const Ros2File::Topic& topic = file.reader->topics()[place.entry.topic];
      BagMessage message{topic.name, file.types[place.entry.topic], Time(place), {}};
      message.data = file.reader->Read(place.entry);
      if (IsZstd(message.data)) {  // CDR begins with 0
        message.Decode(
            [&](std::string_view data) { unfolded = DecompressZstd(data, kMaxBlockSize); });
        message.data = unfolded;
      }
      return use(message);
    });
  }

  std::vector<std::string> Notes() const override {
    std::vector<std::string> notes;
    for (const File& file : files_)
      if (!file.reader->note().empty()) notes.push_back(file.reader->note());
    return notes;
  }

 private:
  struct File {
    std::unique_ptr<InputFile> input;
    std::unique_ptr<Ros2File> reader;  ///< goes before what it reads
    std::vector<std::string> types;    ///< of its topics
  };
  struct Place {
    Ros2File::Entry entry;
    uint32_t file;
  };

  void Open(const fs::path& path) {
    File file;
    file.input = std::make_unique<InputFile>(path);
    const std::string_view bytes = file.input->bytes();
    if (IsSqlite(bytes)) {
      file.reader = OpenSqlite(file.input->path(), path);
    } else if (IsMcap(bytes)) {
      file.reader = OpenMcap(bytes, path);
    } else {
      throw InputError("'" + path.string() + "' is neither an mcap file nor a database of SQLite" +
                       (bytes.empty() ? ": it is empty" : ""));
    }
    file.input->RemoveTemporary();
    for (const Ros2File::Topic& topic : file.reader->topics())
      file.types.push_back(Ros1Type(topic));
    for (const Ros2File::Entry& entry : file.reader->entries()) {
      FromNanoseconds(entry.t_ns);  // that it fits
      index_.push_back({entry, static_cast<uint32_t>(files_.size())});
    }
    files_.push_back(std::move(file));
  }

  static ros::Time Time(const Place& place) { return FromNanoseconds(place.entry.t_ns); }

  /// Calls `use(place)` for the topics wanted in the order of recording while it is true.
  template <typename IsWanted, typename Use>
  void Visit(IsWanted is_wanted, const ros::Time& start, const ros::Time& end, Use use) const {
    std::vector<std::vector<bool>> wanted;
    for (const File& file : files_) {
      wanted.emplace_back();
      for (const Ros2File::Topic& topic : file.reader->topics())
        wanted.back().push_back(is_wanted(topic));
    }
    const int64_t begin_ns = ToNanoseconds(start), end_ns = ToNanoseconds(end);
    const auto first =
        std::lower_bound(index_.begin(), index_.end(), begin_ns,
                         [](const Place& place, int64_t t_ns) { return place.entry.t_ns < t_ns; });
    for (auto place = first; place != index_.end() && place->entry.t_ns <= end_ns; ++place)
      if (wanted[place->file][place->entry.topic] && !use(*place)) return;
  }

  std::vector<File> files_;
  std::vector<Place> index_;  ///< in the order of recording
};

}  // namespace

void BagMessage::Decode(const std::function<void(std::string_view)>& decode) const {
  if (md5sum) return;
  try {
    decode(data);
  } catch (const InputError& error) {
    throw InputError("topic '" + topic + "', message recorded at " +
                     std::to_string(ToNanoseconds(time)) + " ns is no " + type + ": " +
                     error.what());
  }
}

bool IsRos2Bag(const std::string& path) {
  std::error_code ignored;
  if (fs::is_directory(path, ignored))
    return fs::exists(fs::path(path) / "metadata.yaml", ignored) || !FindBagFiles(path).empty();
  if (!fs::is_regular_file(path, ignored)) return false;
  std::string start(16, '\0');
  std::ifstream(path, std::ios::binary)
      .read(start.data(), static_cast<std::streamsize>(start.size()));
  return IsMcap(start) || IsSqlite(start) || IsZstd(start) || HasBagEnding(path);
}

std::vector<std::string> FilesOfBag(const std::string& path) {
  std::vector<std::string> files;
  for (const fs::path& file : BagFiles(path)) files.push_back(file);
  if (fs::is_directory(path)) files.push_back(fs::path(path) / "metadata.yaml");
  return files;
}

std::string WithoutBagEnding(const std::string& path) {
  std::vector<std::string> endings(kEndings.begin(), kEndings.end());
  endings.insert(endings.end(), {".bag", ".bag.active"});
  for (const std::string& ending : endings)
    if (EndsWith(path, ending)) return path.substr(0, path.size() - ending.size());
  return path;
}

std::unique_ptr<MessageSource> OpenRos2(const std::vector<std::string>& paths) {
  return std::make_unique<Ros2Source>(paths);
}

}  // namespace imu_pose_calib
