#include "imu_pose_calib/ros/offline/report.h"

#include <fcntl.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <boost/algorithm/string/trim.hpp>
#include <cerrno>
#include <csignal>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <sstream>
#include <system_error>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

std::string ReadAll(const std::string& path) {
  std::ostringstream text;
  text << std::ifstream(path, std::ios::binary).rdbuf();
  return text.str();
}

std::string LastLine(const std::string& path) {
  const std::string text = boost::trim_copy(ReadAll(path));
  return text.substr(text.rfind('\n') + 1);
}

/// Runs scripts/report.py, which is installed beside the executables, without input and output and
/// with stderr in the file `errors`; whether it succeeded. `failure` begins errors.
bool RunReport(std::vector<std::string> arguments, const std::string& errors,
               const std::string& failure) {
  const std::filesystem::path script =
      std::filesystem::read_symlink("/proc/self/exe").parent_path() / "report.py";
  if (!std::filesystem::exists(script))
    throw InputError(failure + ": there is no " + script.string());
  arguments.insert(arguments.begin(), script);
  std::vector<char*> words;
  for (std::string& argument : arguments) words.push_back(argument.data());
  words.push_back(nullptr);
  posix_spawn_file_actions_t files;
  posix_spawn_file_actions_init(&files);
  posix_spawn_file_actions_addopen(&files, STDIN_FILENO, "/dev/null", O_RDONLY, 0);
  posix_spawn_file_actions_addopen(&files, STDOUT_FILENO, "/dev/null", O_WRONLY, 0);
  posix_spawn_file_actions_addopen(&files, STDERR_FILENO, errors.c_str(),
                                   O_WRONLY | O_CREAT | O_TRUNC, 0600);
  posix_spawnattr_t attributes;
  posix_spawnattr_init(&attributes);
  sigset_t none;
  sigemptyset(&none);
  posix_spawnattr_setsigmask(&attributes, &none);  // not what InterruptGuard blocks here
  posix_spawnattr_setflags(&attributes, POSIX_SPAWN_SETSIGMASK);
  pid_t pid = 0;
  const int reason = posix_spawn(&pid, words[0], &files, &attributes, words.data(), environ);
  posix_spawnattr_destroy(&attributes);
  posix_spawn_file_actions_destroy(&files);
  if (reason != 0)
    throw InputError("'" + script.string() +
                     "' cannot be run: " + std::generic_category().message(reason));
  int status = 0;
  while (waitpid(pid, &status, 0) < 0 && errno == EINTR) continue;
  return WIFEXITED(status) && WEXITSTATUS(status) == EXIT_SUCCESS;
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

std::string DrawPage(const std::string& path,
                     const std::function<void(const std::string&)>& write) {
  const std::string failure = "report '" + path + "' cannot be drawn";
  const TemporaryFolder folder;
  write(folder.path());
  const std::string drawn =
      (folder.path() / "drawn").string() + std::filesystem::path(path).extension().string();
  const std::string errors = folder.path() / "errors.txt";
  if (!RunReport({folder.path(), drawn}, errors, failure))
    throw InputError(failure + ": " + LastLine(errors));
  return ReadAll(drawn);
}

void CheckReportName(const std::string& path) {
  const std::string extension = std::filesystem::path(path).extension();
  if (!path.empty() && extension != ".html" && extension != ".pdf")
    throw InputError("report '" + path + "' must end in .html or .pdf");
}

}  // namespace imu_pose_calib
