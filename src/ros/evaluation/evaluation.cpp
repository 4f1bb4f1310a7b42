#include "imu_pose_calib/ros/evaluation/evaluation.h"

#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <filesystem>
#include <map>
#include <optional>

#include "imu_pose_calib/ros/evaluation/experiments.h"
#include "imu_pose_calib/ros/evaluation/tables.h"
#include "imu_pose_calib/ros/io/bag_reader.h"
#include "imu_pose_calib/ros/io/child_process.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/transform_file.h"
#include "imu_pose_calib/ros/io/yaml_file.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

constexpr int kParts = 3;             // of a bag that is compared with itself
constexpr double kPartDuration = 25;  // [s]

/// The trials of one cell.
struct CellTrials {
  std::vector<std::string> labels;
  std::vector<Trial> gp, joint;
};

/// An experiment on one base.
struct Plan {
  Experiment experiment;
  Base base;
  std::vector<CellTrials> cells;
};

class Evaluation {
 public:
  explicit Evaluation(const EvaluationRequest& request) : request_(request) {
    for (const Experiment& experiment : Chosen())
      for (const Base base : experiment.bases)
        if (std::count(request.bases.begin(), request.bases.end(), base) > 0)
          plans_.push_back(MakePlan(experiment, base));
    if (plans_.empty())
      throw InputError("none of the experiments runs on a bag; leave out --bag or add --simulate");
    if (!request.chain.empty()) {
      if (request.chain.size() != 2)
        throw InputError("--chain takes two transforms: T_marker_camera and T_camera_imu");
      chained_T_MI_ =
          ReadTransform("--chain", request.chain[0]) * ReadTransform("--chain", request.chain[1]);
    }
  }

  std::string Run() {
    const std::vector<Task> references = References(), tasks = Tasks();
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
    return WriteTables();
  }

 private:
  std::vector<Experiment> Chosen() const {
    std::vector<Experiment> all = Experiments();
    if (request_.experiments.empty()) return all;
    std::vector<std::string> names;
    for (const Experiment& experiment : all) names.push_back(experiment.name);
    std::vector<Experiment> chosen;
    for (const std::string& name : request_.experiments) {
      const auto found = std::find(names.begin(), names.end(), name);
      if (found == names.end())
        throw InputError("there is no experiment '" + name + "'" + DidYouMean(name, names) +
                         " There are: " + boost::join(names, ", "));
      chosen.push_back(all[static_cast<size_t>(found - names.begin())]);
    }
    return chosen;
  }

  /// What is compared with each other: the bags of the rig, or parts of one.
  Axis Recordings() const {
    std::vector<Source> sources;
    for (const std::string& path : request_.rig) sources.push_back({path});
    for (int i = 0; i < kParts && request_.rig.empty(); ++i)
      sources.push_back({request_.bag.path, kPartDuration * i, kPartDuration});
    Axis axis{"recording", {}, [sources](double value, Case* trial) {
                trial->source = sources[static_cast<size_t>(value)];
              }};
    for (size_t i = 0; i < sources.size(); ++i) {
      const Source& source = sources[i];
      const std::string name = std::filesystem::path(source.path).stem();
      axis.values.push_back({request_.rig.empty()
                                 ? Format("%s %g-%g s", name.c_str(), source.start_s,
                                          source.start_s + source.duration_s)
                                 : name,
                             static_cast<double>(i)});
    }
    return axis;
  }

  Plan MakePlan(const Experiment& experiment, Base base) const {
    Plan plan{experiment, base, {}};
    Source source = request_.bag;
    const double enough = experiment.base.source.duration_s;
    if (enough > 0.0 && (source.duration_s == 0.0 || source.duration_s > enough))
      source.duration_s = enough;
    plan.experiment.base.source = source;
    if (experiment.is_compared && base == Base::kBag) plan.experiment.axes = {Recordings()};
    for (const Cell& cell : Cells(plan.experiment))
      plan.cells.push_back({cell.labels,
                            Trials(plan.experiment, cell, base, Method::kGp, request_.trials),
                            Trials(plan.experiment, cell, base, Method::kJoint, request_.trials)});
    return plan;
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

  /// The bag of a trial as it is.
  Task ReferenceTask(Method method, const Source& source) const {
    Trial trial;
    trial.name = Format("reference/sample/duration_%g/%s", source.duration_s, ToString(method));
    trial.what.base = Base::kBag;
    trial.what.method = method;
    trial.what.source = source;
    return ToTask(trial);
  }

  std::vector<Task> References() const {
    std::map<std::string, Task> references;
    for (const Plan& plan : plans_) {
      if (plan.base != Base::kBag || plan.experiment.is_compared) continue;
      for (const Method method : {Method::kGp, Method::kJoint}) {
        const Task task = ReferenceTask(method, plan.experiment.base.source);
        references.emplace(task.name, task);
      }
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

  std::vector<Task> Tasks() const {
    std::vector<Task> tasks;
    for (const Plan& plan : plans_)
      for (const auto method : {&CellTrials::gp, &CellTrials::joint})
        for (const CellTrials& cell : plan.cells)
          for (const Trial& trial : cell.*method) tasks.push_back(ToTask(trial));
    return tasks;
  }

  size_t Missing(const std::vector<Task>& tasks) const {
    return static_cast<size_t>(std::count_if(tasks.begin(), tasks.end(), [&](const Task& task) {
      return !FinishedTask(request_.runner.folder, task);
    }));
  }

  void ReadBags() const {
    for (const Plan& plan : plans_)
      if (plan.base == Base::kBag)
        for (const CellTrials& cell : plan.cells)
          for (const Trial& trial : cell.joint) Bag(trial.what.source);
  }

  /// What trials of a plan came to, with errors against the truth or the reference.
  CellOutcomes Load(const Plan& plan, const std::vector<Trial>& trials) const {
    CellOutcomes cell;
    for (const Trial& trial : trials) {
      const TrialOutcome outcome =
          ParseOutcome(FinishedTask(request_.runner.folder, ToTask(trial)).value());
      if (plan.base == Base::kBag && !plan.experiment.is_compared) {
        const TrialOutcome truth = Reference(trial.what);
        cell.errors.push_back(ErrorsOf(outcome, truth.T_MI, truth.time_shift, truth.accel_delay));
      } else {
        cell.errors.push_back(ErrorsOf(outcome, outcome.true_T_MI, outcome.true_time_shift,
                                       outcome.true_accel_delay));
      }
      cell.outcomes.push_back(outcome);
    }
    return cell;
  }

  std::string Introduction() const {
    std::string text = Format(
        "# Evaluation of imu_pose_calib %s\n\n"
        "Root mean squares of the errors over the usable trials; %zu trials a cell in the tables "
        "of the paper. `gp` is the method of the paper, `joint` the default.\n\n",
        kVersion, request_.trials);
    const auto has = [&](Base base) {
      return std::any_of(plans_.begin(), plans_.end(),
                         [base](const Plan& plan) { return plan.base == base; });
    };
    const std::string used =
        request_.bag.duration_s > 0.0 ? Format("%g s", request_.bag.duration_s) : "all";
    if (has(Base::kBag))
      text += Format(
          "**sample**: %s, %s from %g s on. Noise is added to what was recorded, and errors are "
          "those against what the same method says of the recording as it is, as in the paper.\n\n",
          std::filesystem::path(request_.bag.path).filename().c_str(), used.c_str(),
          request_.bag.start_s);
    if (has(Base::kSimulation))
      text +=
          "**simulation**: errors are those against the truth, another motion in every trial; "
          "recordings of 40 s in the tables of the paper, of 20 s where nothing else is said. "
          "*bound* is the Cramér-Rao bound for what `joint` estimates, of which it knows as much "
          "as its priors say; cells.csv also has it with all else known (*least*). chi² is the "
          "error squared by the covariance that is reported, over its 8 degrees of freedom, *of "
          "the model* by that of independent residuals; *band* holds 95 % of such means when the "
          "sigmas are right.\n\n";
    return text +
           "*Within bounds*: usable, and less than 10 mm, 0.01 rad and 2 ms off. Time and memory: "
           "usage.md.\n\n";
  }

  std::string WriteTables() const {
    const std::filesystem::path folder = request_.runner.folder;
    std::string text = Introduction(), cells, trials;
    for (const Plan& plan : plans_) {
      Results results{&plan.experiment, plan.base, {}};
      for (const auto& [labels, gp, joint] : plan.cells)
        results.cells.push_back({labels, Load(plan, gp), Load(plan, joint)});
      text +=
          plan.experiment.is_compared ? ComparedSection(results, chained_T_MI_) : Section(results);
      if (plan.experiment.is_compared) continue;
      trials += TrialsCsv(results, trials.empty());
      cells += CellsCsv(results, cells.empty());
    }
    WriteFile(folder / "evaluation.md", text);
    WriteFile(folder / "cells.csv", cells);
    WriteFile(folder / "trials.csv", trials);
    WriteFile(folder / "usage.md", UsageTable());
    Draw();
    return "tables and figures are in '" + request_.runner.folder + "': evaluation.md\n";
  }

  /// Median and largest of each experiment, base and method.
  std::string UsageTable() const {
    const std::map<std::string, Usage> used = LoadUsage(request_.runner.folder);
    std::string text =
        "# Time and memory\n\nMedians over the trials; their recording is simulated or has its "
        "noise added in the same process, which takes a part of it.\n\n"
        "| experiment | base | cell | method | time [s] | processor [s] | memory, most [MB] |\n"
        "|---|---|---|---|---|---|---|\n";
    double all = 0.0;
    for (const Plan& plan : plans_) {
      for (const CellTrials& cell : plan.cells) {
        for (const auto* trials : {&cell.gp, &cell.joint}) {
          std::vector<double> wall, cpu, memory;
          for (const Trial& trial : *trials) {
            const auto found = used.find(trial.name);
            if (found == used.end()) continue;
            wall.push_back(found->second.wall_s);
            cpu.push_back(found->second.cpu_s);
            memory.push_back(found->second.memory_mb);
            all += found->second.cpu_s;
          }
          if (wall.empty()) continue;
          const auto median = [](std::vector<double>* values) {
            std::sort(values->begin(), values->end());
            return (*values)[values->size() / 2];
          };
          text +=
              Format("| %s | %s | %s | %s | %.2f | %.2f | %.0f |\n", plan.experiment.name.c_str(),
                     ToString(plan.base), boost::join(cell.labels, ", ").c_str(),
                     trials == &cell.gp ? "gp" : "joint", median(&wall), median(&cpu),
                     *std::max_element(memory.begin(), memory.end()));
        }
      }
    }
    return text + Format("\nAll trials: %.0f min of a processor.\n", all / 60.0);
  }

  void Draw() const {
    const std::filesystem::path script =
        std::filesystem::read_symlink("/proc/self/exe").parent_path() / "evaluation_figures.py";
    const std::string errors = request_.runner.folder + "/figures.log";
    if (!std::filesystem::exists(script))
      throw InputError("the figures cannot be drawn: there is no " + script.string());
    if (RunProgram({script, request_.runner.folder}, errors) != 0)
      throw InputError("the figures cannot be drawn; see '" + errors + "'");
    std::filesystem::remove(errors);
  }

  const EvaluationRequest& request_;
  std::vector<Plan> plans_;
  std::optional<Rigid3> chained_T_MI_;
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
