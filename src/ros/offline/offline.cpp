#include "imu_pose_calib/ros/offline/offline.h"

#include <algorithm>
#include <boost/algorithm/string/replace.hpp>
#include <boost/range/algorithm_ext/erase.hpp>
#include <boost/range/algorithm_ext/push_back.hpp>
#include <filesystem>
#include <iostream>
#include <system_error>
#include <utility>

#include "imu_pose_calib/core/start/preparation.h"
#include "imu_pose_calib/ros/exports/exports.h"
#include "imu_pose_calib/ros/io/bag_file.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/ros_options.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/offline/summary.h"

namespace imu_pose_calib {
namespace {

/// Ground truth needs the whole factor, see CalibrationOptions::max_factor_mb.
constexpr double kUnbounded = 1e6;  // [MB]

bool NamesFiles(const RecordingRequest& request) {
  return request.NamesPoseFile() || request.NamesImuFile();
}

bool NamesImuTopic(const RecordingRequest& request) {
  return !(request.imu_topic.empty() && request.gyro_topic.empty() && request.accel_topic.empty());
}

bool NamesPoseTopic(const RecordingRequest& request) {
  return !(request.pose_topic.empty() && request.tf_parent.empty() && request.tf_child.empty());
}

/// For a session of which one part is in text files, and the other in bags.
void CheckParts(const RecordingRequest& request) {
  const std::string bags = "the bag '" + request.paths.front() + "'";
  IsPair({"imu", request.imu}, {"gyro", request.gyro}, {"accel", request.accel});
  if (request.NamesPoseFile() && request.NamesImuFile())
    Reject("poses and imu name text files for all that there is to read; leave out ", bags);
  if (request.NamesPoseFile() && NamesPoseTopic(request))
    Reject("poses names a text file; it does not go with pose_topic or tf of ", bags);
  if (request.NamesImuFile() && NamesImuTopic(request))
    Reject("imu, gyro and accel name text files; they do not go with topics of ", bags);
}

/// For a session in text files alone, of a folder or named: names every file.
void NameFiles(OfflineRequest* request) {
  if (NamesImuTopic(*request) || NamesPoseTopic(*request))
    Reject("text files have no topics and no tf; choose with poses, imu, gyro and accel");
  if (request->record_time) Reject("text files have no times of recording; leave out record_time");
  for (const std::string& name : SplitPaths(request->pose_sensors))
    if (!IsPoseFile(name)) Reject("pose_sensor '", name, "' is no file, nor is there a bag");
  static_cast<RecordingRequest&>(*request) = FindFiles(*request);
  const std::filesystem::path imu = request->imu.empty() ? request->gyro : request->imu;
  const std::string noise = imu.parent_path() / "sensor.yaml";
  if (request->imu_yaml.empty() && request->config.empty() && !imu.empty() &&
      std::filesystem::exists(noise))
    request->imu_yaml = noise;
}

/// One request for each session.
std::vector<OfflineRequest> SplitSessions(const OfflineRequest& given) {
  const std::vector<std::string>& paths = given.paths;
  if (paths.empty() && !NamesFiles(given))
    Reject("no recording is given: a bag, a folder, or the files poses and imu");
  const bool is_text = std::all_of(paths.begin(), paths.end(), [](const std::string& path) {
    return IsFolder(path) && MessageFiles(path).empty();
  });
  const bool is_mixed = !is_text && NamesFiles(given);
  std::vector<std::vector<std::string>> groups = {paths};
  if (is_text && paths.size() > 1) {
    groups.clear();
    for (const std::string& folder : paths) groups.push_back({folder});
  } else if (!is_text && !is_mixed && !given.one_recording) {
    groups = GroupBags(paths);
  }
  for (const std::string& name : SplitPaths(given.pose_sensors))
    if (groups.size() > 1 && IsPoseFile(name))
      Reject("pose_sensor '", name, "' is a file, which goes with one recording, not ",
             groups.size());
  std::vector<OfflineRequest> sessions(groups.size(), given);
  for (size_t s = 0; s < groups.size(); ++s) {
    OfflineRequest& session = sessions[s];
    session.paths = groups[s];
    session.may_lack_sensors = groups.size() > 1;
    if (is_mixed) CheckParts(session);
    if (is_text) NameFiles(&session);
  }
  return sessions;
}

/// Names the frames as the request says.
void NameFrames(const OfflineRequest& request, RecordingInfo* info) {
  const size_t names = SplitNames(request.imu_frame).size();
  if (!request.imu_frame.empty() && names != info->imus.size())
    Reject("imu_frame names ", names, " frames for ", info->imus.size(), " imus");
  NameFrames(request.marker_frame, request.imu_frame, info);
  for (const ImuInfo& imu : info->imus)
    if (info->marker_frame == imu.imu_frame)
      Reject("marker_frame and imu_frame are both '", imu.imu_frame,
             "', which leaves no transform between them; give one of them another name");
}

/// Makes the recordings those of one rig: each has a place for every sensor, whose frame is that
/// of the first recording that has it. Throws InputError when none has a pose sensor.
void CompleteRig(const OfflineRequest& request, std::vector<Recording>* recordings) {
  const auto name_alike = [recordings](auto frame_of) {
    std::string name;
    for (Recording& recording : *recordings)
      if (name.empty()) name = frame_of(&recording.info);
    for (Recording& recording : *recordings) frame_of(&recording.info) = name;
    return name;
  };
  size_t imus = 0;
  for (const Recording& recording : *recordings) imus = std::max(imus, recording.data.imus.size());
  for (Recording& recording : *recordings) {
    recording.info.imus.resize(imus);
    recording.data.imus.resize(imus);
  }
  name_alike([](RecordingInfo * info) -> auto& { return info->marker_frame; });
  const bool is_split = request.imu_topic.empty();
  const auto topics = SplitNames(is_split ? request.gyro_topic : request.imu_topic);
  for (size_t i = 0; i < imus; ++i) {
    const std::string frame =
        name_alike([i](RecordingInfo * info) -> auto& { return info->imus[i].imu_frame; });
    if (frame.empty() && i < topics.size())
      Reject(is_split ? "gyro_topic" : "imu_topic", " '", topics[i], "' is in no recording");
  }
  const std::vector<std::string> pose_sensors = SplitPaths(request.pose_sensors);
  for (size_t k = 0; k < pose_sensors.size(); ++k) {
    const std::string frame =
        name_alike([k](RecordingInfo * info) -> auto& { return info->pose_sensors[k].frame; });
    if (frame.empty()) Reject("pose_sensor '", pose_sensors[k], "' has no poses in any recording");
  }
}

/// The recordings of one rig, and the frames of its sensors the same in all of them.
std::vector<Recording> ReadRecordings(const std::vector<OfflineRequest>& sessions) {
  std::vector<Recording> recordings;
  for (OfflineRequest session : sessions) {
    if (!session.imu_yaml.empty() && !session.paths.empty())
      session.usual_imu_topic = LoadImuYaml(session.imu_yaml);
    recordings.push_back(session.paths.empty() ? ReadText(session) : ReadBag(session));
    recordings.back().info.imu_yaml = session.imu_yaml;
  }
  CompleteRig(sessions.front(), &recordings);
  for (Recording& recording : recordings) NameFrames(sessions.front(), &recording.info);
  return recordings;
}

/// No output is to replace what is read.
void KeepInputs(const std::vector<OfflineRequest>& sessions, OutputFiles* outputs) {
  for (const OfflineRequest& request : sessions) {
    outputs->Keep("poses", request.poses);
    outputs->Keep("imu", request.imu);
    outputs->Keep("gyro", request.gyro);
    outputs->Keep("accel", request.accel);
    outputs->Keep("config", request.config);
    outputs->Keep("imu_yaml", request.imu_yaml);
    outputs->Keep("calibration", request.calibration);
    for (const std::string& path : request.paths) {
      for (const std::string& file : MessageFiles(path)) outputs->Keep("bag", file);
      outputs->Keep("bag", path + "/metadata.yaml");  // of a folder
    }
    for (const std::string& name : SplitPaths(request.pose_sensors))
      outputs->Keep("pose_sensor", SplitBody(name).first);
  }
}

/// Draws why the data were refused, beside the report of an earlier run, which stays. That they
/// were is what to report in the first place: a failure is added to it.
[[noreturn]] void Refuse(const std::string& reason, OfflineResult* offline) {
  std::filesystem::path report = offline->request.report;
  if (report.empty()) throw DataError(reason);
  if (std::filesystem::exists(report))
    report.replace_extension(".refused" + report.extension().string());
  try {
    offline->refusal = reason;
    offline->outputs->Write(report, DrawReport(*offline, report));
    offline->outputs->Commit();
  } catch (const std::exception& error) {
    throw DataError(reason + "; no report: " + error.what());
  }
  throw DataError(reason + "; report: " + report.string());
}

/// See CalibrateOffline().
void RunOffline(const Progress& progress, OfflineResult* offline) {
  const OfflineRequest& given = offline->request;
  const std::vector<std::string> exports = ParseExports(given.exports);
  CheckBagsExist(given.paths);
  const std::vector<OfflineRequest> requests = SplitSessions(given);
  offline->options = Options(requests.front());
  if (!given.trajectory.path.empty()) offline->options.max_factor_mb = kUnbounded;
  // Before it takes long; of which sensors is not known yet.
  TrajectoryRequest of_any = given.trajectory;
  of_any.frame.clear();
  PlanTrajectories(of_any, offline->options.method, requests.size(), 1);
  const std::string extension = std::filesystem::path(given.report).extension();
  if (!given.report.empty() && extension != ".html" && extension != ".pdf")
    Reject("report '", given.report, "' must end in .html or .pdf");
  OutputFiles* outputs = offline->outputs.get();
  KeepInputs(requests, outputs);
  outputs->Plan("output", given.output);
  if (!given.report.empty()) outputs->Plan("report", given.report);

  if (progress) progress("recording", std::nullopt);
  for (Recording& recording : ReadRecordings(requests)) {
    offline->infos.push_back(recording.info);
    offline->sessions.push_back(std::move(recording.data));
  }
  offline->trajectories =
      PlanTrajectories(given.trajectory, offline->options.method, requests.size(),
                       offline->sessions[0].imus.size(), offline->infos[0].pose_sensors);
  for (const TrajectoryTarget& target : offline->trajectories)
    for (const std::string& file : target.Files())
      outputs->Plan("trajectory", file, target.format == TrajectoryFormat::kAsl);
  for (const std::string& file :
       ExportPaths(given.output, exports, offline->sessions[0].imus.size()))
    outputs->Plan("export", file);
  if (progress) progress("recording", 0);

  const bool is_kept = given.keep_data || !given.report.empty();
  try {
    offline->result =
        Calibrate(offline->options,
                  is_kept ? offline->sessions : std::exchange(offline->sessions, {}), progress);
  } catch (const DataError& error) {
    Refuse(error.what(), offline);
  }
  std::vector<std::string>& warnings = offline->result.warnings;
  for (const RecordingInfo& info : offline->infos)
    warnings.insert(warnings.begin(), info.notes.begin(), info.notes.end());
  if (!offline->result.IsUsable()) Refuse(offline->result.message, offline);
  boost::remove_erase_if(offline->trajectories, [&](const TrajectoryTarget& target) {
    return !target.IsIn(offline->result);
  });
}

/// Gives the outputs the report, if one is wanted, and lets go of the recorded data. Returns why
/// there is none.
std::string WriteReport(OfflineResult* offline, const Progress& progress) {
  const std::string& path = offline->request.report;
  if (path.empty()) return "";
  if (progress) progress("report", std::nullopt);
  std::string page;
  try {
    page = DrawReport(*offline, path);
  } catch (const std::exception& error) {
    return std::string("no report: ") + error.what() + "; the result is in '" +
           offline->request.output + "'";
  }
  offline->outputs->Write(path, page);
  offline->sessions = {};
  offline->written.push_back(path);
  if (progress) progress("report", 0);
  return "";
}

/// What the run writes under names that do not follow from that of the result, from its folder.
std::vector<std::string> OtherFiles(const OfflineResult& offline) {
  const auto normal = [](const std::filesystem::path& path) {
    return std::filesystem::absolute(path).lexically_normal();
  };
  std::vector<std::string> files;
  if (!offline.request.report.empty()) files.push_back(offline.request.report);
  for (const TrajectoryTarget& target : offline.trajectories) files.push_back(target.path);
  for (std::string& file : files)
    file = normal(file).lexically_proximate(normal(offline.request.output).parent_path());
  return files;
}

}  // namespace

CalibrationOptions Options(const OfflineRequest& request) {
  CalibrationOptions options;
  if (!request.config.empty()) options = LoadOptions(request.config);
  if (!request.imu_yaml.empty()) LoadImuYaml(request.imu_yaml, &options);
  if (!request.method.empty()) SetOption("method", YAML::Node(request.method), &options);
  if (!request.solver.empty()) SetOption("solver", YAML::Node(request.solver), &options);
  if (request.calibration.empty()) return options;
  // Clocks, gravity and biases are each recording's own.
  const Calibration stored = LoadResult(request.calibration).result;
  if (stored.imus.empty())
    Reject("'", request.calibration, "' holds no IMU, which calibration needs");
  const ImuCalibration& known = stored.imus[0];
  options.initial_rotation = known.T_MI.q;
  options.initial_translation = known.T_MI.p;
  options.accel_delay = known.accel_delay;
  options.estimate_rotation = options.estimate_translation = false;
  options.estimate_accel_delay = false;
  return options;
}

RequestOptions OptionsOf(OfflineRequest* request) {
  using List = RequestOption::List;
  TrajectoryRequest& trajectory = request->trajectory;
  RequestOptions options;
  options.common = {
      {"imu_topic", List{&request->imu_topic}, "sensor_msgs/Imu; again for each further IMU"},
      {"pose_topic", &request->pose_topic, "poses of the marker"},
      {"pose_sensor", List{&request->pose_sensors},
       "poses of a camera, SLAM, ...: TOPIC, FILE, or tf:PARENT:CHILD; again for each further one"},
      {"body", &request->body, "rigid body, where poses are of several"},
      {"imu_yaml", &request->imu_yaml, "Kalibr's imu.yaml: noise and topic"},
      {"config", &request->config, "YAML of options, see config/default.yaml"},
      {"start", &request->start_s, "seconds of the recording to skip", "S"},
      {"duration", &request->duration_s, "seconds to use; 0: all", "S"},
      {"output", &request->output, "result; default: next to the recording"},
      {"report", &request->report, "figures: FILE.html or FILE.pdf"},
      {"export", &request->exports, "kalibr,ros2,...: files for other programs"},
      {"trajectory", &request->trajectory.path, "ground truth: .tum, .csv, .bag, folder"}};
  options.others = {
      {"gyro_topic", List{&request->gyro_topic},
       "gyroscope of a split IMU: sensor_msgs/Imu or geometry_msgs/Vector3Stamped"},
      {"accel_topic", List{&request->accel_topic}, "accelerometer of a split IMU"},
      {"tf_parent", &request->tf_parent, "poses from tf: the fixed frame"},
      {"tf_child", &request->tf_child, "poses from tf: the marker"},
      {"poses", &request->poses,
       "text file of the poses, instead of those of a bag: CSV, TUM, export of Motive or Vicon"},
      {"imu", List{&request->imu}, "text file of the IMU; again for each further one"},
      {"gyro", List{&request->gyro}, "text file of the gyroscope of a split IMU"},
      {"accel", List{&request->accel}, "text file of the accelerometer of a split IMU"},
      {"method", &request->method, "joint (default) or gp"},
      {"solver", &request->solver, "of method joint: windows (default) or ceres"},
      {"trajectory_format", &trajectory.format,
       "tum, ov_eval, euroc, asl or bag; default: by the suffix"},
      {"trajectory_frame", &trajectory.frame,
       "pose sensor whose trajectory it is, sensor0 or its frame; default: the IMUs", "NAME"},
      {"trajectory_rate", &trajectory.rate_hz,
       "states per second; default: at the samples of the IMU", "HZ"},
      {"trajectory_clock", &trajectory.clock, "clock of its stamps: imu (default) or poses"},
      {"trajectory_gaps", &trajectory.max_gap_s,
       "longest gap of the poses that the IMU bridges (default 2); others are left out", "S"},
      {"record_time", &request->record_time, "times of recording instead of the header stamps"},
      {"marker_frame", &request->marker_frame, "name of the marker frame in the result"},
      {"imu_frame", List{&request->imu_frame},
       "name of the imu frame in the result; again for each further IMU"},
      {"one_recording", &request->one_recording,
       "all bags are one recording, also those that do not continue each other"}};
  return options;
}

std::string OutputPath(const OfflineRequest& request) {
  if (!request.output.empty()) return request.output;
  if (request.paths.empty())
    return std::filesystem::path(request.poses).replace_extension(".calibration.yaml");
  const std::string& path = request.paths.front();
  if (IsFolder(path)) return std::filesystem::path(path) / "calibration.yaml";
  return WithoutBagEnding(path) + ".calibration.yaml";
}

std::string ReportPath(const OfflineRequest& request) {
  return std::filesystem::path(OutputPath(request)).replace_extension(".report.html");
}

OfflineResult CalibrateOffline(const OfflineRequest& given, const Progress& progress) {
  OfflineResult offline;
  offline.run_id = offline.outputs->run_id();
  offline.request = given;
  offline.request.output = OutputPath(given);
  offline.earlier = FindEarlier(offline.request.output);
  std::string still_there;
  if (!offline.earlier.empty())
    still_there = "; still there, of an earlier run: " + WithTimes(offline.earlier);
  try {
    RunOffline(progress, &offline);
  } catch (const DataError& error) {
    throw DataError(error.what() + still_there);
  } catch (const InputError& error) {
    Reject(error.what(), still_there);
  }
  return offline;
}

std::string WriteResult(OfflineResult* offline, const Progress& progress) {
  const OfflineRequest& request = offline->request;
  OutputFiles* outputs = offline->outputs.get();
  std::vector<std::string>& written = offline->written;
  const std::string yaml = ToYaml(offline->result, offline->infos, offline->options,
                                  {offline->run_id, OtherFiles(*offline)});
  try {
    outputs->Write(request.output, yaml);
    written.push_back(request.output);
    if (!request.exports.empty()) {
      const StoredResult stored = ParseResult(yaml, request.output);
      const std::vector<std::string> names = ParseExports(request.exports);
      boost::push_back(written, WriteExports(stored, names, outputs));
      offline->export_note = ExportNote(stored, names);
    }
    boost::push_back(
        written, WriteTrajectories(request.trajectory, offline->trajectories, *offline, outputs));
    std::string failure = WriteReport(offline, progress);
    outputs->Commit();
    return failure;
  } catch (const InputError&) {
    std::cout << yaml << std::flush;
    throw;
  }
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
  boost::remove_erase_if(older,
                         [&](const std::string& file) { return offline.outputs->Holds(file); });
  if (!older.empty()) files += Wrap("  older, of another run: ", Printable(WithTimes(older)));
  if (is_verbose) return Summary(offline.result, offline.infos) + files;
  const auto lines = static_cast<size_t>(std::count(files.begin(), files.end(), '\n'));
  return Summary(offline.result, offline.infos, kScreen - std::min(kScreen, lines)) + files;
}

std::vector<OfflineCheck> CheckOffline(const OfflineRequest& given) {
  const std::vector<OfflineRequest> requests = SplitSessions(given);
  const CalibrationOptions options = Options(requests.front());
  std::vector<OfflineCheck> checks;
  for (const Recording& recording : ReadRecordings(requests)) {
    checks.push_back({CheckData(options, recording.data), recording.info});
    boost::push_back(checks.back().check.warnings, recording.info.notes);
  }
  return checks;
}

std::string OneLine(const std::exception& error) {
  return Printable(boost::replace_all_copy<std::string>(error.what(), "\n", " "));
}

}  // namespace imu_pose_calib
