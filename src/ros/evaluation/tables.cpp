#include "imu_pose_calib/ros/evaluation/tables.h"

#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <cmath>
#include <functional>
#include <iterator>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/verdict/comparison.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

constexpr int kDof = 8;  // of TrialOutcome::chi2
constexpr double kDegrees = 180.0 / M_PI;

/// The methods in the order of the tables.
struct MethodOf {
  const char* name;
  CellOutcomes CellResults::*outcomes;
};
constexpr MethodOf kMethods[] = {{"gp", &CellResults::gp}, {"joint", &CellResults::joint}};

using Row = std::vector<std::string>;

std::string MarkdownRow(const Row& row) { return "| " + boost::join(row, " | ") + " |\n"; }

std::string MarkdownTable(const Row& header, const std::vector<Row>& rows) {
  std::string text = MarkdownRow(header) + "|";
  for (size_t i = 0; i < header.size(); ++i) text += "---|";
  text += "\n";
  for (const Row& row : rows) text += MarkdownRow(row);
  return text + "\n";
}

/// Three digits that count; nothing for nothing.
std::string Number(double value) {
  if (!std::isfinite(value) || value == 0.0) return "";
  const int digits = std::max(0, 2 - static_cast<int>(std::floor(std::log10(std::abs(value)))));
  return Format("%.*f", std::min(digits, 6), value);
}

std::string Ratio(double value, double by) {
  return by > 0.0 && value > 0.0 ? Format("%.2f", value / by) : "";
}

/// How one quantity is shown.
struct Shown {
  const char* name;
  double ErrorNorms::*norm;
  double factor;
  double Printed::*printed;  ///< null: the paper has none
};
constexpr Shown kShown[] = {{"rotation [deg]", &ErrorNorms::rotation, kDegrees, &Printed::rotation},
                            {"position [mm]", &ErrorNorms::translation, 1e3, &Printed::translation},
                            {"time shift [ms]", &ErrorNorms::time_shift, 1e3, nullptr},
                            {"accel delay [ms]", &ErrorNorms::accel_delay, 1e3, nullptr}};

/// What follows the labels of a cell in a row of a table: names of the columns and texts.
using Columns = std::vector<std::pair<std::string, std::string>>;

/// A table with a row for each cell, made by `columns(number of the cell, gp, joint)`.
template <typename MakeColumns>
std::string CellTable(const Results& results, MakeColumns columns) {
  Row header;
  for (const Axis& axis : results.experiment->axes) header.push_back(axis.name);
  std::vector<Row> rows;
  for (size_t c = 0; c < results.cells.size(); ++c) {
    const auto& [labels, gp, joint] = results.cells[c];
    rows.push_back(labels);
    for (const auto& [name, text] : columns(c, Summarize(gp), Summarize(joint))) {
      if (c == 0) header.push_back(name);
      rows.back().push_back(text);
    }
  }
  return MarkdownTable(header, rows);
}

/// A table of two quantities: errors of both methods, beside what they are measured by.
std::string ErrorTable(const Results& results, const Shown& first, const Shown& second) {
  const std::vector<Printed>& printed = results.experiment->printed;
  return CellTable(results, [&](size_t c, const CellSummary& gp, const CellSummary& joint) {
    Columns all;
    for (const Shown& shown : {first, second}) {
      const auto number = [&](const ErrorNorms& norms) {
        return Number(norms.*shown.norm * shown.factor);
      };
      Columns own = {{"gp", number(gp.error)}, {"joint", number(joint.error)}};
      if (shown.printed != nullptr && !printed.empty())
        own.insert(own.begin(), {"paper", Format("%g", printed[c].*shown.printed)});
      if (results.base == Base::kSimulation) {
        own.emplace_back("bound", number(joint.bound));
        own.emplace_back("joint / bound", Ratio(joint.error.*shown.norm, joint.bound.*shown.norm));
      } else {
        own.emplace_back("sigma of joint", number(joint.sigma));
      }
      own[0].first = shown.name + (": " + own[0].first);
      all.insert(all.end(), own.begin(), own.end());
    }
    return all;
  });
}

std::string Share(size_t count, size_t of) { return Format("%zu/%zu", count, of); }

/// How many were right, and how honest the sigmas are.
std::string CountTable(const Results& results) {
  return CellTable(results, [&](size_t, const CellSummary& gp, const CellSummary& joint) {
    Columns columns = {{"gp: usable", Share(gp.usable, gp.trials)},
                       {"joint: usable", Share(joint.usable, joint.trials)},
                       {"gp: within bounds", Share(gp.successes, gp.trials)},
                       {"joint: within bounds", Share(joint.successes, joint.trials)}};
    if (results.base != Base::kSimulation) return columns;
    const auto [low, high] = ChiSquareBand(kDof * static_cast<double>(joint.usable));
    columns.emplace_back("gp: chi²/dof", Number(gp.chi2));
    columns.emplace_back("joint: chi²/dof", Number(joint.chi2));
    columns.emplace_back("joint: of the model", Number(joint.model_chi2));
    columns.emplace_back("band", joint.usable == 0 ? "" : Format("%.2f-%.2f", low, high));
    return columns;
  });
}

/// Why trials were not usable, each reason once.
std::string Refusals(const Results& results) {
  std::string text;
  for (const CellResults& cell : results.cells) {
    for (const auto& [method, member] : kMethods) {
      const std::vector<TrialOutcome>& outcomes = (cell.*member).outcomes;
      const auto first =
          std::find_if_not(outcomes.begin(), outcomes.end(), std::mem_fn(&TrialOutcome::IsUsable));
      if (first == outcomes.end()) continue;
      text +=
          Format("- %s, %s: %s: %s\n", boost::join(cell.labels, ", ").c_str(), method,
                 first->verdict.c_str(), first->reason.substr(0, first->reason.find('\n')).c_str());
    }
  }
  return text.empty() ? "" : "The first that was not usable of each:\n\n" + text + "\n";
}

std::string Heading(const Results& results) {
  const Experiment& experiment = *results.experiment;
  std::string text = "## " + experiment.title + ", " + ToString(results.base) + "\n\n";
  if (!experiment.remark.empty()) text += experiment.remark + "\n\n";
  return text;
}

Row DifferenceRow(const std::string& name, const Comparison& comparison) {
  const Difference* worst = comparison.Worst();
  return {name, Number(comparison.angle * kDegrees), Number(comparison.distance * 1e3),
          comparison.dof > 0 ? Format("%.1f / %d", comparison.chi2, comparison.dof) : "",
          worst == nullptr ? ""
                           : Format("%s %c, %.1f", ToString(worst->quantity), "xyz"[worst->axis],
                                    worst -> sigmas)};
}

/// A usable calibration of a recording.
struct Named {
  std::string name;
  TrialOutcome outcome;
};

std::vector<Named> Usable(const Results& results, CellOutcomes CellResults::*method) {
  std::vector<Named> usable;
  for (const CellResults& cell : results.cells) {
    size_t number = 0;
    for (const TrialOutcome& outcome : (cell.*method).outcomes) {
      ++number;
      if (outcome.IsUsable())
        usable.push_back(
            {cell.labels.empty() ? Format("recording %zu", number) : boost::join(cell.labels, ", "),
             outcome});
    }
  }
  return usable;
}

std::string ResultTable(const std::vector<Named>& calibrations) {
  std::vector<Row> rows;
  for (const auto& [name, o] : calibrations) {
    const Vector6d std = o.covariance.diagonal().cwiseSqrt();
    rows.push_back({name, List(1e3 * o.T_MI.p, "%.3f"), List(1e3 * std.head<3>(), "%.3f"),
                    List(kDegrees * Log(o.T_MI.q), "%.4f"), List(kDegrees * std.tail<3>(), "%.4f"),
                    Format("%.4f ± %.4f", 1e3 * o.accel_delay, 1e3 * o.accel_delay_std),
                    o.verdict});
  }
  return MarkdownTable({"recording", "p [mm]", "sigma", "R as a rotation vector [deg]", "sigma",
                        "accel delay [ms]", "verdict"},
                       rows);
}

std::string DifferenceTable(const char* what, const std::vector<Row>& rows) {
  return MarkdownTable({what, "rotation [deg]", "position [mm]", "chi² / dof", "largest, in sigma"},
                       rows);
}

std::string PairTable(const std::vector<Named>& calibrations) {
  std::vector<Row> rows;
  for (auto a = calibrations.begin(); a != calibrations.end(); ++a)
    for (auto b = std::next(a); b != calibrations.end(); ++b)
      rows.push_back(
          DifferenceRow(b->name + " less " + a->name,
                        Compare(a->outcome, b->outcome,
                                {ComparedQuantity::kTranslation, ComparedQuantity::kRotation,
                                 ComparedQuantity::kAccelDelay})));
  return DifferenceTable("pair", rows);
}

std::string ChainTable(const std::vector<Named>& calibrations, const Rigid3& chained_T_MI) {
  Comparable chain;
  chain.T_MI = chained_T_MI;
  std::vector<Row> rows;
  for (const auto& [name, outcome] : calibrations)
    rows.push_back(DifferenceRow(
        name,
        Compare(chain, outcome, {ComparedQuantity::kTranslation, ComparedQuantity::kRotation})));
  return "Less the chained calibration, which is taken as exact:\n\n" +
         DifferenceTable("recording", rows);
}

std::string Exact(double value) { return Format("%.9g", value); }

/// The columns by which rows of CSV files tell cells and methods.
Row CsvRow(const Results& results, const CellResults& cell, const char* method) {
  return {results.experiment->name, ToString(results.base),
          "\"" + boost::join(cell.labels, ";") + "\"", method};
}

void AppendExact(const ErrorNorms& norms, Row* row) {
  for (const Shown& shown : kShown) row->push_back(Exact(norms.*shown.norm * shown.factor));
}

}  // namespace

CellSummary Summarize(const CellOutcomes& cell) {
  static const CalibrationOptions kOptions;
  CellSummary sum;
  sum.trials = cell.outcomes.size();
  const auto add = [](const ErrorNorms& norms, ErrorNorms* squares) {
    for (const Shown& shown : kShown)
      squares->*shown.norm += norms.*shown.norm * (norms.*shown.norm);
  };
  for (size_t i = 0; i < sum.trials; ++i) {
    const TrialOutcome& outcome = cell.outcomes[i];
    if (!outcome.IsUsable()) continue;
    ++sum.usable;
    const ErrorNorms error = cell.errors[i].Norms();
    if (error.translation < kOptions.weak_translation_std &&
        error.rotation < kOptions.weak_rotation_std &&
        error.time_shift < kOptions.weak_time_shift_std)
      ++sum.successes;
    add(error, &sum.error);
    const Vector6d variance = outcome.covariance.diagonal();
    add({std::sqrt(variance.head<3>().sum()), std::sqrt(variance.tail<3>().sum()),
         outcome.time_shift_std, outcome.accel_delay_std},
        &sum.sigma);
    add(outcome.bounds.as_joint, &sum.bound);
    add(outcome.bounds.least, &sum.least);
    sum.chi2 += outcome.chi2 / kDof;
    sum.model_chi2 += outcome.model_chi2 / kDof;
  }
  if (sum.usable == 0) return sum;
  const auto n = static_cast<double>(sum.usable);
  for (ErrorNorms* squares : {&sum.error, &sum.sigma, &sum.bound, &sum.least})
    for (const Shown& shown : kShown) squares->*shown.norm = std::sqrt(squares->*shown.norm / n);
  sum.chi2 /= n;
  sum.model_chi2 /= n;
  return sum;
}

std::pair<double, double> ChiSquareBand(double dof) {
  // Wilson and Hilferty: the cube root is nearly normal.
  const double variance = 2.0 / (9.0 * dof);
  const auto quantile = [&](double z) {
    return std::pow(1.0 - variance + z * std::sqrt(variance), 3);
  };
  return {quantile(-1.959964), quantile(1.959964)};
}

std::string Section(const Results& results) {
  std::string text = Heading(results);
  if (!results.experiment->printed.empty())
    text += "The paper's figures are its " + results.experiment->printed_in +
            ", of another recording.\n\n";
  return text + ErrorTable(results, kShown[0], kShown[1]) +
         ErrorTable(results, kShown[2], kShown[3]) + CountTable(results) + Refusals(results) +
         Format("![%s](%s_%s.png)\n\n", results.experiment->title.c_str(),
                results.experiment->name.c_str(), ToString(results.base));
}

std::string ComparedSection(const Results& results, const std::optional<Rigid3>& chained_T_MI) {
  std::string text = Heading(results);
  for (const auto& [method, outcomes] : kMethods) {
    const std::vector<Named> usable = Usable(results, outcomes);
    text += Format("### %s\n\n", method) + ResultTable(usable) + PairTable(usable);
    if (chained_T_MI && results.base == Base::kBag) text += ChainTable(usable, *chained_T_MI);
  }
  return text + Refusals(results);
}

std::string CellsCsv(const Results& results, bool with_header) {
  std::string text;
  if (with_header)
    text =
        "experiment,base,cell,method,trials,usable,within_bounds,"
        "rotation_rmse_deg,position_rmse_mm,time_shift_rmse_ms,accel_delay_rmse_ms,"
        "rotation_sigma_deg,position_sigma_mm,time_shift_sigma_ms,accel_delay_sigma_ms,"
        "rotation_bound_deg,position_bound_mm,time_shift_bound_ms,accel_delay_bound_ms,"
        "rotation_least_deg,position_least_mm,time_shift_least_ms,accel_delay_least_ms,"
        "chi2_per_dof,model_chi2_per_dof,paper_rotation_deg,paper_position_mm\n";
  const std::vector<Printed>& printed = results.experiment->printed;
  for (size_t c = 0; c < results.cells.size(); ++c) {
    for (const auto& [method, outcomes] : kMethods) {
      const CellSummary sum = Summarize(results.cells[c].*outcomes);
      Row row = CsvRow(results, results.cells[c], method);
      for (const size_t count : {sum.trials, sum.usable, sum.successes})
        row.push_back(std::to_string(count));
      for (const ErrorNorms& norms : {sum.error, sum.sigma, sum.bound, sum.least})
        AppendExact(norms, &row);
      row.insert(row.end(), {Exact(sum.chi2), Exact(sum.model_chi2),
                             printed.empty() ? "" : Exact(printed[c].rotation),
                             printed.empty() ? "" : Exact(printed[c].translation)});
      text += boost::join(row, ",") + "\n";
    }
  }
  return text;
}

std::string TrialsCsv(const Results& results, bool with_header) {
  std::string text;
  if (with_header)
    text =
        "experiment,base,cell,method,trial,verdict,rotation_error_deg,position_error_mm,"
        "time_shift_error_ms,accel_delay_error_ms,chi2,model_chi2,guess_deg,guess_m\n";
  for (const CellResults& cell : results.cells) {
    for (const auto& [method, member] : kMethods) {
      const auto& [outcomes, errors] = cell.*member;
      for (size_t i = 0; i < outcomes.size(); ++i) {
        const TrialOutcome& o = outcomes[i];
        Row row = CsvRow(results, cell, method);
        row.insert(row.end(), {std::to_string(i + 1), o.verdict});
        AppendExact(o.IsUsable() ? errors[i].Norms() : ErrorNorms{NAN, NAN, NAN, NAN}, &row);
        for (const double value :
             {o.chi2, o.model_chi2, o.guess_angle * kDegrees, o.guess_distance})
          row.push_back(Exact(value));
        text += boost::join(row, ",") + "\n";
      }
    }
  }
  return text;
}

}  // namespace imu_pose_calib
