// Compares results with each other and with a reference.

#include <algorithm>
#include <boost/algorithm/string/trim.hpp>
#include <cmath>
#include <iostream>
#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/core/verdict/comparison.h"
#include "imu_pose_calib/ros/exports/exports.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/io/transform_file.h"
#include "imu_pose_calib/ros/offline/command_line.h"
#include "imu_pose_calib/ros/offline/report.h"

namespace imu_pose_calib {
namespace {

using Results = std::vector<StoredResult>;
using Quantities = std::vector<ComparedQuantity>;

struct CommandLine {
  std::vector<std::string> results, chain;
  std::string reference, camera = "cam0", reference_std = "0 0", chain_output, report, fleet;
  size_t imu = 0;
  bool same_clocks = false, quiet = false, help = false;
};

/// What results are compared with.
struct Reference {
  std::string name;
  Comparable given;
  std::vector<ChainCamera> cameras;  ///< of a chain
};

// --- Text ---

/// How a quantity is shown.
struct Unit {
  double factor;
  const char* name;
};

Unit UnitOf(ComparedQuantity quantity) {
  if (quantity == ComparedQuantity::kTranslation) return {1e3, "mm"};
  if (quantity == ComparedQuantity::kRotation) return {180.0 / M_PI, "deg"};
  return {1e3, "ms"};
}

/// A line of a table, without blanks at its end.
template <typename... Arguments>
std::string Row(const char* format, Arguments... arguments) {
  return boost::trim_right_copy(Format(format, arguments...)) + "\n";
}

/// A number of a quantity as it is shown, with four digits after the point; never "-0.0000".
std::string Fixed(double value, ComparedQuantity quantity) {
  return Format("%.4f", std::round(value * UnitOf(quantity).factor * 1e4) / 1e4 + 0.0);
}

/// "translation x", "accel delay".
std::string Name(ComparedQuantity quantity, int axis) {
  const bool is_scalar =
      quantity == ComparedQuantity::kAccelDelay || quantity == ComparedQuantity::kTimeShift;
  return ToString(quantity) + (is_scalar ? "" : std::string(" ") + "xyz"[axis]);
}

/// The worst of several comparisons so far.
struct Worst {
  double sigmas = 0.0;
  std::string text = "nothing is judged";

  void Add(const Comparison& comparison, const std::string& of) {
    const Difference* worst = comparison.Worst();
    if (!worst || (sigmas > 0.0 && worst->sigmas <= sigmas)) return;
    const auto& [factor, unit] = UnitOf(worst->quantity);
    sigmas = worst->sigmas;
    text = of + Name(worst->quantity, worst->axis) +
           Format(", %.4g %s, %.1f sigma", worst->value * factor, unit, sigmas);
  }
};

/// Rows of each component, then distance, angle and chi-square.
std::string Table(const Comparison& comparison, const char* title) {
  std::string text = Row("\n  %-24s %14s %14s", title, "difference", "sigma");
  for (const auto& [quantity, axis, value, sigma, sigmas] : comparison.components) {
    const char* unit = UnitOf(quantity).name;
    text += Row("  %-24s %10s %-3s %10s %-3s %10s", Name(quantity, axis).c_str(),
                Fixed(value, quantity).c_str(), unit, Fixed(sigma, quantity).c_str(), unit,
                sigma > 0.0 ? Format("%.1f sigma", sigmas).c_str() : "-");
  }
  text += Format("  together: %.3f mm, %.4f deg", comparison.distance * 1e3,
                 comparison.angle * 180.0 / M_PI);
  if (comparison.dof > 0)
    text += Format("; chi-square %.1f with %d degrees of freedom", comparison.chi2, comparison.dof);
  return text + "\n";
}

/// One row for each result: how far it is from something, and in what most.
std::string Table(const std::vector<Comparison>& comparisons, const char* title) {
  std::string text = Format("\n  %-16s %12s %12s   %s\n", title, "distance", "angle", "most");
  for (size_t i = 0; i < comparisons.size(); ++i) {
    Worst worst;
    worst.Add(comparisons[i], "");
    text += Format("  result %-9zu %9.3f mm %8.4f deg   %s\n", i + 1, comparisons[i].distance * 1e3,
                   comparisons[i].angle * 180.0 / M_PI, worst.text.c_str());
  }
  return text;
}

std::string Table(const Repeatability& repeatability) {
  std::string text = Row("\n  %-16s %14s %12s %12s      %s", "repeatability", "mean", "scatter",
                         "sigma", "chi2 / dof");
  const Comparable& mean = repeatability.mean;
  for (const auto& [quantity, deviation, sigma, chi2, dof] : repeatability.scatters) {
    std::string judged = dof == 0 ? "" : Format("%.1f / %d = %.2f", chi2, dof, chi2 / dof);
    for (int axis = 0; axis < deviation.size(); ++axis, judged.clear()) {
      // Of a rotation's axis there is no mean.
      const double value = quantity == ComparedQuantity::kTranslation  ? mean.T_MI.p[axis]
                           : quantity == ComparedQuantity::kAccelDelay ? mean.accel_delay
                                                                       : mean.time_shift;
      const bool has_mean = quantity != ComparedQuantity::kRotation;
      text += Row("  %-16s %14s %12s %12s %-4s %s", Name(quantity, axis).c_str(),
                  has_mean ? Fixed(value, quantity).c_str() : "",
                  Fixed(deviation[axis], quantity).c_str(), Fixed(sigma[axis], quantity).c_str(),
                  UnitOf(quantity).name, judged.c_str());
    }
  }
  Eigen::Vector4d q = mean.T_MI.q.coeffs();
  if (q[3] < 0.0) q = -q;
  return text + Format("  mean rotation x y z w: %.8f %.8f %.8f %.8f\n", q[0], q[1], q[2], q[3]);
}

/// Names what scatters more than its sigmas say: beyond what chance exceeds as rarely as a normal
/// distribution exceeds 3 sigma (Wilson and Hilferty).
std::string ScatterRemark(const Repeatability& repeatability) {
  std::string text;
  for (const Scatter& scatter : repeatability.scatters) {
    const double part = 2.0 / (9.0 * scatter.dof);
    if (scatter.dof > 0 &&
        scatter.chi2 > scatter.dof * std::pow(1.0 - part + 3.0 * std::sqrt(part), 3))
      text += (text.empty() ? "" : ", ") + std::string(ToString(scatter.quantity)) +
              Format(" %.1f times", std::sqrt(scatter.chi2 / scatter.dof));
  }
  return text.empty() ? "" : "  more scatter than the sigmas say: " + text + "\n";
}

/// The results that are compared, and remarks on them.
std::string List(const Results& results) {
  std::string text = "\n";
  const std::string& marker = results.front().infos.front().marker_frame;
  for (size_t i = 0; i < results.size(); ++i) {
    const StoredResult& stored = results[i];
    const std::string& its_marker = stored.infos.front().marker_frame;
    text += Format("  result %zu: ", i + 1) + stored.path + "\n";
    if (stored.result.status == Status::kWeak)
      text += "            weak: " + stored.result.message + "\n";
    if (its_marker != marker)
      text += "            its marker is called '" + its_marker + "', not '" + marker + "'\n";
  }
  return text;
}

// --- Comparison ---

/// [s] between the middles of two recordings of one clock.
double Apart(const StoredResult& a, const StoredResult& b, size_t imu) {
  return std::abs(a.Clock(imu).clock_reference - b.Clock(imu).clock_reference);
}

double Duration(const StoredResult& stored) { return stored.result.sessions[0].poses.duration_s; }

/// Whether all results are of one recording, or of parts of it.
bool AreOfOneRecording(const Results& results, size_t imu) {
  const StoredResult& first = results.front();
  const RecordingInfo& info = first.infos.front();
  return std::all_of(results.begin(), results.end(), [&](const StoredResult& other) {
    const RecordingInfo& its = other.infos.front();
    return other.result.sessions.size() == 1 && its.Source() == info.Source() &&
           its.pose_topic == info.pose_topic &&
           its.imus[imu].GyroSource() == info.imus[imu].GyroSource() &&
           Apart(first, other, imu) <= std::max(Duration(first), Duration(other));
  });
}

/// Whether two results have data in common: a recording, and of that the same time.
bool HaveDataInCommon(const StoredResult& a, const StoredResult& b, size_t imu) {
  if (a.result.sessions.size() == 1 && b.result.sessions.size() == 1 &&
      Apart(a, b, imu) >= 0.5 * (Duration(a) + Duration(b)))
    return false;
  for (const RecordingInfo& its : a.infos)
    for (const RecordingInfo& other : b.infos)
      if (its.Source() == other.Source()) return true;
  return false;
}

/// What agreement does not tell of results that are not of data of their own.
std::string DependenceRemark(const Results& results, size_t imu) {
  std::string pairs;
  for (size_t i = 0; i < results.size(); ++i)
    for (size_t j = i + 1; j < results.size(); ++j)
      if (HaveDataInCommon(results[i], results[j], imu))
        pairs += (pairs.empty() ? "" : ", ") + Format("%zu and %zu", i + 1, j + 1);
  if (pairs.empty()) return "";
  return Wrap("  note: ",
              "results " + pairs + " are of the same or overlapping data: that they agree does " +
                  "not show that either is right. Compare recordings that share nothing.");
}

/// A guess at why a reference is a thousand times too far away.
std::string UnitRemark(const Comparable& calibration, const Comparable& reference) {
  constexpr double kLongArm = 1.0, kNear = 0.5;  // [m], [1]
  const Eigen::Vector3d& p = reference.T_MI.p;
  const Eigen::Vector3d& found = calibration.T_MI.p;
  if (p.norm() < kLongArm || (1e-3 * p - found).norm() > kNear * found.norm()) return "";
  return "  note: the reference seems to be in millimetres, must be in m\n";
}

/// Compares two results, or each of more with the mean of the others.
std::string CompareResults(const std::vector<Comparable>& calibrations,
                           const Quantities& quantities, Worst* worst) {
  if (calibrations.size() < 2) return "";
  if (calibrations.size() == 2) {
    const Comparison comparison = Compare(calibrations[0], calibrations[1], quantities);
    worst->Add(comparison, "");
    return Table(comparison, "result 2 less result 1");
  }
  const Repeatability repeatability = Repeat(calibrations, quantities);
  for (size_t i = 0; i < calibrations.size(); ++i)
    worst->Add(repeatability.from_others[i], Format("result %zu, ", i + 1));
  return Table(repeatability) + ScatterRemark(repeatability) +
         Table(repeatability.from_others, "from the others");
}

/// Compares each result with the reference.
std::string CompareWithReference(const std::vector<Comparable>& calibrations,
                                 const Reference& reference, Worst* worst) {
  std::vector<Comparison> comparisons;
  for (const Comparable& calibration : calibrations) {
    comparisons.push_back(Compare(reference.given, calibration, kTransform));
    worst->Add(comparisons.back(),
               (calibrations.size() > 1 ? Format("result %zu, ", comparisons.size()) : "") +
                   "less " + reference.name + ": ");
  }
  return "\n  reference: " + reference.name + "\n" +
         (calibrations.size() == 1 ? Table(comparisons[0], "result less reference")
                                   : Table(comparisons, "less reference")) +
         UnitRemark(calibrations.front(), reference.given);
}

/// That of --reference or --chain. Throws InputError for what does not fit together.
std::optional<Reference> ReadReference(const CommandLine& line) {
  Reference reference;
  if (!line.reference.empty()) {
    reference.name = "reference";
    reference.given.T_MI = ReadTransform("--reference", line.reference);
  } else if (!line.chain.empty()) {
    reference.name = "marker -> " + line.camera + " -> imu";
    reference.cameras = LoadCameraChain(line.chain[1]);
    const auto found = std::find_if(reference.cameras.begin(), reference.cameras.end(),
                                    [&](const auto& camera) { return camera.name == line.camera; });
    if (found == reference.cameras.end())
      throw InputError("--cam '" + line.camera + "' is not in '" + line.chain[1] + "'");
    reference.given.T_MI = ReadTransform("--chain", line.chain[0]) * found->T_cam_imu;
  } else {
    return std::nullopt;
  }
  const Eigen::VectorXd mm_deg = ParseNumbers("--reference-std", line.reference_std, 2);
  if (mm_deg.minCoeff() < 0.0)
    throw InputError("--reference-std '" + line.reference_std + "' must not be negative");
  const double position = mm_deg[0] * 1e-3, rotation = mm_deg[1] * M_PI / 180.0;
  reference.given.covariance.diagonal() << Eigen::Vector3d::Constant(position * position),
      Eigen::Vector3d::Constant(rotation * rotation);
  return reference;
}

void Check(const CommandLine& line) {
  CheckReportName(line.report);
  const std::pair<bool, const char*> refusals[] = {
      {line.results.empty(), "give the results to compare; see compare_calibrations --help"},
      {line.chain.size() == 1, "--chain needs T_marker_cam and a camera chain"},
      {!line.reference.empty() && !line.chain.empty(), "give --reference or --chain, not both"},
      {!line.chain_output.empty() && line.chain.empty(), "--chain-output needs --chain"},
      {!line.fleet.empty() && line.report.empty(), "--fleet needs --report"},
      {line.results.size() < 2 && line.reference.empty() && line.chain.empty() &&
           line.fleet.empty(),
       "one result needs something to compare it with: another one, --reference or --chain"}};
  for (const auto& [is_so, text] : refusals)
    if (is_so) throw InputError(text);
}

/// They disagree when a component differs by more than kAgreementBound sigma. Time shifts count
/// when the results are of one recording, or when the clocks are said to be the same.
void CompareAll(const CommandLine& line) {
  Check(line);
  Results results;
  for (const std::string& path : line.results) results.push_back(LoadResult(path));
  const std::vector<Comparable> calibrations = ToComparables(results, line.imu);
  const bool has_shift = line.same_clocks || AreOfOneRecording(results, line.imu);
  Quantities quantities = kTransform;
  quantities.push_back(ComparedQuantity::kAccelDelay);
  if (!line.fleet.empty())
    return WriteComparison({results, line.imu, quantities, std::nullopt, "compared", line.fleet},
                           line.report);
  if (has_shift) quantities.push_back(ComparedQuantity::kTimeShift);

  Worst worst;
  std::string text = List(results) + CompareResults(calibrations, quantities, &worst);
  if (results.size() > 1 && !has_shift)
    text += "  time shifts are not compared: each recording has its own (--same-clocks if not)\n";
  const std::optional<Reference> reference = ReadReference(line);
  if (reference) text += CompareWithReference(calibrations, *reference, &worst);
  const bool agrees = worst.sigmas <= kAgreementBound;
  const std::string verdict =
      (agrees ? "most apart: " : "") + worst.text + Format(" (bound: %.0f)", kAgreementBound);
  text = (agrees ? "AGREE; " : "DIFFER: ") + verdict + "\n" + DependenceRemark(results, line.imu) +
         text;
  if (!line.report.empty()) {
    WriteComparison(
        {results, line.imu, quantities, reference ? std::optional(reference->given) : std::nullopt,
         agrees ? "agree" : "differ", verdict},
        line.report);
    text += "\nWritten to " + line.report + "\n";
  }
  if (!line.chain_output.empty())
    for (const auto& [ending, file] :
         ExportChain(results.front(), line.imu, reference->cameras, line.chain[1])) {
      WriteFile(line.chain_output + "." + ending, file);
      text += "Written to " + line.chain_output + "." + ending + "\n";
    }
  if (!line.quiet) std::cout << text << std::flush;
  if (!agrees) throw DataError("differ: " + verdict);
}

void Run(int argc, char** argv) {
  CommandLine line;
  boost::program_options::options_description options("Options");
  auto add = options.add_options();
  add("reference", Value(&line.reference, "T"),
      "T_marker_imu to compare with: \"x y z qx qy qz qw\" [m], or a YAML or JSON file");
  add("chain", Value(&line.chain, "T CAMCHAIN")->multitoken(),
      "the same as T_marker_cam (x_marker = T x_cam), numbers or file, and Kalibr's "
      "camchain-imucam.yaml: T_marker_imu = T_marker_cam T_cam_imu");
  add("cam", ValueOrDefault(&line.camera, "NAME"), "camera of the chain that T_marker_cam is of");
  add("reference-std", ValueOrDefault(&line.reference_std, "\"MM DEG\""),
      "sigma of reference or chain, per axis");
  add("chain-output", Value(&line.chain_output, "PREFIX"),
      "write marker -> imu (result) -> cameras (chain): PREFIX.urdf, PREFIX.tf.launch");
  add("imu", ValueOrDefault(&line.imu, "N"), "which of several imus, from 0");
  add("same-clocks", boost::program_options::bool_switch(&line.same_clocks),
      "compare the time shifts of different recordings, too");
  add("report", Value(&line.report), "page with figures: FILE.html or FILE.pdf");
  add("fleet", Value(&line.fleet),
      "results of different rigs: no verdict, only the page, which tells this text instead");
  add("quiet", boost::program_options::bool_switch(&line.quiet), "print errors only");
  add("help", boost::program_options::bool_switch(&line.help), "print this text");
  ParseCommandLine(argc, argv, options, "result", Value(&line.results), -1);
  if (line.help) {
    std::cout
        << "Usage: compare_calibrations A.yaml B.yaml [...] [options]\n"
        << "       compare_calibrations A.yaml --reference \"x y z qx qy qz qw\"\n"
        << "       compare_calibrations A.yaml --chain T_MARKER_CAM CAMCHAIN.yaml\n\n"
        << "Differences of results of calibrate_bag in mm, deg and ms, in their sigmas, and\n"
        << "the repeatability of more than two.\n\n"
        << options
        << "\nExit status: 0 nothing differs by more than 5 sigma, 1 bad usage or unreadable\n"
        << "input, 2 something does.\n";
    return;
  }
  // --chain takes all words that follow; those after its two are results.
  if (line.chain.size() > 2) {
    line.results.insert(line.results.end(), line.chain.begin() + 2, line.chain.end());
    line.chain.resize(2);
  }
  CompareAll(line);
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  return imu_pose_calib::RunCommand("compare_calibrations",
                                    [&] { imu_pose_calib::Run(argc, argv); });
}
