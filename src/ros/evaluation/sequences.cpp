#include "imu_pose_calib/ros/evaluation/sequences.h"

#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <boost/algorithm/string/replace.hpp>
#include <filesystem>
#include <fstream>
#include <iterator>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/verdict/comparison.h"
#include "imu_pose_calib/ros/evaluation/tables.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/ros_options.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/io/text_table.h"
#include "imu_pose_calib/ros/io/yaml_file.h"
#include "imu_pose_calib/ros/offline/comparison_report.h"
#include "imu_pose_calib/ros/offline/report.h"

namespace imu_pose_calib {
namespace {

namespace fs = std::filesystem;

const std::vector<ComparedQuantity> kCompared = {
    ComparedQuantity::kTranslation, ComparedQuantity::kRotation, ComparedQuantity::kAccelDelay,
    ComparedQuantity::kTimeShift};

// --- Where the sequences of public datasets are, and what is published of them ---

struct Dataset {
  const char* name;
  const char* title;  ///< with place and licence
  bool is_imu0;       ///< the IMU of its bags is /imu0
  bool is_in_imu;     ///< poses without a sensor.yaml are said to be the IMU's
};

constexpr Dataset kDatasets[] = {
    {"tum-vi",
     "TUM-VI (Schubert et al., IROS 2018): https://cvg.cit.tum.de/data/datasets/"
     "visual-inertial-dataset, CC BY 4.0. Sequences in EuRoC's format, or bags; poses are "
     "published as those of the IMU, on its clock",
     true, true},
    {"euroc",
     "EuRoC MAV (Burri et al., IJRR 2016): https://doi.org/10.3929/ethz-b-000690084, in copyright, "
     "non-commercial use permitted. T_BS in sensor.yaml is the published calibration",
     true, false},
    {"broad",
     "BROAD (Laidig et al., Data 6(7):72, 2021): https://github.com/dlaidig/broad, CC BY 4.0. "
     "First, convert_broad.py FOLDER_OF_MAT_OR_HDF5 FOLDER. No calibration is published",
     false, false},
};

const Dataset& Find(const std::string& name) {
  for (const Dataset& dataset : kDatasets)
    if (dataset.name == name) return dataset;
  throw InputError("dataset '" + name + "' is unknown; must be tum-vi, euroc or broad");
}

/// Path below `folder`, as a name; links are what they are called.
std::string NameOf(const fs::path& path, const std::string& folder) {
  const std::string name = path.lexically_relative(folder);
  return name == "." ? fs::absolute(path).lexically_normal().filename().string() : name;
}

/// The folder that a sequence is in, below `folder`: of one session, perhaps.
std::string GroupOf(const fs::path& path, const std::string& folder) {
  const std::string parent = path.parent_path().lexically_relative(folder);
  return path.lexically_relative(folder) == "." || parent == "." ? "" : parent + "/";
}

/// T_BS of the sensor.yaml beside a file of samples: x_body = T_BS x_sensor.
std::optional<Rigid3> SensorPose(const fs::path& data) {
  const fs::path path = data.parent_path() / "sensor.yaml";
  if (!fs::exists(path)) return std::nullopt;
  try {
    const YAML::Node list = ParseYaml(ReadYamlFile(path))["T_BS"]["data"];
    const auto values = list.as<std::vector<double>>();
    if (values.size() != 16) throw InputError("T_BS must have 16 elements");
    const Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>> T(values.data());
    const Eigen::Matrix3d R = T.topLeftCorner<3, 3>();
    return Rigid3{Eigen::Quaterniond(R).normalized(), T.topRightCorner<3, 1>()};
  } catch (const std::exception& error) {
    throw InputError(path.string() + ": " + error.what());
  }
}

/// The sources of poses of an ASL dataset whose IMU is in `imu`: .../imu0/data.csv.
void AddAsl(const Dataset& dataset, const fs::path& imu, const std::string& folder,
            const OfflineRequest& common, std::vector<Sequence>* sequences) {
  const fs::path sensors = imu.parent_path().parent_path();
  const fs::path root = sensors.filename() == "mav0" ? sensors.parent_path() : sensors;
  std::vector<fs::path> sources;
  for (const auto& entry : fs::directory_iterator(sensors)) {
    const fs::path file = entry.path() / "data.csv";
    std::ifstream in(file);
    if (in && HasPoseHeader(in, file)) sources.push_back(entry.path());
  }
  std::sort(sources.begin(), sources.end());
  for (const fs::path& source : sources) {
    Sequence sequence;
    const std::string name = source.filename();
    sequence.group = GroupOf(root, folder) + name;
    sequence.name = NameOf(root, folder) + "/" + name;
    sequence.request = common;
    sequence.request.text.poses = source / "data.csv";
    sequence.request.text.imu = imu;
    const std::optional<Rigid3> T_BM = SensorPose(source / "data.csv"), T_BI = SensorPose(imu);
    if (T_BM)
      sequence.published_T_MI = T_BM->Inverse() * T_BI.value_or(Rigid3());
    else if (dataset.is_in_imu)
      sequence.published_T_MI = Rigid3();
    sequences->push_back(sequence);
  }
}

// --- Calibration and tables ---

/// All that the result follows from, on one line.
std::string Describe(const OfflineRequest& request) {
  std::string text = kVersion + (" " + request.method) + " " + request.bag.imu_topic + " " +
                     request.bag.pose_topic + " " + request.bag.tf_parent + " " +
                     request.bag.tf_child;
  std::vector<std::string> paths = request.bag.paths;
  for (const std::string* path :
       {&request.text.poses, &request.text.imu, &request.config, &request.imu_yaml})
    if (!path->empty()) paths.push_back(*path);
  for (const std::string& path : paths) text += "; " + DescribeFile(path);
  return boost::replace_all_copy(text, "\n", " ");
}

/// Result, report and outcome of one.
std::string Calibrate(const OfflineRequest& request) {
  TrialOutcome outcome;
  try {
    OfflineResult offline = CalibrateOffline(request);
    const std::string failure = WriteResult(&offline);
    if (!failure.empty()) throw InputError(failure);
    Take(offline.result, &outcome);
  } catch (const DataError& error) {
    outcome.verdict = "refused";
    outcome.reason = OneLine(error);
  } catch (const InputError& error) {  // of this one: others go on
    outcome.verdict = kFailed;
    outcome.reason = OneLine(error);
  }
  return ToYaml(outcome);
}

std::string ResultOf(const Sequence& sequence, const std::string& folder) {
  return folder + "/" + sequence.name + ".calibration.yaml";
}

struct Calibrated {
  const Sequence* sequence;
  TrialOutcome outcome;
};

/// How the usable calibrations of a group scatter, and how they differ from what is published.
YAML::Node Judge(const std::vector<Calibrated>& group) {
  YAML::Node node;
  std::vector<Comparable> usable;
  for (const auto& [sequence, outcome] : group) {
    if (!outcome.IsUsable()) continue;
    usable.push_back(outcome);
    if (!sequence->published_T_MI) continue;
    Comparable published;
    published.T_MI = *sequence->published_T_MI;
    YAML::Node audit = Describe(sequence->name, Compare(published, outcome, kCompared));
    audit["time_shift"] = YamlValue(outcome.time_shift);
    node["audit"].push_back(audit);
  }
  if (usable.size() < 2) return node;
  const Repeatability repeat = Repeat(usable, kCompared);
  node["scatter"]["mean"] = YamlList(repeat.mean.T_MI.p);
  node["scatter"]["rotation_vector"] = YamlList(Log(repeat.mean.T_MI.q));
  for (const Scatter& scatter : repeat.scatters)
    node["scatter"]["rows"].push_back(Describe(scatter));
  return node;
}

/// What scripts/evaluation_tables.py makes the tables of.
YAML::Node DescribeAll(const std::vector<Calibrated>& calibrations, const std::string& title,
                       bool is_dataset) {
  YAML::Node input;
  input["title"] = title;
  input["bound"] = YamlValue(kAgreementBound);
  for (auto begin = calibrations.begin(), end = begin; begin != calibrations.end(); begin = end) {
    const std::string& group = begin->sequence->group;
    end = std::find_if(begin, calibrations.end(), [&](const Calibrated& calibrated) {
      return calibrated.sequence->group != group;
    });
    YAML::Node node = is_dataset ? Judge({begin, end}) : YAML::Node();
    node["name"] = group;
    for (auto it = begin; it != end; ++it)
      node["results"].push_back(Describe(it->sequence->name, it->outcome));
    input["groups"].push_back(node);
  }
  return input;
}

/// A page of all bags of a batch that have a result; empty without any.
std::string WriteFleet(const std::vector<Calibrated>& calibrations, const std::string& title,
                       const std::string& folder) {
  std::vector<StoredResult> results;
  for (const auto& [sequence, outcome] : calibrations)
    if (outcome.IsUsable()) results.push_back(LoadResult(ResultOf(*sequence, folder)));
  if (results.empty()) return "";
  const std::string path = folder + "/sequences.report.html";
  const std::vector<ComparedQuantity> quantities = {
      ComparedQuantity::kTranslation, ComparedQuantity::kRotation, ComparedQuantity::kAccelDelay};
  WriteComparison({results, 0, quantities, std::nullopt, "compared",
                   title + Format(": %zu of %zu recordings have a result; those of one rig and IMU "
                                  "should agree",
                                  results.size(), calibrations.size())},
                  path);
  return "Written to " + path + "\n";
}

}  // namespace

std::string DatasetTitle(const std::string& dataset) { return Find(dataset).title; }

std::vector<Sequence> FindSequences(const std::string& name, const std::string& folder,
                                    const OfflineRequest& common) {
  const Dataset* dataset = name.empty() ? nullptr : &Find(name);
  if (!fs::is_directory(folder))
    throw InputError("'" + folder + "' is not a folder with recordings");
  std::vector<fs::path> paths;
  const auto options = fs::directory_options::skip_permission_denied;
  for (const auto& entry : fs::recursive_directory_iterator(folder, options))
    paths.push_back(entry.path());
  std::sort(paths.begin(), paths.end());
  std::vector<Sequence> sequences;
  for (const fs::path& path : paths) {
    if (dataset && path.filename() == "data.csv" && path.parent_path().filename() == "imu0")
      AddAsl(*dataset, path, folder, common, &sequences);
    if (path.extension() != ".bag") continue;
    Sequence sequence{NameOf(fs::path(path).replace_extension(""), folder), "", common, {}};
    sequence.request.bag.paths = {path};
    if (dataset) sequence.group = GroupOf(path, folder) + "bags";
    if (dataset && dataset->is_imu0 && common.bag.imu_topic.empty())
      sequence.request.bag.imu_topic = "/imu0";
    sequences.push_back(sequence);
  }
  if (sequences.empty())
    throw InputError(dataset ? "there is no sequence of '" + name + "' below '" + folder + "'. " +
                                   dataset->title
                             : "there is no *.bag in '" + folder + "'");
  std::stable_sort(sequences.begin(), sequences.end(),
                   [](const Sequence& a, const Sequence& b) { return a.group < b.group; });
  return sequences;
}

SequencesOutcome RunSequences(const std::vector<Sequence>& sequences, const std::string& title,
                              bool is_dataset, const RunnerOptions& runner) {
  std::vector<Task> tasks;
  for (const Sequence& sequence : sequences) {
    OfflineRequest request = sequence.request;
    request.output = ResultOf(sequence, runner.folder);
    if (!is_dataset) request.report = ReportPath(request);
    fs::create_directories(fs::path(request.output).parent_path());
    tasks.push_back({sequence.name, Describe(request), [request] { return Calibrate(request); }});
  }
  RunTasks(tasks, runner);
  SequencesOutcome result;
  std::vector<Calibrated> calibrations;
  for (size_t i = 0; i < tasks.size(); ++i) {
    const auto text = FinishedTask(runner.folder, tasks[i]);
    if (!text) {
      ++result.missing;
      continue;
    }
    calibrations.push_back({&sequences[i], ParseOutcome(*text)});
    if (!calibrations.back().outcome.IsUsable()) result.failed.push_back(sequences[i].name);
  }
  if (result.missing > 0) return result;
  MakeTables(DescribeAll(calibrations, title, is_dataset), "", runner.folder);
  std::ifstream table(runner.folder + "/sequences.md");
  result.text = {std::istreambuf_iterator<char>(table), {}};
  if (!is_dataset) result.text += WriteFleet(calibrations, title, runner.folder);
  return result;
}

}  // namespace imu_pose_calib
