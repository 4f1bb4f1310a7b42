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

/// Figures of the paper for a cell.
struct Printed {
  double rotation, translation;  ///< [deg], [mm]
};

/// Trials on a grid, each with both methods.
struct Experiment {
  std::string name;              ///< of files
  std::string title;             ///< of its tables and figure
  std::string remark;            ///< below the title
  std::string printed_in;        ///< tables of the paper; empty: it has none
  std::vector<Printed> printed;  ///< of the cells in order, the last axis fastest
  std::vector<Base> bases;
  std::vector<Axis> axes;                                  ///< none: a single cell
  std::function<size_t(size_t trials, Base base)> trials;  ///< of a cell, for `trials` asked for
  bool is_compared = false;  ///< with each other, not with a truth: repeatability
  Case base;                 ///< that the axes change
};

/// All of them, in the order in which they are shown.
std::vector<Experiment> Experiments();

/// A cell of an experiment.
struct Cell {
  std::vector<std::string> labels;  ///< of each axis
  std::string name;                 ///< for files: "accel_0.01,gyro_0.001"
  std::function<void(Case*)> set;
};
std::vector<Cell> Cells(const Experiment& experiment);

/// One recording: which case runs under which name.
struct Trial {
  std::string name;
  Case what;
};

/// The trials of a cell.
std::vector<Trial> Trials(const Experiment& experiment, const Cell& cell, Base base, Method method,
                          size_t trials);

}  // namespace imu_pose_calib
