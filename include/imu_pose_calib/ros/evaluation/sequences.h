#pragma once

#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/ros/evaluation/task_runner.h"
#include "imu_pose_calib/ros/evaluation/trial.h"
#include "imu_pose_calib/ros/offline/offline.h"

namespace imu_pose_calib {

/// A recording of several that are calibrated, each alone.
struct Sequence {
  std::string name;   ///< also of its files
  std::string group;  ///< of one rig and one source of poses
  OfflineRequest request;
  std::optional<Rigid3> published_T_MI;
};

/// The *.bag of a folder and of the folders in it, and with a public `dataset`, "tum-vi", "euroc"
/// or "broad", its ASL datasets, each with all of its sources of poses. `common`: how to read and
/// calibrate each. Throws InputError when there are none, saying where to get them.
std::vector<Sequence> FindSequences(const std::string& dataset, const std::string& folder,
                                    const OfflineRequest& common);

/// Calibrates those that are not yet done, and writes into the folder of the runner a result file
/// of each, NAME.calibration.yaml, and the table sequences.md and sequences.csv; `title`: of the
/// table. With `is_dataset`, the sequences of a group are compared with each other and with what is
/// published, else a report is drawn of each.
struct SequencesOutcome {
  std::string text;                 ///< of the table
  std::vector<std::string> failed;  ///< names of those without a result
  size_t missing = 0;               ///< that other jobs have not run yet
};
SequencesOutcome RunSequences(const std::vector<Sequence>& sequences, const std::string& title,
                              bool is_dataset, const RunnerOptions& runner);

/// Of what a dataset is and where it comes from, for the table.
std::string DatasetTitle(const std::string& dataset);

}  // namespace imu_pose_calib
