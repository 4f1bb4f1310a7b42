#include "imu_pose_calib/ros/exports/exports.h"

#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <cmath>
#include <filesystem>
#include <iterator>
#include <sstream>

#include "imu_pose_calib/ros/exports/export_text.h"

namespace imu_pose_calib {
namespace {

struct NamedExporter {
  const char* name;
  Exporter* exporter;
};

constexpr NamedExporter kExporters[] = {
    {"kalibr", ExportKalibr},     {"openvins", ExportOpenVins}, {"vins", ExportVins},
    {"orbslam3", ExportOrbSlam3}, {"kimera", ExportKimera},     {"euroc", ExportEuroc},
    {"basalt", ExportBasalt},     {"vicon2gt", ExportVicon2Gt}, {"mocap2gt", ExportMocap2Gt},
    {"liosam", ExportLioSam},     {"fastlio", ExportFastLio},   {"px4", ExportPx4},
    {"evo", ExportEvo},           {"urdf", ExportUrdf},         {"tf", ExportTf},
    {"ros2", ExportRos2},
};

const NamedExporter* Find(const std::string& name) {
  const auto* found = std::find_if(std::begin(kExporters), std::end(kExporters),
                                   [&](const NamedExporter& known) { return known.name == name; });
  return found == std::end(kExporters) ? nullptr : found;
}

/// The result's path without .yaml.
std::filesystem::path Stem(const std::filesystem::path& result) {
  const bool is_yaml = result.extension() == ".yaml" || result.extension() == ".yml";
  return is_yaml ? std::filesystem::path(result).replace_extension() : result;
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

std::vector<ExportFile> Export(const StoredResult& stored, const std::string& name,
                               const ExportOptions& options) {
  return Find(ParseExports(name).at(0))->exporter(stored, options);
}

std::vector<std::string> WriteExports(const StoredResult& stored,
                                      const std::vector<std::string>& names, OutputFiles* outputs,
                                      const std::string& folder, const ExportOptions& options) {
  std::filesystem::path stem = Stem(stored.path);
  if (!folder.empty()) {
    stem = folder / stem.filename();
    outputs->MakeFolder(folder);
  }
  std::vector<std::string> paths;
  for (const std::string& name : names)
    for (const ExportFile& file : Export(stored, name, options)) {
      paths.push_back(stem.string() + "." + file.ending);
      outputs->Write(paths.back(), file.text);
    }
  return paths;
}

std::string ExportNote(const StoredResult& stored, const std::vector<std::string>& names) {
  std::vector<std::string> turned;
  for (const std::string& name : names) {
    const std::vector<ExportFile> files = Export(stored, name);
    if (std::any_of(files.begin(), files.end(), [](const ExportFile& file) {
          return file.text.find(kTurnedAxes) != std::string::npos;
        }))
      turned.push_back(name);
  }
  if (turned.empty()) return "";
  return "the imu axes of " + boost::join(turned, ", ") + " are those of the accelerometer, by " +
         Short(ToAccelAxes(stored.result.imus[0]).angle_rad * 180.0 / M_PI) +
         " deg off those of T_marker_imu: the files say so, too";
}

}  // namespace imu_pose_calib
