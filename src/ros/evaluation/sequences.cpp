#include "imu_pose_calib/ros/evaluation/sequences.h"

#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <boost/algorithm/string/replace.hpp>
#include <cmath>
#include <filesystem>
#include <fstream>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/verdict/comparison.h"
#include "imu_pose_calib/ros/evaluation/tables.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/ros_options.h"
#include "imu_pose_calib/ros/io/text_table.h"
#include "imu_pose_calib/ros/io/yaml_file.h"
#include "imu_pose_calib/ros/io/yaml_text.h"
#include "imu_pose_calib/ros/offline/comparison_report.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

namespace fs = std::filesystem;

constexpr double kDegrees = 180.0 / M_PI;

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

/// All paths below a folder, in order.
std::vector<fs::path> Below(const std::string& folder) {
  if (!fs::is_directory(folder))
    throw InputError("'" + folder + "' is not a folder with recordings");
  std::vector<fs::path> paths;
  const auto options = fs::directory_options::skip_permission_denied;
  for (const auto& entry : fs::recursive_directory_iterator(folder, options))
    paths.push_back(entry.path());
  std::sort(paths.begin(), paths.end());
  return paths;
}

/// Path below `folder`, as a name; links are what they are called.
std::string NameOf(const fs::path& path, const std::string& folder) {
  const std::string name = path.lexically_relative(folder);
  return name == "." ? fs::absolute(path).lexically_normal().filename().string() : name;
}

Sequence BagSequence(const fs::path& path, const std::string& folder,
                     const OfflineRequest& common) {
  Sequence sequence;
  sequence.name = NameOf(fs::path(path).replace_extension(""), folder);
  sequence.request = common;
  sequence.request.bag.paths = {path};
  return sequence;
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

bool HasPoses(const fs::path& file) {
  std::ifstream in(file);
  return in && HasPoseHeader(in, file);
}

/// The sources of poses of an ASL dataset whose IMU is in `imu`: .../imu0/data.csv.
void AddAsl(const Dataset& dataset, const fs::path& imu, const std::string& folder,
            const OfflineRequest& common, std::vector<Sequence>* sequences) {
  const fs::path sensors = imu.parent_path().parent_path();
  const fs::path root = sensors.filename() == "mav0" ? sensors.parent_path() : sensors;
  std::vector<fs::path> sources;
  for (const auto& entry : fs::directory_iterator(sensors))
    if (HasPoses(entry.path() / "data.csv")) sources.push_back(entry.path());
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

std::vector<std::string> Inputs(const OfflineRequest& request) {
  std::vector<std::string> paths = request.bag.paths;
  for (const std::string* path :
       {&request.text.poses, &request.text.imu, &request.config, &request.imu_yaml})
    if (!path->empty()) paths.push_back(*path);
  return paths;
}

/// All that the result follows from, on one line.
std::string Describe(const OfflineRequest& request) {
  std::string text = kVersion + (" " + request.method) + " " + request.bag.imu_topic + " " +
                     request.bag.pose_topic + " " + request.bag.tf_parent + " " +
                     request.bag.tf_child;
  for (const std::string& path : Inputs(request)) text += "; " + DescribeFile(path);
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

std::vector<Task> ToTasks(const std::vector<Sequence>& sequences, bool with_report,
                          const std::string& folder) {
  std::vector<Task> tasks;
  for (const Sequence& sequence : sequences) {
    OfflineRequest request = sequence.request;
    request.output = folder + "/" + sequence.name + ".calibration.yaml";
    if (with_report) request.report = ReportPath(request);
    fs::create_directories(fs::path(request.output).parent_path());
    tasks.push_back({sequence.name, Describe(request), [request] { return Calibrate(request); }});
  }
  return tasks;
}

struct Calibrated {
  const Sequence* sequence;
  TrialOutcome outcome;
};

std::string Table(const std::vector<Calibrated>& calibrations) {
  std::string text =
      "| recording | verdict | p [mm] | sigma | R, rotation vector [deg] | sigma | time shift [s] "
      "| sigma | accel delay [ms] | sigma | warnings |\n"
      "|---|---|---|---|---|---|---|---|---|---|---|\n";
  for (const auto& [sequence, o] : calibrations) {
    text += "| " + sequence->name + " | " + o.verdict + " | ";
    if (!o.IsUsable()) {
      text += boost::replace_all_copy(o.reason, "|", "/") + " | | | | | | | | |\n";
      continue;
    }
    const Vector6d std = o.covariance.diagonal().cwiseSqrt();
    text += List(1e3 * o.T_MI.p, "%.2f") + " | " + List(1e3 * std.head<3>(), "%.2f") + " | " +
            List(kDegrees * Log(o.T_MI.q), "%.3f") + " | " +
            List(kDegrees * std.tail<3>(), "%.3f") +
            Format(" | %.6f | %.6f | %.3f | %.3f | %zu |\n", o.time_shift, o.time_shift_std,
                   1e3 * o.accel_delay, 1e3 * o.accel_delay_std, o.warnings);
  }
  return text + "\n";
}

std::string Csv(const std::vector<Calibrated>& calibrations) {
  std::string text =
      "recording,verdict,x,y,z,x_std,y_std,z_std,qx,qy,qz,qw,rx_std,ry_std,rz_std,time_shift,"
      "time_shift_std,accel_delay,accel_delay_std,warnings,reason\n";
  for (const auto& [sequence, o] : calibrations) {
    Eigen::VectorXd numbers(17);
    const Vector6d std = o.covariance.diagonal().cwiseSqrt();
    numbers << o.T_MI.p, std.head<3>(), o.T_MI.q.coeffs(), std.tail<3>(), o.time_shift,
        o.time_shift_std, o.accel_delay, o.accel_delay_std;
    text += "\"" + sequence->name + "\"," + o.verdict;
    for (Eigen::Index k = 0; k < numbers.size(); ++k)
      text += o.IsUsable() ? "," + YamlNumber(numbers[k]) : ",";
    text += Format(",%zu,\"", o.warnings) + boost::replace_all_copy(o.reason, "\"", "'") + "\"\n";
  }
  return text;
}

std::string ScatterTable(const std::vector<Comparable>& calibrations) {
  const Repeatability repeat =
      Repeat(calibrations, {ComparedQuantity::kTranslation, ComparedQuantity::kRotation,
                            ComparedQuantity::kAccelDelay, ComparedQuantity::kTimeShift});
  std::string text = Format("Scatter of %zu: mean p %s mm, R %s deg.\n\n", calibrations.size(),
                            List(1e3 * repeat.mean.T_MI.p, "%.2f").c_str(),
                            List(kDegrees * Log(repeat.mean.T_MI.q), "%.3f").c_str()) +
                     "| | standard deviation | sigma, rms | chi² / dof |\n|---|---|---|---|\n";
  for (const Scatter& scatter : repeat.scatters) {
    const bool is_angle = scatter.quantity == ComparedQuantity::kRotation;
    const auto list = [&](const Eigen::VectorXd& values) {
      std::vector<std::string> words;
      for (Eigen::Index k = 0; k < values.size(); ++k)
        words.push_back(Format("%.3f", values[k] * (is_angle ? kDegrees : 1e3)));
      return boost::join(words, ", ");
    };
    const char* unit = is_angle                                             ? "deg"
                       : scatter.quantity == ComparedQuantity::kTranslation ? "mm"
                                                                            : "ms";
    text += Format("| %s [%s] | %s | %s | %.1f / %d |\n", ToString(scatter.quantity), unit,
                   list(scatter.deviation).c_str(), list(scatter.sigma).c_str(), scatter.chi2,
                   scatter.dof);
  }
  return text + "\n";
}

std::string AuditRow(const std::string& name, const Comparable& found, const Rigid3& published) {
  Comparable given;
  given.T_MI = published;
  std::vector<std::string> cells = {name};
  bool agrees = true;
  const auto add = [&](ComparedQuantity quantity, double value, int digits) {
    const Comparison comparison = Compare(given, found, {quantity});
    const Difference* worst = comparison.Worst();
    const double sigmas = worst == nullptr ? 0.0 : worst->sigmas;
    agrees = agrees && sigmas <= kAgreementBound;
    cells.push_back(Format("%.*f (%.1f)", digits, value, sigmas));
  };
  const Comparison all = Compare(given, found, {ComparedQuantity::kTranslation});
  add(ComparedQuantity::kTranslation, 1e3 * all.distance, 2);
  add(ComparedQuantity::kRotation, kDegrees * all.angle, 3);
  const bool is_frame = agrees;
  agrees = true;
  add(ComparedQuantity::kTimeShift, 1e3 * found.time_shift, 3);
  cells.emplace_back(is_frame ? "yes" : "no");
  cells.emplace_back(agrees ? "yes" : "no");
  return "| " + boost::join(cells, " | ") + " |\n";
}

/// Tables of each group of a dataset.
std::string DatasetTables(const std::vector<Calibrated>& calibrations) {
  std::string text;
  for (auto begin = calibrations.begin(), end = begin; begin != calibrations.end(); begin = end) {
    const std::string& group = begin->sequence->group;
    end = std::find_if(begin, calibrations.end(), [&](const Calibrated& calibrated) {
      return calibrated.sequence->group != group;
    });
    text += "## " + group + "\n\n" + Table({begin, end});
    std::vector<Comparable> usable;
    std::string audit;
    for (auto it = begin; it != end; ++it) {
      const auto& [sequence, outcome] = *it;
      if (!outcome.IsUsable()) continue;
      usable.push_back(outcome);
      if (sequence->published_T_MI)
        audit += AuditRow(sequence->name, outcome, *sequence->published_T_MI);
    }
    if (usable.size() > 1) text += ScatterTable(usable);
    if (audit.empty()) continue;
    text +=
        Format(
            "Less what is published, in brackets the largest component in its sigma; *yes* is "
            "within %g sigma. The clocks are said to be one.\n\n"
            "| recording | p [mm] | R [deg] | time shift [ms] | frame as published? | clock of the "
            "IMU? |\n|---|---|---|---|---|---|\n",
            kAgreementBound) +
        audit + "\n";
  }
  return text;
}

/// A page of all bags of a batch that have a result; empty without any.
std::string WriteFleet(const std::vector<Calibrated>& calibrations, const std::string& title,
                       const std::string& folder) {
  std::vector<StoredResult> results;
  for (const auto& [sequence, outcome] : calibrations)
    if (outcome.IsUsable())
      results.push_back(LoadResult(folder + "/" + sequence->name + ".calibration.yaml"));
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

std::vector<Sequence> FindBags(const std::string& folder, const OfflineRequest& common) {
  std::vector<Sequence> sequences;
  for (const fs::path& path : Below(folder))
    if (path.extension() == ".bag") sequences.push_back(BagSequence(path, folder, common));
  if (sequences.empty()) throw InputError("there is no *.bag in '" + folder + "'");
  return sequences;
}

std::vector<Sequence> FindDataset(const std::string& name, const std::string& folder,
                                  const OfflineRequest& common) {
  const Dataset& dataset = Find(name);
  std::vector<Sequence> sequences;
  for (const fs::path& path : Below(folder)) {
    if (path.filename() == "data.csv" && path.parent_path().filename() == "imu0")
      AddAsl(dataset, path, folder, common, &sequences);
    if (path.extension() != ".bag") continue;
    Sequence sequence = BagSequence(path, folder, common);
    sequence.group = GroupOf(path, folder) + "bags";
    if (dataset.is_imu0 && common.bag.imu_topic.empty()) sequence.request.bag.imu_topic = "/imu0";
    sequences.push_back(sequence);
  }
  if (sequences.empty())
    throw InputError("there is no sequence of '" + name + "' below '" + folder + "'. " +
                     dataset.title);
  std::stable_sort(sequences.begin(), sequences.end(),
                   [](const Sequence& a, const Sequence& b) { return a.group < b.group; });
  return sequences;
}

SequencesOutcome RunSequences(const std::vector<Sequence>& sequences, const std::string& title,
                              bool is_dataset, const RunnerOptions& runner) {
  const std::vector<Task> tasks = ToTasks(sequences, !is_dataset, runner.folder);
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
  result.text =
      "# " + title + "\n\n" + (is_dataset ? DatasetTables(calibrations) : Table(calibrations));
  WriteFile(runner.folder + "/sequences.md", result.text);
  WriteFile(runner.folder + "/sequences.csv", Csv(calibrations));
  if (!is_dataset) result.text += WriteFleet(calibrations, title, runner.folder);
  return result;
}

}  // namespace imu_pose_calib
