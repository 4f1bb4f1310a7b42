#pragma once

#include <functional>
#include <string>
#include <vector>

#include "imu_pose_calib/ros/evaluation/trial.h"

namespace imu_pose_calib {

/// What changes from cell to cell of a table.
struct Axis {
  struct Value {
    std::string label;
    double value;
  };
  std::string name;  ///< with unit
  std::vector<Value> values;
  std::function<void(double value, Case* trial)> set;
};

/// Trials on a grid, each with both methods.
struct Experiment {
  std::string name;             ///< of files
  std::string title;            ///< of its tables and figure
  size_t trials_of_30;          ///< of a cell, when 30 are asked for
  Case base;                    ///< that the axes change
  std::vector<Axis> axes = {};  ///< none: a single cell
  std::vector<Base> bases = {Base::kBag, Base::kSimulation};
  bool is_compared = false;  ///< with each other, not with a truth: repeatability
};

/// All of them, in the order in which they are shown.
std::vector<Experiment> Experiments();

/// A cell of an experiment.
struct Cell {
  std::vector<std::string> labels;  ///< of each axis
  std::string name;                 ///< for files: "accel_0.01,gyro_0.001"
  Case what;
};
std::vector<Cell> Cells(const Experiment& experiment);

/// One recording: which case runs under which name.
struct Trial {
  std::string name;
  size_t cell;
  Case what;
};

/// The trials of an experiment when `trials` are asked for, by method and cell.
std::vector<Trial> Trials(const Experiment& experiment, Base base, size_t trials);

}  // namespace imu_pose_calib
