#include "imu_pose_calib/ros/evaluation/tables.h"

#include <boost/algorithm/string/join.hpp>
#include <cmath>

#include "imu_pose_calib/core/comparison.h"
#include "imu_pose_calib/core/so3.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

constexpr int kDof = 8;  // of TrialOutcome::chi2
constexpr double kDegrees = 180.0 / M_PI;

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

constexpr Shown kRotationShown = {"rotation [deg]",
                                  &ErrorNorms::rotation,
                                  kDegrees,
                                  &Printed::rotation};
constexpr Shown kTranslationShown = {"position [mm]",
                                     &ErrorNorms::translation,
                                     1e3,
                                     &Printed::translation};
constexpr Shown kShiftShown = {"time shift [ms]", &ErrorNorms::time_shift, 1e3, nullptr};
constexpr Shown kDelayShown = {"accel delay [ms]", &ErrorNorms::accel_delay, 1e3, nullptr};

/// A table of two quantities: errors of both methods, beside what they are measured by.
std::string ErrorTable(const Results& results, const Shown& first, const Shown& second) {
  const Experiment& experiment = *results.experiment;
  const bool has_bound = results.base == Base::kSimulation;
  Row header;
  for (const Axis& axis : experiment.axes) header.push_back(axis.name);
  for (const Shown& shown : {first, second}) {
    header.push_back(shown.name);
    if (shown.printed != nullptr && !experiment.printed.empty())
      header.back() += ": paper";
    else
      header.back() += ": gp";
    if (shown.printed != nullptr && !experiment.printed.empty()) header.emplace_back("gp");
    header.emplace_back("joint");
    if (has_bound) {
      header.emplace_back("bound");
      header.emplace_back("joint / bound");
    } else {
      header.emplace_back("sigma of joint");
    }
  }
  std::vector<Row> rows;
  for (size_t c = 0; c < results.cells.size(); ++c) {
    Row row = results.cells[c].labels;
    const CellSummary gp = Summarize(results.gp[c]), joint = Summarize(results.joint[c]);
    for (const Shown& shown : {first, second}) {
      if (shown.printed != nullptr && !experiment.printed.empty())
        row.push_back(Format("%g", experiment.printed[c].*shown.printed));
      const auto number = [&](const ErrorNorms& norms) {
        return Number(norms.*shown.norm * shown.factor);
      };
      row.push_back(number(gp.error));
      row.push_back(number(joint.error));
      row.push_back(number(has_bound ? joint.bound : joint.sigma));
      if (has_bound) row.push_back(Ratio(joint.error.*shown.norm, joint.bound.*shown.norm));
    }
    rows.push_back(row);
  }
  return MarkdownTable(header, rows);
}

std::string Share(size_t count, size_t of) { return Format("%zu/%zu", count, of); }

/// How many were right, and how honest the sigmas are.
std::string CountTable(const Results& results) {
  Row header;
  for (const Axis& axis : results.experiment->axes) header.push_back(axis.name);
  header.insert(header.end(),
                {"gp: usable", "joint: usable", "gp: within bounds", "joint: within bounds"});
  const bool has_chi2 = results.base == Base::kSimulation;
  if (has_chi2)
    header.insert(header.end(), {"gp: chi²/dof", "joint: chi²/dof", "joint: of the model", "band"});
  std::vector<Row> rows;
  for (size_t c = 0; c < results.cells.size(); ++c) {
    Row row = results.cells[c].labels;
    const CellSummary gp = Summarize(results.gp[c]), joint = Summarize(results.joint[c]);
    row.push_back(Share(gp.usable, gp.trials));
    row.push_back(Share(joint.usable, joint.trials));
    row.push_back(Share(gp.successes, gp.trials));
    row.push_back(Share(joint.successes, joint.trials));
    if (has_chi2) {
      const auto [low, high] = ChiSquareBand(kDof * static_cast<double>(joint.usable));
      row.push_back(Number(gp.chi2));
      row.push_back(Number(joint.chi2));
      row.push_back(Number(joint.model_chi2));
      row.push_back(joint.usable == 0 ? "" : Format("%.2f-%.2f", low, high));
    }
    rows.push_back(row);
  }
  return MarkdownTable(header, rows);
}

/// Why trials were not usable, each reason once.
std::string Refusals(const Results& results) {
  std::string text;
  for (size_t c = 0; c < results.cells.size(); ++c) {
    for (const auto* method : {&results.gp[c], &results.joint[c]}) {
      for (const TrialOutcome& outcome : method->outcomes) {
        if (outcome.IsUsable()) continue;
        text += Format("- %s, %s: %s: %s\n",
                       boost::join(results.cells[c].labels, ", ").c_str(),
                       method == &results.gp[c] ? "gp" : "joint",
                       outcome.verdict.c_str(),
                       outcome.reason.substr(0, outcome.reason.find('\n')).c_str());
        break;
      }
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

Comparable ToComparable(const TrialOutcome& outcome) {
  Comparable comparable;
  comparable.T_MI = outcome.T_MI;
  comparable.covariance = outcome.covariance;
  comparable.accel_delay = outcome.accel_delay;
  comparable.accel_delay_std = outcome.accel_delay_std;
  return comparable;
}

const std::vector<ComparedQuantity> kCompared = {ComparedQuantity::kTranslation,
                                                 ComparedQuantity::kRotation,
                                                 ComparedQuantity::kAccelDelay};

Row DifferenceRow(const std::string& name, const Comparison& comparison) {
  const Difference* worst = comparison.Worst();
  return {
      name,
      Number(comparison.angle * kDegrees),
      Number(comparison.distance * 1e3),
      comparison.dof > 0 ? Format("%.1f / %d", comparison.chi2, comparison.dof) : "",
      worst == nullptr
          ? ""
          : Format("%s %c, %.1f", ToString(worst->quantity), "xyz"[worst->axis], worst -> sigmas)};
}

/// Recordings of one method with their names.
struct Named {
  std::vector<std::string> names;
  std::vector<TrialOutcome> outcomes;
};

Named Usable(const Results& results, const std::vector<CellOutcomes>& cells) {
  Named named;
  for (size_t c = 0; c < cells.size(); ++c) {
    for (size_t i = 0; i < cells[c].outcomes.size(); ++i) {
      if (!cells[c].outcomes[i].IsUsable()) continue;
      const std::vector<std::string>& labels = results.cells[c].labels;
      named.names.push_back(labels.empty() ? Format("recording %zu", i + 1)
                                           : boost::join(labels, ", "));
      named.outcomes.push_back(cells[c].outcomes[i]);
    }
  }
  return named;
}

std::string ResultTable(const Named& named) {
  std::vector<Row> rows;
  for (size_t i = 0; i < named.names.size(); ++i) {
    const TrialOutcome& o = named.outcomes[i];
    const Vector6d std = o.covariance.diagonal().cwiseSqrt();
    const Eigen::Vector3d r = Log(o.T_MI.q) * kDegrees;
    rows.push_back(
        {named.names[i],
         Format("%.3f, %.3f, %.3f", 1e3 * o.T_MI.p.x(), 1e3 * o.T_MI.p.y(), 1e3 * o.T_MI.p.z()),
         Format("%.3f, %.3f, %.3f", 1e3 * std[0], 1e3 * std[1], 1e3 * std[2]),
         Format("%.4f, %.4f, %.4f", r.x(), r.y(), r.z()),
         Format("%.4f, %.4f, %.4f", kDegrees * std[3], kDegrees * std[4], kDegrees * std[5]),
         Format("%.4f ± %.4f", 1e3 * o.accel_delay, 1e3 * o.accel_delay_std),
         o.verdict});
  }
  return MarkdownTable({"recording",
                        "p [mm]",
                        "sigma",
                        "R as a rotation vector [deg]",
                        "sigma",
                        "accel delay [ms]",
                        "verdict"},
                       rows);
}

std::string PairTable(const Named& named) {
  std::vector<Row> rows;
  for (size_t i = 0; i < named.names.size(); ++i)
    for (size_t k = i + 1; k < named.names.size(); ++k)
      rows.push_back(DifferenceRow(
          named.names[k] + " less " + named.names[i],
          Compare(ToComparable(named.outcomes[i]), ToComparable(named.outcomes[k]), kCompared)));
  return MarkdownTable(
      {"pair", "rotation [deg]", "position [mm]", "chi² / dof", "largest, in sigma"}, rows);
}

std::string ChainTable(const Named& named, const Chained& chained) {
  Comparable chain;
  chain.T_MI = chained.T_MI;
  std::vector<Row> rows;
  for (size_t i = 0; i < named.names.size(); ++i)
    rows.push_back(DifferenceRow(
        named.names[i],
        Compare(chain, ToComparable(named.outcomes[i]), {kCompared[0], kCompared[1]})));
  return "Less the chained calibration, which is taken as exact:\n\n" +
         MarkdownTable(
             {"recording", "rotation [deg]", "position [mm]", "chi² / dof", "largest, in sigma"},
             rows);
}

std::string Csv(const Row& row) { return boost::join(row, ",") + "\n"; }
std::string Exact(double value) { return Format("%.9g", value); }

}  // namespace

CellSummary Summarize(const CellOutcomes& cell) {
  static const CalibrationOptions kOptions;
  CellSummary sum;
  sum.trials = cell.outcomes.size();
  const auto add = [](const ErrorNorms& norms, ErrorNorms* squares) {
    squares->translation += norms.translation * norms.translation;
    squares->rotation += norms.rotation * norms.rotation;
    squares->time_shift += norms.time_shift * norms.time_shift;
    squares->accel_delay += norms.accel_delay * norms.accel_delay;
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
    add({std::sqrt(variance.head<3>().sum()),
         std::sqrt(variance.tail<3>().sum()),
         outcome.time_shift_std,
         outcome.accel_delay_std},
        &sum.sigma);
    add(outcome.bounds.as_joint, &sum.bound);
    add(outcome.bounds.least, &sum.least);
    sum.chi2 += outcome.chi2 / kDof;
    sum.model_chi2 += outcome.model_chi2 / kDof;
  }
  if (sum.usable == 0) return sum;
  const auto n = static_cast<double>(sum.usable);
  for (ErrorNorms* squares : {&sum.error, &sum.sigma, &sum.bound, &sum.least})
    for (double ErrorNorms::*norm : {&ErrorNorms::translation,
                                     &ErrorNorms::rotation,
                                     &ErrorNorms::time_shift,
                                     &ErrorNorms::accel_delay})
      squares->*norm = std::sqrt(squares->*norm / n);
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
  return text + ErrorTable(results, kRotationShown, kTranslationShown) +
         ErrorTable(results, kShiftShown, kDelayShown) + CountTable(results) + Refusals(results) +
         Format("![%s](%s_%s.png)\n\n",
                results.experiment->title.c_str(),
                results.experiment->name.c_str(),
                ToString(results.base));
}

std::string ComparedSection(const Results& results, const Chained& chained) {
  std::string text = Heading(results);
  for (const auto* method : {&results.gp, &results.joint}) {
    const Named named = Usable(results, *method);
    text += method == &results.gp ? "### gp\n\n" : "### joint\n\n";
    text += ResultTable(named) + PairTable(named);
    if (chained.is_given && results.base == Base::kBag) text += ChainTable(named, chained);
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
  const Experiment& experiment = *results.experiment;
  for (size_t c = 0; c < results.cells.size(); ++c) {
    for (const auto* method : {&results.gp, &results.joint}) {
      const CellSummary sum = Summarize((*method)[c]);
      Row row = {experiment.name,
                 ToString(results.base),
                 "\"" + boost::join(results.cells[c].labels, ";") + "\"",
                 method == &results.gp ? "gp" : "joint",
                 std::to_string(sum.trials),
                 std::to_string(sum.usable),
                 std::to_string(sum.successes)};
      for (const ErrorNorms& norms : {sum.error, sum.sigma, sum.bound, sum.least})
        row.insert(row.end(),
                   {Exact(norms.rotation * kDegrees),
                    Exact(norms.translation * 1e3),
                    Exact(norms.time_shift * 1e3),
                    Exact(norms.accel_delay * 1e3)});
      row.push_back(Exact(sum.chi2));
      row.push_back(Exact(sum.model_chi2));
      const bool is_printed = !experiment.printed.empty();
      row.push_back(is_printed ? Exact(experiment.printed[c].rotation) : "");
      row.push_back(is_printed ? Exact(experiment.printed[c].translation) : "");
      text += Csv(row);
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
  for (size_t c = 0; c < results.cells.size(); ++c) {
    for (const auto* method : {&results.gp, &results.joint}) {
      const CellOutcomes& cell = (*method)[c];
      for (size_t i = 0; i < cell.outcomes.size(); ++i) {
        const TrialOutcome& o = cell.outcomes[i];
        const ErrorNorms error =
            o.IsUsable() ? cell.errors[i].Norms() : ErrorNorms{NAN, NAN, NAN, NAN};
        text += Csv({results.experiment->name,
                     ToString(results.base),
                     "\"" + boost::join(results.cells[c].labels, ";") + "\"",
                     method == &results.gp ? "gp" : "joint",
                     std::to_string(i + 1),
                     o.verdict,
                     Exact(error.rotation * kDegrees),
                     Exact(error.translation * 1e3),
                     Exact(error.time_shift * 1e3),
                     Exact(error.accel_delay * 1e3),
                     Exact(o.chi2),
                     Exact(o.model_chi2),
                     Exact(o.guess_angle * kDegrees),
                     Exact(o.guess_distance)});
      }
    }
  }
  return text;
}

}  // namespace imu_pose_calib
