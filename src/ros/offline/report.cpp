#include "imu_pose_calib/ros/offline/report.h"

#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <sstream>

#include "imu_pose_calib/ros/io/child_process.h"
#include "imu_pose_calib/ros/io/result_yaml.h"

namespace imu_pose_calib {

const char kReportHeader[] = "<!DOCTYPE html><!-- imu_pose_calib: report of a calibration -->";

namespace {

/// A folder of its own, removed in the end.
class TemporaryFolder {
 public:
  TemporaryFolder() {
    std::string name = (std::filesystem::temp_directory_path() / "imu_pose_calib_XXXXXX").string();
    if (mkdtemp(name.data()) == nullptr)
      throw InputError("no temporary folder '" + name + "' can be made");
    path_ = name;
  }
  TemporaryFolder(const TemporaryFolder&) = delete;
  TemporaryFolder& operator=(const TemporaryFolder&) = delete;
  ~TemporaryFolder() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }

  std::string File(const std::string& name) const { return path_ / name; }
  std::string path() const { return path_; }

 private:
  std::filesystem::path path_;
};

std::string ReadAll(const std::string& path) {
  std::ostringstream text;
  text << std::ifstream(path, std::ios::binary).rdbuf();
  return text.str();
}

std::string LastLine(const std::string& path) {
  std::ifstream in(path);
  std::string line, last;
  while (std::getline(in, line))
    if (!line.empty()) last = line;
  return last;
}

}  // namespace

void WriteReport(const ReportInput& input, const std::string& path) {
  const std::filesystem::path script =
      std::filesystem::read_symlink("/proc/self/exe").parent_path() / "report.py";
  if (!std::filesystem::exists(script))
    throw InputError("report '" + path + "' cannot be drawn: there is no " + script.string());
  const TemporaryFolder folder;
  WriteReportData(input, folder.path());
  const bool is_pdf = std::filesystem::path(path).extension() == ".pdf";
  const std::string drawn = folder.File(is_pdf ? "drawn.pdf" : "drawn.html");
  const std::string errors = folder.File("errors.txt");
  if (RunProgram({script, folder.path(), drawn}, errors) != EXIT_SUCCESS)
    throw InputError("report '" + path + "' cannot be drawn: " + LastLine(errors));
  WriteFile(path, (is_pdf ? "" : kReportHeader + std::string("\n")) + ReadAll(drawn));
}

void RemoveOldReport(const std::string& path) {
  std::string first_line;
  std::getline(std::ifstream(path), first_line);
  if (first_line == kReportHeader) std::remove(path.c_str());
}

}  // namespace imu_pose_calib
