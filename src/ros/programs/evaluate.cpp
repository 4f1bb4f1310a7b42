// Reruns the experiments of the paper and others.

#include <ros/init.h>
#include <ros/package.h>

#include <boost/algorithm/string/classification.hpp>
#include <boost/algorithm/string/join.hpp>
#include <boost/algorithm/string/replace.hpp>
#include <boost/algorithm/string/split.hpp>
#include <cstdio>
#include <iostream>
#include <regex>
#include <string>
#include <thread>
#include <vector>

#include "imu_pose_calib/ros/evaluation/evaluation.h"
#include "imu_pose_calib/ros/evaluation/experiments.h"
#include "imu_pose_calib/ros/evaluation/sequences.h"
#include "imu_pose_calib/ros/offline/command_line.h"

namespace imu_pose_calib {
namespace {

namespace po = boost::program_options;

struct CommandLine {
  EvaluationRequest request;
  OfflineRequest sequences;  ///< how each of a batch or a dataset is read and calibrated
  std::string experiments, job, batch, dataset, data;
  bool simulate = false, list = false, help = false;
  size_t print_jobs = 0;
};

po::options_description Describe(CommandLine* line) {
  EvaluationRequest& request = line->request;
  po::options_description options("Options");
  auto add = options.add_options();
  add("bag", Value(&request.bag.path), "recording to add noise to, no simulation; default: both");
  add("simulate", po::bool_switch(&line->simulate), "simulated recordings only; with --bag: both");
  add("start", Value(&request.bag.start_s, "S")->default_value(0), "seconds of the bag to skip");
  add("duration", Value(&request.bag.duration_s, "S")->default_value(40),
      "seconds of the bag to use; 0: all");
  add("experiments", Value(&line->experiments), "names with commas between; default: all");
  add("list", po::bool_switch(&line->list), "print the names of the experiments");
  add("trials", ValueOrDefault(&request.trials, "N"),
      "of each cell of the paper's tables; others have a part or a multiple of it");
  add("rig", Value(&request.rig)->multitoken(), "bags of one rig to compare with each other");
  add("chain", Value(&request.chain)->multitoken(),
      "T_marker_camera and T_camera_imu, to compare the rig with: \"x y z qx qy qz qw\" or files");
  add("batch", Value(&line->batch, "DIR"),
      "instead of experiments: calibrate every bag below DIR, with a report of each");
  add("dataset", Value(&line->dataset), "instead: a public dataset, tum-vi, euroc or broad");
  add("data", Value(&line->data, "DIR"), "where it is");
  add("imu-topic", Value(&line->sequences.bag.imu_topic), "of all bags of a batch or a dataset");
  add("pose-topic", Value(&line->sequences.bag.pose_topic), "the same");
  add("tf-parent", Value(&line->sequences.bag.tf_parent), "poses from tf: the fixed frame");
  add("tf-child", Value(&line->sequences.bag.tf_child), "poses from tf: the marker");
  add("config", Value(&line->sequences.config), "YAML of options, for a batch or a dataset");
  add("method", Value(&line->sequences.method), "joint (default) or gp, for a batch or a dataset");
  add("jobs", Value(&request.runner.jobs, "J"), "trials at a time; default: one per processor");
  add("out", Value(&request.runner.folder, "DIR")->default_value("evaluation"),
      "trials, tables and figures; what is there is not run again");
  add("print-jobs", Value(&line->print_jobs, "K"),
      "print K commands that share the trials, and run nothing");
  add("job", Value(&line->job), "I/K: only the I-th of K shares of the trials");
  add("merge", po::bool_switch(&request.is_merge), "tables only: all trials must be there");
  add("quiet", po::bool_switch(&request.runner.quiet), "print errors only");
  add("help", po::bool_switch(&line->help), "print this text");
  return options;
}

void Complete(CommandLine* line) {
  EvaluationRequest& request = line->request;
  request.bases = {Base::kBag, Base::kSimulation};
  const bool is_bag_given = !request.bag.path.empty() || !request.rig.empty();
  if (line->simulate && !is_bag_given) request.bases = {Base::kSimulation};
  if (is_bag_given && !line->simulate) request.bases = {Base::kBag};
  if (request.bag.path.empty())
    request.bag.path = ros::package::getPath("imu_pose_calib") + "/data/estimator_own_clocks.bag";
  if (!line->experiments.empty())
    boost::split(request.experiments, line->experiments, boost::is_any_of(","));
  if (request.trials < 1 || request.trials > 100000)
    throw InputError("--trials = " + std::to_string(request.trials) + " must be 1 to 100000");
  if (request.runner.jobs == 0)
    request.runner.jobs = static_cast<int>(std::max(1u, std::thread::hardware_concurrency()));
  if (request.runner.jobs < 1 || request.runner.jobs > 1000)
    throw InputError("--jobs = " + std::to_string(request.runner.jobs) + " must be 1 to 1000");
  request.runner.title = "trials";
  if (line->job.empty()) return;
  char rest = 0;
  size_t part = 0;
  if (std::sscanf(line->job.c_str(), "%zu/%zu%c", &part, &request.runner.parts, &rest) != 2 ||
      part < 1 || part > request.runner.parts)
    throw InputError("--job '" + line->job + "' must be I/K with I from 1 to K");
  request.runner.part = part - 1;
}

/// The same command for each share.
void PrintJobs(int argc, char** argv, size_t jobs) {
  for (size_t i = 1; i <= jobs; ++i) {
    for (int k = 0; k < argc; ++k) {
      const std::string word = argv[k];
      if (word == "--print-jobs") ++k;
      if (word.rfind("--print-jobs", 0) == 0) continue;
      static const std::regex kPlain("[A-Za-z0-9_./,=:-]+");
      if (std::regex_match(word, kPlain))
        std::cout << word << " ";
      else
        std::cout << "'" << boost::replace_all_copy(word, "'", "'\\''") << "' ";
    }
    std::cout << "--job " << i << "/" << jobs << "\n";
  }
}

/// A batch or a dataset.
void RunRecordings(const CommandLine& line) {
  const bool is_dataset = !line.dataset.empty();
  if (is_dataset && !line.batch.empty())
    throw InputError("--batch and --dataset do not go together");
  if (is_dataset && line.data.empty())
    throw InputError("--dataset needs --data DIR, the folder that it is in. " +
                     DatasetTitle(line.dataset));
  const std::vector<Sequence> sequences =
      FindSequences(line.dataset, is_dataset ? line.data : line.batch, line.sequences);
  RunnerOptions runner = line.request.runner;
  runner.title = "recordings";
  const SequencesOutcome outcome = RunSequences(
      sequences, is_dataset ? DatasetTitle(line.dataset) : "Calibration of " + line.batch,
      is_dataset, runner);
  if (!runner.quiet && outcome.missing > 0)
    std::cout << outcome.missing << " recordings of the other jobs are missing\n";
  if (!runner.quiet) std::cout << outcome.text;
  if (!outcome.failed.empty() && !is_dataset)
    throw DataError(std::to_string(outcome.failed.size()) + " of " +
                    std::to_string(sequences.size()) +
                    " bags have no calibration: " + boost::join(outcome.failed, ", "));
}

void Run(int argc, char** argv) {
  CommandLine line;
  line.request.runner.jobs = 0;
  const po::options_description options = Describe(&line);
  ParseCommandLine(argc, argv, options);
  if (line.help) {
    std::cout << "Usage: evaluate [options]\n\n"
              << "Reruns the experiments of the paper and others with both methods, on a recording "
                 "to\nwhich noise is added and on simulated ones. Can be interrupted at any time: "
                 "run it\nagain, and it goes on.\n\n"
              << options;
    return;
  }
  if (line.list) {
    for (const Experiment& experiment : Experiments())
      std::cout << experiment.name << ": " << experiment.title << "\n";
    return;
  }
  Complete(&line);
  if (line.print_jobs > 0) return PrintJobs(argc, argv, line.print_jobs);
  if (!line.batch.empty() || !line.dataset.empty()) return RunRecordings(line);
  const std::string done = Evaluate(line.request);
  if (!line.request.runner.quiet) std::cout << done;
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  // Without what roslaunch adds, __name and __log.
  ros::V_string words;
  ros::removeROSArgs(argc, argv, words);
  std::vector<char*> own;
  for (std::string& word : words) own.push_back(word.data());
  return imu_pose_calib::RunCommand(
      "evaluate", [&] { imu_pose_calib::Run(static_cast<int>(own.size()), own.data()); });
}
