#include "imu_pose_calib/ros/evaluation/evaluation.h"

#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <filesystem>
#include <iomanip>
#include <map>
#include <optional>
#include <sstream>

#include "imu_pose_calib/ros/evaluation/experiments.h"
#include "imu_pose_calib/ros/evaluation/tables.h"
#include "imu_pose_calib/ros/io/bag_reader.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/io/transform_file.h"
#include "imu_pose_calib/ros/io/yaml_file.h"
#include "imu_pose_calib/ros/offline/comparison_report.h"
#include "imu_pose_calib/ros/offline/report.h"

namespace imu_pose_calib {
namespace {

constexpr int kParts = 3;             // of a bag that is compared with itself
constexpr double kPartDuration = 25;  // [s]

/// An experiment on one base.
struct Plan {
  Experiment experiment;
  Base base;
  std::vector<Trial> trials;

  /// Whether noise is added to a bag, so that its result without is the truth.
  bool HasReference() const { return base == Base::kBag && !experiment.is_compared; }
};

std::vector<Experiment> Choose(const std::vector<std::string>& wanted) {
  std::vector<Experiment> all = Experiments();
  if (wanted.empty()) return all;
  std::vector<std::string> names;
  for (const Experiment& experiment : all) names.push_back(experiment.name);
  std::vector<Experiment> chosen;
  for (const std::string& name : wanted) {
    const auto found = std::find(names.begin(), names.end(), name);
    if (found == names.end())
      throw InputError("there is no experiment '" + name + "'" + DidYouMean(name, names) +
                       " There are: " + boost::join(names, ", "));
    chosen.push_back(all[static_cast<size_t>(found - names.begin())]);
  }
  return chosen;
}

/// One trial for scripts/evaluation_tables.py: where it belongs, what became of it, and norms of
/// its errors, sigmas and bounds.
std::string CsvRow(size_t plan, const Trial& trial, const TrialOutcome& o,
                   const Comparable& truth) {
  const Vector6d variance = o.covariance.diagonal();
  const ErrorNorms sigma = {std::sqrt(variance.head<3>().sum()),
                            std::sqrt(variance.tail<3>().sum()), o.time_shift_std,
                            o.accel_delay_std};
  std::ostringstream row;
  row.precision(17);
  row << plan << "," << trial.cell << "," << ToString(trial.what.method) << ",\"" << trial.name
      << "\"," << o.verdict << ","
      << std::quoted(o.reason.substr(0, o.reason.find('\n')), '"', '"');
  for (const ErrorNorms& norms :
       {NormsOf(ErrorsOf(o, truth)), sigma, o.bounds.as_joint, o.bounds.least})
    row << "," << norms.rotation << "," << norms.translation << "," << norms.time_shift << ","
        << norms.accel_delay;
  row << "," << o.chi2 << "," << o.model_chi2 << "," << o.guess_angle << "," << o.guess_distance
      << "\n";
  return row.str();
}

class Evaluation {
 public:
  explicit Evaluation(const EvaluationRequest& request) : request_(request) {
    for (const Experiment& experiment : Choose(request.experiments))
      for (const Base base : experiment.bases)
        if (std::count(request.bases.begin(), request.bases.end(), base) > 0)
          plans_.push_back(MakePlan(experiment, base));
    if (plans_.empty())
      throw InputError("none of the experiments runs on a bag; leave out --bag or add --simulate");
    if (!request.chain.empty()) {
      if (request.chain.size() != 2)
        throw InputError("--chain takes two transforms: T_marker_camera and T_camera_imu");
      chained_ = Comparable();
      chained_->T_MI =
          ReadTransform("--chain", request.chain[0]) * ReadTransform("--chain", request.chain[1]);
    }
  }

  std::string Run() {
    const std::vector<Task> references = References();
    std::vector<Task> tasks;
    for (const Plan& plan : plans_)
      for (const Trial& trial : plan.trials) tasks.push_back(ToTask(trial));
    if (!request_.is_merge) {
      // Once, before the processes of the trials begin.
      if (Missing(references) + Missing(tasks) > 0) ReadBags();
      RunnerOptions all = request_.runner;  // every part needs them
      all.part = 0;
      all.parts = 1;
      all.title = "references";
      RunTasks(references, all);
      RunTasks(tasks, request_.runner);
    }
    const size_t missing = Missing(references) + Missing(tasks);
    const size_t all = references.size() + tasks.size();
    if (missing > 0 && request_.is_merge)
      throw InputError(Format("%zu of %zu trials are missing in '%s'; run them, and merge again",
                              missing, all, request_.runner.folder.c_str()));
    if (request_.runner.parts > 1)  // others may be at it, too
      return Format("%zu of %zu trials are done; --merge makes the tables\n", all - missing, all);
    WriteTables();
    return "tables and figures are in '" + request_.runner.folder + "': evaluation.md\n";
  }

 private:
  /// What is compared with each other: the bags of the rig, or parts of one.
  Axis Recordings() const {
    Axis axis{"recording", {}, {}};
    std::vector<Source> sources;
    const auto add = [&](const Source& source, const std::string& part) {
      axis.values.push_back({std::filesystem::path(source.path).stem().string() + part,
                             static_cast<double>(sources.size())});
      sources.push_back(source);
    };
    for (const std::string& path : request_.rig) add({path}, "");
    for (int i = 0; i < kParts && request_.rig.empty(); ++i)
      add({request_.bag.path, kPartDuration * i, kPartDuration},
          Format(" %g-%g s", kPartDuration * i, kPartDuration * (i + 1)));
    axis.set = [sources](double value, Case* trial) {
      trial->source = sources[static_cast<size_t>(value)];
    };
    return axis;
  }

  Plan MakePlan(Experiment experiment, Base base) const {
    Source& source = experiment.base.source;
    const double enough = source.duration_s;
    source = request_.bag;
    if (enough > 0.0 && (source.duration_s == 0.0 || source.duration_s > enough))
      source.duration_s = enough;
    if (experiment.is_compared && base == Base::kBag) experiment.axes = {Recordings()};
    return {experiment, base, Trials(experiment, base, request_.trials)};
  }

  Task ToTask(const Trial& trial) const {
    return {trial.name, Describe(trial.what), [this, what = trial.what] {
              static const SessionData kNoBag;
              const bool is_bag = what.base == Base::kBag;
              return ToYaml(RunTrial(what, is_bag ? Bag(what.source) : kNoBag,
                                     is_bag && what.is_guessed ? Reference(what) : TrialOutcome()));
            }};
  }

  /// What a bag holds; read when it is needed first.
  const SessionData& Bag(const Source& source) const {
    const std::string key =
        Format("%s %.9g %.9g", source.path.c_str(), source.start_s, source.duration_s);
    const auto found = bags_.find(key);
    if (found != bags_.end()) return found->second;
    BagRequest request;
    request.paths = {source.path};
    request.start_s = source.start_s;
    request.duration_s = source.duration_s;
    return bags_[key] = ReadBag(request).data;
  }

  void ReadBags() const {
    for (const Plan& plan : plans_)
      for (const Trial& trial : plan.trials)
        if (plan.base == Base::kBag) Bag(trial.what.source);
  }

  /// The bag of a trial as it is.
  Task ReferenceTask(Method method, const Source& source) const {
    Trial trial{
        Format("reference/sample/duration_%g/%s", source.duration_s, ToString(method)), 0, {}};
    trial.what.base = Base::kBag;
    trial.what.method = method;
    trial.what.source = source;
    return ToTask(trial);
  }

  std::vector<Task> References() const {
    std::map<std::string, Task> references;
    for (const Plan& plan : plans_)
      for (const Method method : {Method::kGp, Method::kJoint})
        if (plan.HasReference()) {
          const Task task = ReferenceTask(method, plan.experiment.base.source);
          references.emplace(task.name, task);
        }
    std::vector<Task> tasks;
    for (const auto& [name, task] : references) tasks.push_back(task);
    return tasks;
  }

  TrialOutcome Reference(const Case& trial) const {
    const auto text =
        FinishedTask(request_.runner.folder, ReferenceTask(trial.method, trial.source));
    TrialOutcome outcome;
    if (text) outcome = ParseOutcome(*text);
    if (!outcome.IsUsable())
      throw InputError("the bag '" + request_.bag.path + "' cannot be evaluated with " +
                       ToString(trial.method) + ": " + outcome.reason);
    return outcome;
  }

  size_t Missing(const std::vector<Task>& tasks) const {
    return static_cast<size_t>(std::count_if(tasks.begin(), tasks.end(), [&](const Task& task) {
      return !FinishedTask(request_.runner.folder, task);
    }));
  }

  TrialOutcome Outcome(const Trial& trial) const {
    return ParseOutcome(FinishedTask(request_.runner.folder, ToTask(trial)).value());
  }

  /// The usable calibrations of a method, every pair of them, and each less the chained one.
  YAML::Node Compared(const Plan& plan, Method method) const {
    std::vector<std::pair<std::string, TrialOutcome>> usable;
    for (const Trial& trial : plan.trials) {
      const TrialOutcome outcome = Outcome(trial);
      if (trial.what.method != method || !outcome.IsUsable()) continue;
      const std::vector<std::string> labels = Cells(plan.experiment)[trial.cell].labels;
      usable.emplace_back(
          labels.empty() ? Format("recording %u", trial.what.index) : boost::join(labels, ", "),
          outcome);
    }
    YAML::Node node;
    for (size_t a = 0; a < usable.size(); ++a) {
      const auto& [name, outcome] = usable[a];
      node["results"].push_back(Describe(name, outcome));
      for (size_t b = a + 1; b < usable.size(); ++b)
        node["pairs"].push_back(
            Describe(usable[b].first + " less " + name,
                     Compare(outcome, usable[b].second,
                             {ComparedQuantity::kTranslation, ComparedQuantity::kRotation,
                              ComparedQuantity::kAccelDelay})));
      if (chained_ && plan.base == Base::kBag)
        node["chain"].push_back(Describe(name, Compare(*chained_, outcome, kTransform)));
    }
    return node;
  }

  void WriteTables() const {
    static const CalibrationOptions kBounds;
    YAML::Node input;
    input["version"] = kVersion;
    input["trials"] = request_.trials;
    input["bag"] = std::filesystem::path(request_.bag.path).filename().string();
    input["start"] = Format("%g", request_.bag.start_s);
    input["used"] = request_.bag.duration_s > 0.0 ? Format("%g s", request_.bag.duration_s) : "all";
    input["within"] = YamlList(Eigen::Vector3d(
        kBounds.weak_rotation_std, kBounds.weak_translation_std, kBounds.weak_time_shift_std));
    std::string rows;
    for (size_t p = 0; p < plans_.size(); ++p) {
      const Plan& plan = plans_[p];
      YAML::Node node;
      node["name"] = plan.experiment.name;
      node["title"] = plan.experiment.title;
      node["base"] = ToString(plan.base);
      for (const Axis& axis : plan.experiment.axes) node["axes"].push_back(axis.name);
      for (const Cell& cell : Cells(plan.experiment)) node["cells"].push_back(cell.labels);
      for (const Method method : {Method::kGp, Method::kJoint})
        if (plan.experiment.is_compared)
          node["compared"][ToString(method)] = Compared(plan, method);
      for (const Trial& trial : plan.trials) {
        const TrialOutcome outcome = Outcome(trial);
        rows +=
            CsvRow(p, trial, outcome, plan.HasReference() ? Reference(trial.what) : outcome.truth);
      }
      input["plans"].push_back(node);
    }
    const std::string& folder = request_.runner.folder;
    MakeTables(input, rows, folder);
    RunScriptOrThrow("evaluation_figures.py", {folder}, folder + "/figures.log",
                     "the figures cannot be drawn");
  }

  const EvaluationRequest& request_;
  std::vector<Plan> plans_;
  std::optional<Comparable> chained_;
  mutable std::map<std::string, SessionData> bags_;
};

}  // namespace

std::string Evaluate(const EvaluationRequest& request) {
  std::error_code error;
  std::filesystem::create_directories(request.runner.folder, error);
  if (error)
    throw InputError("--out '" + request.runner.folder + "' cannot be made: " + error.message());
  return Evaluation(request).Run();
}

}  // namespace imu_pose_calib
