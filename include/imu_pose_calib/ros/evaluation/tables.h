#pragma once

#include <yaml-cpp/yaml.h>

#include <string>
#include <vector>

#include "imu_pose_calib/core/verdict/comparison.h"
#include "imu_pose_calib/ros/evaluation/trial.h"

namespace imu_pose_calib {

/// A calibration and a comparison as scripts/evaluation_tables.py takes them.
YAML::Node Describe(const std::string& name, const TrialOutcome& outcome);
YAML::Node Describe(const std::string& name, const Comparison& comparison);

/// Has scripts/evaluation_tables.py write its tables into a folder. `input`: what they are of;
/// `trials`: rows of numbers of each trial of an evaluation.
void MakeTables(const YAML::Node& input, const std::string& trials, const std::string& folder);

/// RunScript(), also throwing when it fails; its errors are then in the file `log`.
void RunScriptOrThrow(const std::string& script, const std::vector<std::string>& arguments,
                      const std::string& log, const std::string& failure);

}  // namespace imu_pose_calib
