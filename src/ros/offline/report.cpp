#include "imu_pose_calib/ros/offline/report.h"

#include <algorithm>
#include <boost/algorithm/string/replace.hpp>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <memory>
#include <optional>
#include <sstream>

#include "imu_pose_calib/core/data/stamp_recovery.h"
#include "imu_pose_calib/core/start/preparation.h"
#include "imu_pose_calib/ros/io/child_process.h"
#include "imu_pose_calib/ros/io/printable.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/ros_options.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

// First line of every report in HTML.
constexpr char kReportHeader[] = "<!DOCTYPE html><!-- imu_pose_calib: report of a calibration -->";

// --- The numbers ---

YAML::Node Describe(const char* role, size_t imu, const std::string& topic,
                    const StreamCheck& check, const StreamReport& report,
                    const std::optional<Latency>& latency) {
  YAML::Node node;
  node["role"] = role;
  node["imu"] = imu;
  node["topic"] = topic;
  node["count"] = check.count;
  node["used"] = report.used;
  node["rate_hz"] = YamlValue(check.rate_hz);
  node["jitter_s"] = YamlValue(check.jitter_s);
  node["longest_gap_s"] = YamlValue(check.longest_gap_s);
  node["missing"] = YamlValue(check.missing);
  node["repeated"] = YamlValue(check.repeated);
  node["bunched"] = YamlValue(check.bunched);
  node["recovered"] = check.stamps.recovered;
  const std::string dropped = Dropped(report);
  node["dropped"] = dropped.empty() ? "" : dropped.substr(std::string("; dropped ").size());
  if (latency) node["latency"] = YamlList(Eigen::Vector2d(latency->median_s, latency->spread_s));
  return node;
}

/// Recorded signals on their own clocks, for data that were not solved.
void WriteRecorded(const CalibrationOptions& options, const SessionData& session,
                   const std::string& prefix) {
  const auto since_first = [](const auto& samples) {
    return [first = samples.empty() ? 0 : samples.front().t_ns](int64_t t_ns) {
      return 1e-9 * static_cast<double>(t_ns - first);
    };
  };
  NumpyTable<float> poses(7);
  for (const PoseSample& sample : session.poses) {
    const PoseSample pose = ToMarkerPose(options, sample);
    poses.AddRow(pose.p_WM, pose.q_WM.coeffs());
  }
  poses.Write(prefix + "_poses.npy");
  WriteTimes(prefix + "_poses_stamps.npy", session.poses, since_first(session.poses));
  for (size_t i = 0; i < session.imus.size(); ++i) {
    const auto write = [&](const char* sensor, const std::vector<ImuSample>& samples, double unit) {
      const std::string file = prefix + "_i" + std::to_string(i) + "_" + sensor;
      WriteTimes(file + "_stamps.npy", samples, since_first(samples));
      WriteValues(file + ".npy", samples, unit);
    };
    write("gyro", session.imus[i].gyro, options.gyro_unit);
    write("accel", session.imus[i].accel, options.accel_unit);
  }
}

YAML::Node Streams(const DataCheck& check, const RecordingInfo& info) {
  YAML::Node streams(YAML::NodeType::Sequence);
  streams.push_back(
      Describe("poses", 0, info.pose_topic, check.poses, check.poses_report, info.pose_latency));
  for (size_t i = 0; i < check.imus.size(); ++i) {
    const ImuCheck& imu = check.imus[i];
    if (imu.gyro.count == 0) continue;
    const ImuInfo& source = info.imus[i];
    streams.push_back(
        Describe("gyro", i, source.GyroSource(), imu.gyro, imu.gyro_report, source.gyro_latency));
    streams.push_back(Describe("accel", i, source.AccelSource(), imu.accel, imu.accel_report,
                               source.accel_latency));
  }
  return streams;
}

/// The check of a session that was solved: its streams as recorded, and what the solve used.
DataCheck CheckSolved(const CalibrationOptions& options, const SessionData& recorded,
                      const SessionCalibration& solved) {
  SessionData session = recorded;
  const SessionStamps stamps = RecoverStamps(options.recover_stamps, &session);
  DataCheck check = CheckStreams(recorded, session, stamps);
  check.poses_report = solved.poses;
  for (size_t i = 0; i < solved.imus.size(); ++i) {
    check.imus[i].gyro_report = solved.imus[i].gyro;
    check.imus[i].accel_report = solved.imus[i].accel;
  }
  return check;
}

YAML::Node WriteSession(const ReportInput& input, size_t s,
                        const std::shared_ptr<const TrajectoryCovariance>& covariance,
                        const std::string& folder) {
  const SessionData& recorded = input.sessions[s];
  const RecordingInfo info = WithPrintableNames(input.infos[s]);
  const std::string prefix = folder + "/s" + std::to_string(s);
  const bool is_solved = input.result.solution != nullptr;
  const DataCheck check = is_solved ? CheckSolved(input.options, recorded, input.result.sessions[s])
                                    : CheckData(input.options, recorded);
  YAML::Node node;
  node["source"] = info.Source();
  node["marker_frame"] = info.marker_frame;
  node["streams"] = Streams(check, info);
  node["imus"] = YAML::Node(YAML::NodeType::Sequence);
  for (size_t i = 0; i < recorded.imus.size(); ++i)
    if (!recorded.imus[i].IsEmpty()) node["imus"].push_back(i);
  if (!is_solved) {
    node["message"] = Printable(check.message);
    for (const std::string& warning : check.warnings) node["warnings"].push_back(warning);
    if (!check.turns_M.isZero(0.0)) {
      node["excitation"]["turns"] = YamlList(check.turns_M);
      node["excitation"]["moves"] = YamlList(check.moves_W);
    }
    WriteRecorded(input.options, recorded, prefix);
  } else {
    WriteSolvedSession(input, s, covariance, prefix, &node);
  }
  return node;
}

// --- The drawing ---

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

YAML::Node ReportHead() {
  YAML::Node report;
  report["version"] = kVersion;
  std::string command = ReadAll("/proc/self/cmdline");  // words end with 0
  if (!command.empty()) command.pop_back();
  std::replace(command.begin(), command.end(), '\0', ' ');
  report["command"] = Printable(command);
  report["folder"] = Printable(std::filesystem::current_path());
  return report;
}

void WriteHead(const YAML::Node& report, const std::string& folder) {
  YAML::Emitter out;
  out << report;
  WriteFile(folder + "/report.yaml", out.c_str());
}

std::string DrawPage(const std::string& path, const std::string& run_id,
                     const std::function<void(const std::string&)>& write) {
  const std::filesystem::path script =
      std::filesystem::read_symlink("/proc/self/exe").parent_path() / "report.py";
  if (!std::filesystem::exists(script))
    throw InputError("report '" + path + "' cannot be drawn: there is no " + script.string());
  const TemporaryFolder folder;
  write(folder.path());
  const bool is_pdf = std::filesystem::path(path).extension() == ".pdf";
  const std::string drawn = folder.path() / (is_pdf ? "drawn.pdf" : "drawn.html");
  const std::string errors = folder.path() / "errors.txt";
  if (RunProgram({script, folder.path(), drawn}, errors) != EXIT_SUCCESS)
    throw InputError("report '" + path + "' cannot be drawn: " + LastLine(errors));
  std::string run = "imu_pose_calib " + std::string(kVersion);
  if (!run_id.empty()) run += ", run_id: " + run_id;
  std::string page = ReadAll(drawn);
  if (is_pdf) return page + "% " + run + "\n";  // a comment may follow the end
  boost::replace_first(page, "<title>", "<meta name=\"generator\" content=\"" + run + "\"><title>");
  return kReportHeader + ("\n" + page);
}

void WriteReportData(const ReportInput& input, const std::string& folder) {
  YAML::Node report = ReportHead();
  report["run_id"] = input.run_id;
  const bool is_solved = input.result.solution != nullptr;
  std::shared_ptr<const TrajectoryCovariance> covariance;
  if (is_solved && !input.result.solution->marginals.factor.empty())
    covariance = std::make_shared<const TrajectoryCovariance>(input.result.solution);
  report["status"] = input.refusal.empty() ? ToString(input.result.status) : "refused";
  report["message"] = Printable(input.refusal.empty() ? input.result.message : input.refusal);
  report["solved"] = is_solved;
  report["options"] = YAML::Load(ToYaml(input.options));
  report["sessions"] = YAML::Node(YAML::NodeType::Sequence);
  for (size_t s = 0; s < input.sessions.size(); ++s)
    report["sessions"].push_back(WriteSession(input, s, covariance, folder));
  WriteHead(report, folder);
  if (is_solved)
    WriteFile(folder + "/result.yaml",
              ToYaml(input.result, input.infos, input.options, {input.run_id}));
}

std::string DrawReport(const ReportInput& input, const std::string& path) {
  return DrawPage(path, input.run_id,
                  [&](const std::string& folder) { WriteReportData(input, folder); });
}

void CheckReportName(const std::string& path) {
  const std::string extension = std::filesystem::path(path).extension();
  if (!path.empty() && extension != ".html" && extension != ".pdf")
    throw InputError("report '" + path + "' must end in .html or .pdf");
}

}  // namespace imu_pose_calib
