#include "imu_pose_calib/ros/offline/report.h"

#include <fcntl.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <boost/algorithm/string/trim.hpp>
#include <cerrno>
#include <cmath>
#include <csignal>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <map>
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

/// One result, on its own.
YAML::Node Describe(const StoredResult& stored, const ImuStd& noise) {
  YAML::Node node;
  node["path"] = Printable(stored.path);
  node["source"] = Printable(stored.infos.front().Source());
  node["status"] = ToString(stored.result.status);
  const PoseStd& pose_noise = stored.result.sessions.front().noise;
  node["noise"]["gyro"] = YamlValue(noise.gyro);
  node["noise"]["accel"] = YamlValue(noise.accel);
  node["noise"]["position"] = YamlValue(pose_noise.position);
  node["noise"]["rotation"] = YamlValue(pose_noise.rotation);
  return node;
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

const std::vector<ComparedQuantity> kTransform = {ComparedQuantity::kTranslation,
                                                  ComparedQuantity::kRotation};

YAML::Node Describe(const Comparable& calibration) {
  YAML::Node node;
  node["translation"] = YamlList(calibration.T_MI.p);
  node["rotation"] = YamlList(calibration.T_MI.q.coeffs());
  for (int row = 0; row < 6; ++row)
    node["covariance"].push_back(YamlList(calibration.covariance.row(row)));
  node["accel_delay"] =
      YamlList(Eigen::Vector2d(calibration.accel_delay, calibration.accel_delay_std));
  node["time_shift"] =
      YamlList(Eigen::Vector2d(calibration.time_shift, calibration.time_shift_std));
  return node;
}

YAML::Node Describe(const Comparison& comparison) {
  YAML::Node node;
  node["distance"] = YamlValue(comparison.distance);
  node["angle"] = YamlValue(comparison.angle);
  node["chi2"] = YamlValue(comparison.chi2);
  node["dof"] = comparison.dof;
  const Difference* worst = comparison.Worst();
  node["sigmas"] = YamlValue(worst ? worst->sigmas : 0.0);
  node["worst"] = worst ? ToString(worst->quantity) : "";
  node["axis"] = worst ? worst->axis : 0;
  std::map<std::string, double> most;
  for (const Difference& component : comparison.components) {
    double& sigmas = most[ToString(component.quantity)];
    sigmas = std::max(sigmas, component.sigmas);
  }
  for (const auto& [quantity, sigmas] : most) node["most"][quantity] = YamlValue(sigmas);
  return node;
}

YAML::Node Describe(const Scatter& scatter) {
  YAML::Node node;
  node["quantity"] = ToString(scatter.quantity);
  node["deviation"] = YamlList(scatter.deviation);
  node["sigma"] = YamlList(scatter.sigma);
  node["chi2"] = YamlValue(scatter.chi2);
  node["dof"] = scatter.dof;
  return node;
}

std::vector<Comparable> ToComparables(const std::vector<StoredResult>& results, size_t imu) {
  double reference = 0.0;
  for (const StoredResult& stored : results) {
    if (imu >= stored.result.imus.size())
      throw InputError("--imu " + std::to_string(imu) + ": '" + stored.path + "' has " +
                       std::to_string(stored.result.imus.size()) + " imus, from 0");
    reference += stored.Clock(imu).clock_reference / static_cast<double>(results.size());
  }
  std::vector<Comparable> calibrations;
  for (const StoredResult& stored : results) {
    const ImuCalibration& calibration = stored.result.imus[imu];
    const ImuSession& clock = stored.Clock(imu);
    const double away = reference - clock.clock_reference;
    calibrations.push_back({calibration.T_MI, calibration.covariance, calibration.accel_delay,
                            calibration.accel_delay_std,
                            clock.time_shift + clock.clock_drift * away,
                            std::hypot(clock.time_shift_std, clock.clock_drift_std * away)});
  }
  return calibrations;
}

void WriteComparison(const ComparisonInput& input, const std::string& path) {
  const std::vector<Comparable> calibrations = ToComparables(input.results, input.imu);
  YAML::Node head = ReportHead();
  head["status"] = input.status;
  head["message"] = Printable(input.message);
  Repeatability repeatability;
  repeatability.mean = input.reference.value_or(calibrations.front());
  if (calibrations.size() > 1) repeatability = Repeat(calibrations, input.quantities);
  head["mean"] = Describe(repeatability.mean);
  for (const Scatter& scatter : repeatability.scatters)
    head["scatters"].push_back(Describe(scatter));
  for (size_t i = 0; i < calibrations.size(); ++i) {
    const StoredResult& stored = input.results[i];
    YAML::Node node = Describe(stored, stored.Clock(input.imu).noise);
    node["calibration"] = Describe(calibrations[i]);
    if (calibrations.size() > 1) node["from_others"] = Describe(repeatability.from_others[i]);
    if (input.reference)
      node["from_reference"] = Describe(Compare(*input.reference, calibrations[i], kTransform));
    head["results"].push_back(node);
  }
  if (input.reference) head["reference"] = Describe(*input.reference);
  WriteFile(path, DrawPage(path, [&](const std::string& folder) {
              WriteYaml(head, folder + "/report.yaml");
            }));
}

}  // namespace imu_pose_calib
