#include "imu_pose_calib/ros/offline/report.h"

#include <algorithm>
#include <boost/algorithm/string/replace.hpp>
#include <boost/algorithm/string/trim.hpp>
#include <filesystem>
#include <fstream>
#include <sstream>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/child_process.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

// First line of every report in HTML.
constexpr char kReportHeader[] = "<!DOCTYPE html><!-- imu_pose_calib: report of a calibration -->";

std::string ReadAll(const std::string& path) {
  std::ostringstream text;
  text << std::ifstream(path, std::ios::binary).rdbuf();
  return text.str();
}

std::string LastLine(const std::string& path) {
  const std::string text = boost::trim_copy(ReadAll(path));
  return text.substr(text.rfind('\n') + 1);
}

}  // namespace

YAML::Node YamlValue(double value) { return YAML::Node(YamlNumber(value)); }

YAML::Node YamlList(const Eigen::VectorXd& values) {
  YAML::Node list(YAML::NodeType::Sequence);
  for (Eigen::Index k = 0; k < values.size(); ++k) list.push_back(YamlValue(values[k]));
  return list;
}

YAML::Node ReportHead() {
  YAML::Node head;
  head["version"] = kVersion;
  std::string command = ReadAll("/proc/self/cmdline");  // words end with 0
  if (!command.empty()) command.pop_back();
  std::replace(command.begin(), command.end(), '\0', ' ');
  head["command"] = Printable(command);
  head["folder"] = Printable(std::filesystem::current_path());
  return head;
}

void WriteYaml(const YAML::Node& node, const std::string& path) {
  YAML::Emitter out;
  out << node;
  WriteFile(path, out.c_str());
}

std::string DrawPage(const std::string& path, const std::string& run_id,
                     const std::function<void(const std::string&)>& write) {
  const std::string failure = "report '" + path + "' cannot be drawn";
  const TemporaryFolder folder;
  write(folder.path());
  const bool is_pdf = std::filesystem::path(path).extension() == ".pdf";
  const std::string drawn = folder.path() / (is_pdf ? "drawn.pdf" : "drawn.html");
  const std::string errors = folder.path() / "errors.txt";
  if (!RunScript("report.py", {folder.path(), drawn}, errors, failure))
    throw InputError(failure + ": " + LastLine(errors));
  std::string run = "imu_pose_calib " + std::string(kVersion);
  if (!run_id.empty()) run += ", run_id: " + run_id;
  std::string page = ReadAll(drawn);
  if (is_pdf) return page + "% " + run + "\n";  // a comment may follow the end
  boost::replace_first(page, "<title>", "<meta name=\"generator\" content=\"" + run + "\"><title>");
  return kReportHeader + ("\n" + page);
}

void CheckReportName(const std::string& path) {
  const std::string extension = std::filesystem::path(path).extension();
  if (!path.empty() && extension != ".html" && extension != ".pdf")
    throw InputError("report '" + path + "' must end in .html or .pdf");
}

}  // namespace imu_pose_calib
