#include "imu_pose_calib/ros/offline/offline.h"

#include <algorithm>
#include <filesystem>
#include <iostream>
#include <iterator>
#include <sstream>
#include <system_error>
#include <utility>

#include "imu_pose_calib/core/start/preparation.h"
#include "imu_pose_calib/ros/exports/exports.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/message_source.h"
#include "imu_pose_calib/ros/io/printable.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/ros_options.h"
#include "imu_pose_calib/ros/io/stored_result.h"
#include "imu_pose_calib/ros/offline/report.h"
#include "imu_pose_calib/ros/offline/summary.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

/// Ground truth needs the whole factor, see CalibrationOptions::max_factor_mb.
constexpr double kUnbounded = 1e6;  // [MB]

bool IsFolder(const std::string& path) {
  std::error_code ignored;
  return std::filesystem::is_directory(path, ignored);
}

bool NamesFiles(const TextRequest& text) {
  return !(text.poses.empty() && text.imu.empty() && text.gyro.empty() && text.accel.empty());
}

/// Whether it is a folder of text files, not a bag of ROS 2.
bool IsTextFolder(const std::string& path) { return IsFolder(path) && !IsRos2Bag(path); }

/// Whether the recordings are in text files alone.
bool IsText(const OfflineRequest& request) {
  const std::vector<std::string>& paths = request.bag.paths;
  return std::all_of(paths.begin(), paths.end(), IsTextFolder);
}

/// Whether either the poses or the IMUs are in text files, and what is missing there in bags.
bool IsMixed(const OfflineRequest& request) { return NamesFiles(request.text) && !IsText(request); }

/// A request for a session of which one part is in text files.
OfflineRequest FindMixed(OfflineRequest request) {
  BagRequest& bag = request.bag;
  TextRequest& text = request.text;
  const std::string bags = "the bag '" + bag.paths.front() + "'";
  const bool is_split = IsPair({"imu", text.imu}, {"gyro", text.gyro}, {"accel", text.accel});
  bag.poses = text.poses.empty();
  bag.imus = text.imu.empty() && !is_split;
  if (!bag.poses && !bag.imus)
    throw InputError("poses and imu name text files for all that there is to read; leave out " +
                     bags);
  if (!bag.poses && !(bag.pose_topic.empty() && bag.tf_parent.empty() && bag.tf_child.empty()))
    throw InputError("poses names a text file; it does not go with pose_topic or tf of " + bags);
  if (!bag.imus && !(bag.imu_topic.empty() && bag.gyro_topic.empty() && bag.accel_topic.empty()))
    throw InputError("imu, gyro and accel name text files; they do not go with topics of " + bags);
  if (!bag.poses) std::swap(text.body, bag.body);
  text.start_s = std::exchange(bag.start_s, 0.0);
  text.duration_s = std::exchange(bag.duration_s, 0.0);
  return request;
}

/// A request for the text files of one session with every file named.
OfflineRequest FindText(OfflineRequest request) {
  const BagRequest& bag = request.bag;
  TextRequest& text = request.text;
  if (!(bag.imu_topic.empty() && bag.pose_topic.empty() && bag.gyro_topic.empty() &&
        bag.accel_topic.empty() && bag.tf_parent.empty() && bag.tf_child.empty()))
    throw InputError("text files have no topics and no tf; choose with poses, imu, gyro and accel");
  if (bag.record_time)
    throw InputError("text files have no times of recording; leave out record_time");
  if (!bag.paths.empty()) text.folder = bag.paths[0];
  text.body = bag.body;
  text.start_s = bag.start_s;
  text.duration_s = bag.duration_s;
  text = FindFiles(text);
  const std::filesystem::path imu = text.imu.empty() ? text.gyro : text.imu;
  const std::string noise = imu.parent_path() / "sensor.yaml";
  if (request.imu_yaml.empty() && request.config.empty() && std::filesystem::exists(noise))
    request.imu_yaml = noise;
  return request;
}

/// Of the first IMU; clocks, gravity and biases are each recording's own.
void KeepCalibration(const Calibration& known, CalibrationOptions* options) {
  options->initial_rotation = known.imus[0].T_MI.q;
  options->initial_translation = known.imus[0].T_MI.p;
  options->accel_delay = known.imus[0].accel_delay;
  options->estimate_rotation = options->estimate_translation = false;
  options->estimate_accel_delay = false;
}

CalibrationOptions Options(const OfflineRequest& request) {
  CalibrationOptions options;
  if (!request.config.empty()) options = LoadOptions(request.config);
  if (!request.imu_yaml.empty()) LoadImuYaml(request.imu_yaml).CopyNoise(&options);
  if (!request.method.empty()) options.method = ParseMethod(request.method);
  if (!request.solver.empty()) options.solver = ParseSolver(request.solver);
  if (!request.calibration.empty())
    KeepCalibration(LoadResult(request.calibration).result, &options);
  return options;
}

/// Throws InputError when a file to write would replace what is read.
void CheckOutput(const Given& output, const OfflineRequest& request) {
  const TextRequest& text = request.text;
  std::vector<Given> inputs = {{"poses", text.poses},
                               {"imu", text.imu},
                               {"gyro", text.gyro},
                               {"accel", text.accel},
                               {"config", request.config},
                               {"imu_yaml", request.imu_yaml},
                               {"calibration", request.calibration}};
  std::vector<std::string> bags;
  for (const std::string& path : request.bag.paths)
    for (const std::string& file : FilesOfBag(path)) bags.push_back(file);
  for (const std::string& file : bags) inputs.push_back({"bag", file});
  std::error_code ignored;
  for (const Given& input : inputs)
    if (std::filesystem::equivalent(output.value, input.value, ignored))
      throw InputError(std::string(output.name) + " '" + output.value + "' would replace the " +
                       input.name + " '" + input.value + "'; choose another");
}

/// Throws InputError when a trajectory cannot be written, or would replace something else.
void PlanTrajectories(const std::vector<OfflineRequest>& sessions, OfflineResult* offline) {
  for (const TrajectoryTarget& target :
       PlanTrajectories(offline->trajectory, offline->options.method, sessions.size(),
                        offline->sessions.front().imus.size()))
    for (const std::string& file : TrajectoryFiles(target.path, target.format)) {
      for (const OfflineRequest& session : sessions) CheckOutput({"trajectory", file}, session);
      offline->outputs->Plan("trajectory", file, target.format == TrajectoryFormat::kAsl);
    }
}

/// The same of the report, and for one that is of no kind that can be drawn.
void PlanReport(OfflineResult* offline) {
  if (offline->report.empty()) return;
  CheckReportName(offline->report);
  offline->outputs->Plan("report", offline->report);
}

/// Where the report of refused data goes: beside the one of an earlier run, which stays.
std::string RefusedPath(const std::string& report) {
  if (!std::filesystem::exists(report)) return report;
  const std::filesystem::path path = report;
  return std::filesystem::path(path).replace_extension(".refused" + path.extension().string());
}

/// Draws why the data were refused. That they were is what to report in the first place: a failure
/// is added to it.
[[noreturn]] void Refuse(const OfflineResult& offline, const std::string& reason) {
  if (offline.report.empty()) throw DataError(reason);
  const std::string path = RefusedPath(offline.report);
  try {
    offline.outputs->Write(path, DrawReport({offline.options, offline.sessions, offline.infos,
                                             offline.result, reason, offline.outputs->run_id()},
                                            path));
    offline.outputs->Commit();
  } catch (const std::exception& error) {
    throw DataError(reason + "; no report: " + error.what());
  }
  throw DataError(reason + "; report: " + path);
}

/// What a failure says of earlier runs, whose files it leaves as they are.
std::string StillThere(const OfflineResult& offline) {
  return offline.earlier.empty()
             ? ""
             : "; still there, of an earlier run: " + WithTimes(offline.earlier);
}

Recording ReadBags(const OfflineRequest& request) {
  BagRequest bag = request.bag;
  if (!request.imu_yaml.empty()) bag.usual_imu_topic = LoadImuYaml(request.imu_yaml).rostopic;
  return ReadBag(bag);
}

/// Names the frames as the request says.
void NameFrames(const OfflineRequest& request, RecordingInfo* info) {
  const size_t names = SplitNames(request.imu_frame).size();
  if (!request.imu_frame.empty() && names != info->imus.size())
    throw InputError("imu_frame names " + std::to_string(names) + " frames for " +
                     std::to_string(info->imus.size()) + " imus");
  NameFrames(request.marker_frame, request.imu_frame, info);
  for (const ImuInfo& imu : info->imus)
    if (info->marker_frame == imu.imu_frame)
      throw InputError("marker_frame and imu_frame are both '" + imu.imu_frame +
                       "', which leaves no transform between them; give one of them another name");
}

/// One request for each session.
std::vector<OfflineRequest> SplitSessions(const OfflineRequest& request) {
  if (IsMixed(request)) return {FindMixed(request)};
  const bool is_text = IsText(request);
  std::vector<std::vector<std::string>> groups;
  if (request.bag.paths.size() < 2 || (request.one_recording && !is_text))
    groups.push_back(request.bag.paths);
  else if (is_text)
    for (const std::string& folder : request.bag.paths) groups.push_back({folder});
  else
    groups = GroupBags(request.bag.paths);
  std::vector<OfflineRequest> sessions;
  for (const auto& paths : groups) {
    sessions.push_back(request);
    sessions.back().bag.paths = paths;
    sessions.back().bag.may_lack_imus = groups.size() > 1;
    if (is_text) sessions.back() = FindText(sessions.back());
  }
  return sessions;
}

/// Bags and text files have no span of record time in common: the stamps of the samples count.
Recording ReadMixed(const OfflineRequest& request) {
  Recording recording = ReadBags(request);
  Recording files = ReadFiles(request.text);
  if (request.bag.poses) {
    recording.info.imus = std::move(files.info.imus);
    recording.data.imus = std::move(files.data.imus);
  } else {
    recording.info.pose_topic = files.info.pose_topic;
    recording.info.world_frame = files.info.world_frame;
    recording.info.marker_frame = files.info.marker_frame;
    recording.data.poses = std::move(files.data.poses);
  }
  CutSpan(request.text.start_s, request.text.duration_s, &recording.data);
  return recording;
}

Recording ReadRecording(const OfflineRequest& request) {
  Recording recording = IsMixed(request)  ? ReadMixed(request)
                        : IsText(request) ? ReadText(request.text)
                                          : ReadBags(request);
  recording.info.imu_yaml = request.imu_yaml;
  return recording;
}

/// The recordings of one rig, and the frames of its IMUs the same in all of them.
std::vector<Recording> ReadRecordings(const std::vector<OfflineRequest>& sessions) {
  std::vector<Recording> recordings;
  for (const OfflineRequest& session : sessions) recordings.push_back(ReadRecording(session));
  RecordingInfo& first = recordings.front().info;
  for (Recording& recording : recordings) {
    for (size_t i = 0; i < recording.info.imus.size() && i < first.imus.size(); ++i) {
      if (first.imus[i].imu_frame.empty())
        first.imus[i].imu_frame = recording.info.imus[i].imu_frame;
      recording.info.imus[i].imu_frame = first.imus[i].imu_frame;
    }
    recording.info.marker_frame = first.marker_frame;
  }
  for (Recording& recording : recordings) NameFrames(sessions.front(), &recording.info);
  return recordings;
}

void CheckGiven(const OfflineRequest& request) {
  if (request.bag.paths.empty() && !NamesFiles(request.text))
    throw InputError("no recording is given: a bag, a folder, or the files poses and imu");
}

/// What comes before it takes long: the requests of each session, and all outputs tried.
std::vector<OfflineRequest> Plan(const OfflineRequest& given, OfflineResult* offline) {
  offline->exports = ParseExports(given.exports);
  for (const std::string& path : given.bag.paths)
    if (!std::filesystem::exists(path)) throw InputError("bag '" + path + "' does not exist");
  CheckOutput({"output", offline->output}, given);  // an old result may be given as the config
  CheckOutput({"report", offline->report}, given);
  std::vector<OfflineRequest> requests = SplitSessions(given);
  for (const OfflineRequest& request : requests) {  // now with the files that were found
    CheckOutput({"output", offline->output}, request);
    CheckOutput({"report", offline->report}, request);
  }
  offline->options = Options(requests.front());
  if (!given.trajectory.path.empty()) offline->options.max_factor_mb = kUnbounded;
  // Before it takes long; of how many IMUs is not known yet.
  PlanTrajectories(offline->trajectory, offline->options.method, requests.size(), 1);
  offline->outputs->Plan("output", offline->output);
  PlanReport(offline);
  return requests;
}

/// See CalibrateOffline().
void RunOffline(const OfflineRequest& given, const Progress& progress, OfflineResult* offline) {
  const std::vector<OfflineRequest> requests = Plan(given, offline);
  if (progress) progress("recording", std::nullopt);
  for (Recording& recording : ReadRecordings(requests)) {
    offline->infos.push_back(recording.info);
    offline->sessions.push_back(std::move(recording.data));
  }
  PlanTrajectories(requests, offline);
  if (progress) progress("recording", 0);
  try {
    const bool is_kept = given.keep_data || !offline->report.empty();
    offline->result =
        Calibrate(offline->options,
                  is_kept ? offline->sessions : std::exchange(offline->sessions, {}), progress);
  } catch (const DataError& error) {
    Refuse(*offline, error.what());
  }
  std::vector<std::string>& warnings = offline->result.warnings;
  for (const RecordingInfo& info : offline->infos)
    warnings.insert(warnings.begin(), info.notes.begin(), info.notes.end());
  if (!offline->result.IsUsable()) Refuse(*offline, offline->result.message);
}

/// Gives the outputs the report, if one is wanted, and lets go of the recorded data. Returns why
/// there is none.
std::string WriteReport(OfflineResult* offline, const Progress& progress) {
  if (offline->report.empty()) return "";
  if (progress) progress("report", std::nullopt);
  std::string page;
  try {
    page = DrawReport({offline->options, offline->sessions, offline->infos, offline->result, "",
                       offline->outputs->run_id()},
                      offline->report);
  } catch (const std::exception& error) {
    return error.what();
  }
  offline->outputs->Write(offline->report, page);
  offline->sessions = {};
  offline->written.push_back(offline->report);
  if (progress) progress("report", 0);
  return "";
}

/// What the run writes under names that do not follow from that of the result, from its folder.
std::vector<std::string> OtherFiles(const OfflineResult& offline) {
  std::vector<std::string> files;
  if (!offline.report.empty()) files.push_back(offline.report);
  for (const TrajectoryTarget& target :
       PlanTrajectories(offline.trajectory, offline.result.method, offline.infos.size(),
                        offline.result.imus.size()))
    if (offline.result.sessions[target.session].imus[target.imu].is_present)
      files.push_back(target.path);
  const std::filesystem::path folder =
      std::filesystem::absolute(offline.output).lexically_normal().parent_path();
  for (std::string& file : files)
    file = std::filesystem::absolute(file).lexically_normal().lexically_proximate(folder);
  return files;
}

}  // namespace

std::string OutputPath(const OfflineRequest& request) {
  if (!request.output.empty()) return request.output;
  if (request.bag.paths.empty())
    return std::filesystem::path(request.text.poses).replace_extension(".calibration.yaml");
  const std::string& path = request.bag.paths.front();
  if (IsFolder(path)) return std::filesystem::path(path) / "calibration.yaml";
  return WithoutBagEnding(path) + ".calibration.yaml";
}

std::string ReportPath(const OfflineRequest& request) {
  return std::filesystem::path(OutputPath(request)).replace_extension(".report.html");
}

OfflineResult CalibrateOffline(const OfflineRequest& given, const Progress& progress) {
  CheckGiven(given);
  OfflineResult offline;
  offline.output = OutputPath(given);
  offline.report = given.report;
  offline.trajectory = given.trajectory;
  offline.earlier = FindEarlier(offline.output);
  try {
    RunOffline(given, progress, &offline);
  } catch (const DataError& error) {
    throw DataError(error.what() + StillThere(offline));
  } catch (const InputError& error) {
    throw InputError(error.what() + StillThere(offline));
  }
  return offline;
}

std::vector<std::string> SplitBags(const std::string& text) {
  if (std::filesystem::exists(text)) return {text};
  std::istringstream words(text);
  return {std::istream_iterator<std::string>(words), {}};
}

std::string WriteResult(OfflineResult* offline, const Progress& progress) {
  OutputFiles* outputs = offline->outputs.get();
  std::vector<std::string>& written = offline->written;
  const std::string yaml = ToYaml(offline->result, offline->infos, offline->options,
                                  {outputs->run_id(), OtherFiles(*offline)});
  std::string no_report;
  try {
    outputs->Write(offline->output, yaml);
    written.push_back(offline->output);
    if (!offline->exports.empty()) {
      const StoredResult stored = ParseResult(yaml, offline->output);
      for (const std::string& path : WriteExports(stored, offline->exports, outputs))
        written.push_back(path);
      offline->export_note = ExportNote(stored, offline->exports);
    }
    for (const std::string& line : WriteTrajectories(offline->trajectory, offline->result,
                                                     offline->infos, offline->options, outputs))
      written.push_back(line);
    no_report = WriteReport(offline, progress);
    outputs->Commit();
  } catch (const InputError&) {
    std::cout << yaml << std::flush;
    throw;
  }
  if (!no_report.empty())
    no_report = "no report: " + no_report + "; the result is in '" + offline->output + "'";
  return no_report;
}

std::string Describe(const OfflineResult& offline, bool is_verbose) {
  constexpr size_t kMostFiles = 3, kScreen = 25;
  std::vector<std::string> written = offline.written;
  if (!is_verbose && written.size() > kMostFiles) {  // the exports
    const size_t more = written.size() - kMostFiles;
    const auto first = written.begin() + 1;
    written.erase(first, first + static_cast<std::ptrdiff_t>(more));
    written.push_back("and " + std::to_string(more) + " more beside the first: --verbose");
  }
  std::string files = WrittenTo(written);
  if (!offline.export_note.empty()) files += Wrap("  note: ", Printable(offline.export_note));
  std::vector<std::string> older = offline.earlier;
  const auto is_new = [&](const std::string& file) { return offline.outputs->Holds(file); };
  older.erase(std::remove_if(older.begin(), older.end(), is_new), older.end());
  if (!older.empty()) files += Wrap("  older, of another run: ", Printable(WithTimes(older)));
  if (is_verbose) return Summary(offline.result, offline.infos) + files;
  const auto lines = static_cast<size_t>(std::count(files.begin(), files.end(), '\n'));
  return Brief(offline.result, offline.infos, kScreen - std::min(kScreen, lines)) + files;
}

std::vector<OfflineCheck> CheckOffline(const OfflineRequest& given) {
  CheckGiven(given);
  const std::vector<OfflineRequest> requests = SplitSessions(given);
  const CalibrationOptions options = Options(requests.front());
  std::vector<OfflineCheck> checks;
  for (const Recording& recording : ReadRecordings(requests)) {
    checks.push_back({CheckData(options, recording.data), recording.info});
    std::vector<std::string>& warnings = checks.back().check.warnings;
    warnings.insert(warnings.end(), recording.info.notes.begin(), recording.info.notes.end());
  }
  return checks;
}

std::string OneLine(const std::exception& error) {
  std::string text = error.what();
  std::replace(text.begin(), text.end(), '\n', ' ');
  return Printable(text);
}

}  // namespace imu_pose_calib
