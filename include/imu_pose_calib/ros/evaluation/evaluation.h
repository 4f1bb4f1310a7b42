#pragma once

#include <string>
#include <vector>

#include "imu_pose_calib/ros/evaluation/task_runner.h"
#include "imu_pose_calib/ros/evaluation/trial.h"

namespace imu_pose_calib {

/// The paper's experiments and others.
struct EvaluationRequest {
  Source bag;                            ///< to add noise to
  std::vector<Base> bases;               ///< on which to run
  std::vector<std::string> experiments;  ///< names; none: all
  size_t trials = 30;                    ///< of each cell of the paper's tables
  std::vector<std::string> rig;          ///< bags of one rig to compare; none: parts of `bag`
  /// Transforms T_marker_camera and T_camera_imu of a chained calibration, see ReadTransform().
  std::vector<std::string> chain;
  RunnerOptions runner;
  bool is_merge = false;  ///< all trials have run
};

/// Runs the trials that are missing, and, as soon as those of all parts are there, has the scripts
/// write into the folder: evaluation.md, cells.csv, trials.csv and figures, which follow from the
/// trials alone, and usage.md, the time and memory that they took. Returns the text that says what
/// was done. Throws InputError when something cannot be used as given, when merged trials are
/// missing, or when a script fails.
std::string Evaluate(const EvaluationRequest& request);

}  // namespace imu_pose_calib
