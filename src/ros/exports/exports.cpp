#include "imu_pose_calib/ros/exports/exports.h"

#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <sstream>
#include <system_error>

#include "imu_pose_calib/ros/exports/export_text.h"
#include "imu_pose_calib/ros/io/result_yaml.h"

namespace imu_pose_calib {
namespace {

struct NamedExporter {
  const char* name;
  Exporter* exporter;
};

constexpr NamedExporter kExporters[] = {
    {"kalibr", ExportKalibr},
    {"openvins", ExportOpenVins},
    {"vins", ExportVins},
    {"orbslam3", ExportOrbSlam3},
    {"kimera", ExportKimera},
    {"euroc", ExportEuroc},
    {"basalt", ExportBasalt},
    {"vicon2gt", ExportVicon2Gt},
    {"mocap2gt", ExportMocap2Gt},
    {"liosam", ExportLioSam},
    {"fastlio", ExportFastLio},
    {"px4", ExportPx4},
    {"evo", ExportEvo},
    {"urdf", ExportUrdf},
    {"tf", ExportTf},
    {"ros2", ExportRos2},
};

const NamedExporter* Find(const std::string& name) {
  const auto* found = std::find_if(std::begin(kExporters),
                                   std::end(kExporters),
                                   [&](const NamedExporter& known) { return known.name == name; });
  return found == std::end(kExporters) ? nullptr : found;
}

/// The result's path without .yaml.
std::filesystem::path Stem(const std::filesystem::path& result) {
  const bool is_yaml = result.extension() == ".yaml" || result.extension() == ".yml";
  return is_yaml ? std::filesystem::path(result).replace_extension() : result;
}

std::string FileText(const std::filesystem::path& path) {
  std::ostringstream text;
  text << std::ifstream(path).rdbuf();
  return text.str();
}

}  // namespace

std::vector<std::string> ExportNames() {
  std::vector<std::string> names;
  for (const NamedExporter& known : kExporters) names.emplace_back(known.name);
  return names;
}

std::vector<std::string> ParseExports(const std::string& list) {
  std::string spaced = list;
  std::replace(spaced.begin(), spaced.end(), ',', ' ');
  std::istringstream words(spaced);
  std::vector<std::string> names;
  for (std::string word; words >> word;) {
    if (word == "all") return ExportNames();
    if (!Find(word))
      throw InputError("export '" + word + "' is unknown; must be among " +
                       boost::join(ExportNames(), ", ") + ", or all");
    if (std::find(names.begin(), names.end(), word) == names.end()) names.push_back(word);
  }
  return names;
}

std::vector<ExportFile> Export(const StoredResult& stored,
                               const std::string& name,
                               const ExportOptions& options) {
  return Find(ParseExports(name).at(0))->exporter(stored, options);
}

std::vector<std::string> WriteExports(const StoredResult& stored,
                                      const std::vector<std::string>& names,
                                      const std::string& folder,
                                      const ExportOptions& options) {
  std::filesystem::path stem = Stem(stored.path);
  if (!folder.empty()) stem = folder / stem.filename();
  std::vector<ExportFile> files;  // all of them before any is written
  for (const std::string& name : names)
    for (ExportFile& file : Export(stored, name, options)) files.push_back(std::move(file));
  if (!folder.empty()) {
    std::error_code failure;
    std::filesystem::create_directories(folder, failure);
    if (failure) throw InputError("folder '" + folder + "' cannot be made: " + failure.message());
  }
  std::vector<std::string> paths;
  for (const ExportFile& file : files) {
    paths.push_back(stem.string() + "." + file.ending);
    WriteFile(paths.back(), file.text);
  }
  return paths;
}

void RemoveOldExports(const std::string& path, const std::vector<std::string>& names) {
  const std::filesystem::path stem = Stem(path);
  const std::filesystem::path folder = stem.has_parent_path() ? stem.parent_path() : ".";
  std::error_code ignored;
  std::vector<std::filesystem::path> old;
  for (const auto& entry : std::filesystem::directory_iterator(folder, ignored))
    for (const std::string& name : names) {
      const std::string file = entry.path().filename().string();
      const std::string start = stem.filename().string() + "." + name;
      const bool is_named = file == start || file.compare(0, start.size() + 1, start + ".") == 0;
      const bool is_ours =
          is_named && FileText(entry.path()).find("by imu_pose_calib") != std::string::npos;
      if (is_ours) old.push_back(entry.path());
    }
  for (const std::filesystem::path& file : old) std::filesystem::remove(file, ignored);
}

}  // namespace imu_pose_calib
