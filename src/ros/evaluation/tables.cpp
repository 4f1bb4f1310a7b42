#include "imu_pose_calib/ros/evaluation/tables.h"

#include <filesystem>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/ros/io/child_process.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/offline/comparison_report.h"
#include "imu_pose_calib/ros/offline/report.h"

namespace imu_pose_calib {

YAML::Node Describe(const std::string& name, const TrialOutcome& outcome) {
  YAML::Node node = Describe(outcome);
  node["name"] = name;
  node["verdict"] = outcome.verdict;
  node["reason"] = outcome.reason;
  node["warnings"] = outcome.warnings;
  node["rotation_vector"] = YamlList(Log(outcome.T_MI.q));
  node["std"] = YamlList(outcome.covariance.diagonal().cwiseSqrt());
  return node;
}

YAML::Node Describe(const std::string& name, const Comparison& comparison) {
  YAML::Node node = Describe(comparison);
  node["name"] = name;
  return node;
}

void RunScriptOrThrow(const std::string& script, const std::vector<std::string>& arguments,
                      const std::string& log, const std::string& failure) {
  if (!RunScript(script, arguments, log, failure))
    throw InputError(failure + "; see '" + log + "'");
  std::filesystem::remove(log);
}

void MakeTables(const YAML::Node& input, const std::string& trials, const std::string& folder) {
  const TemporaryFolder given;
  WriteYaml(input, given.path() / "input.yaml");
  WriteFile(given.path() / "trials.csv", trials);
  RunScriptOrThrow("evaluation_tables.py", {given.path(), folder}, folder + "/tables.log",
                   "the tables cannot be made");
}

}  // namespace imu_pose_calib
