#pragma once

#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "imu_pose_calib/ros/evaluation/experiments.h"

namespace imu_pose_calib {

/// Trials of one cell by one method.
struct CellOutcomes {
  std::vector<TrialOutcome> outcomes;
  std::vector<Errors> errors;  ///< of each; of those that are not usable without meaning
};

/// Trials of one cell by both methods.
struct CellResults {
  std::vector<std::string> labels;
  CellOutcomes gp, joint;
};

/// What came out of an experiment on one base.
struct Results {
  const Experiment* experiment;
  Base base;
  std::vector<CellResults> cells;
};

/// Root mean squares over the usable trials of a cell.
struct CellSummary {
  size_t trials = 0, usable = 0;
  size_t successes = 0;  ///< usable, with errors within the bounds of the verdict `ok`
  ErrorNorms error, sigma;
  ErrorNorms bound, least;              ///< 0: not known
  double chi2 = 0.0, model_chi2 = 0.0;  ///< mean, per degree of freedom
};
CellSummary Summarize(const CellOutcomes& cell);

/// The 2.5 and 97.5 % quantiles of chi-square over its degrees of freedom.
std::pair<double, double> ChiSquareBand(double dof);

/// Markdown: a section with the tables of one experiment on one base.
std::string Section(const Results& results);

/// One row for each cell and method; `with_header`: names of the columns first.
std::string CellsCsv(const Results& results, bool with_header);
/// One row for each trial.
std::string TrialsCsv(const Results& results, bool with_header);

/// Markdown: the section of an experiment whose recordings are compared with each other, and with
/// `chained_T_MI`, as of a chained calibration, if it is given.
std::string ComparedSection(const Results& results, const std::optional<Rigid3>& chained_T_MI);

}  // namespace imu_pose_calib
