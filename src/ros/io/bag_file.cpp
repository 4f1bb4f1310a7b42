#include "imu_pose_calib/ros/io/bag_file.h"

#include <algorithm>
#include <boost/algorithm/string/predicate.hpp>
#include <filesystem>
#include <fstream>
#include <set>

#include "imu_pose_calib/ros/io/yaml_file.h"

namespace imu_pose_calib {
namespace {

namespace fs = std::filesystem;

/// Of the files of bags, the longer ones first; the first four of ROS 2.
constexpr const char* kEndings[] = {".mcap.zstd", ".db3.zstd", ".mcap",
                                    ".db3",       ".bag",      ".bag.active"};
constexpr size_t kRos2Endings = 4;

/// The ending that a name has, of the first `count`; empty: none.
std::string Ending(const std::string& name, size_t count) {
  for (size_t k = 0; k < count; ++k)
    if (boost::ends_with(name, kEndings[k]) && name != kEndings[k]) return kEndings[k];
  return "";
}

/// Files of a bag of ROS 2 in a folder, by name.
std::vector<std::string> FindBagFiles(const std::string& folder) {
  std::vector<std::string> files;
  std::error_code ignored;
  for (const fs::directory_entry& entry : fs::directory_iterator(folder, ignored))
    if (!Ending(entry.path().filename(), kRos2Endings).empty() && entry.is_regular_file(ignored))
      files.push_back(entry.path());
  std::sort(files.begin(), files.end());
  return files;
}

/// The files that a metadata.yaml names, which lie beside it whatever folder it gives them.
std::vector<std::string> ReadMetadata(const fs::path& metadata) {
  std::vector<std::string> files;
  try {
    const YAML::Node root = ParseYaml(ReadYamlFile(metadata));
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

}  // namespace

std::string Ros1Type(std::string type, const std::string& encoding) {
  const size_t at = type.find("/msg/");
  if (at != std::string::npos) type.erase(at, 4);
  return encoding == "cdr" ? type : type + " in " + encoding;
}

bool IsRos2Bag(const std::string& path) {
  std::error_code ignored;
  if (fs::is_directory(path, ignored))
    return fs::exists(fs::path(path) / "metadata.yaml", ignored) || !FindBagFiles(path).empty();
  if (!fs::is_regular_file(path, ignored)) return false;
  std::string start(16, '\0');
  std::ifstream(path, std::ios::binary)
      .read(start.data(), static_cast<std::streamsize>(start.size()));
  return IsMcap(start) || IsSqlite(start) || IsZstd(start) ||
         !Ending(fs::path(path).filename(), kRos2Endings).empty();
}

std::vector<std::string> MessageFiles(const std::string& path) {
  if (!fs::is_directory(path)) return {path};
  const fs::path metadata = fs::path(path) / "metadata.yaml";
  return fs::exists(metadata) ? ReadMetadata(metadata) : FindBagFiles(path);
}

std::vector<std::string> FilesOfBag(const std::string& path) {
  std::vector<std::string> files = MessageFiles(path);
  if (fs::is_directory(path)) files.push_back(fs::path(path) / "metadata.yaml");
  return files;
}

std::string WithoutBagEnding(const std::string& path) {
  return path.substr(0, path.size() - Ending(path, std::size(kEndings)).size());
}

std::string FileNames(const std::vector<std::string>& paths) {
  std::string names;
  for (const fs::path path : paths)  // a folder may end with a slash
    names += (names.empty() ? "" : ", ") +
             (path.has_filename() ? path : path.parent_path()).filename().string();
  return names;
}

void CheckBagsExist(const std::vector<std::string>& paths) {
  std::set<fs::path> known;
  for (const std::string& path : paths) {
    if (!fs::exists(path)) throw InputError("bag '" + path + "' does not exist");
    if (!known.insert(fs::canonical(path)).second)
      throw InputError("bag '" + path + "' is given twice");
  }
}

}  // namespace imu_pose_calib
