// Compares results with each other and with a reference.

#include <algorithm>
#include <boost/algorithm/string/trim.hpp>
#include <cmath>
#include <iostream>
#include <string>
#include <vector>

#include "imu_pose_calib/core/verdict/comparison.h"
#include "imu_pose_calib/ros/exports/export_text.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/transform_file.h"
#include "imu_pose_calib/ros/offline/command_line.h"
#include "imu_pose_calib/ros/offline/comparison_report.h"
#include "imu_pose_calib/ros/offline/report.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

namespace po = boost::program_options;

struct CommandLine {
  std::vector<std::string> results;  ///< result files, of one rig
  size_t imu = 0;                    ///< place of the IMU in rigs with several
  bool same_clocks = false;          ///< time shifts of different recordings can be compared
  /// T_marker_imu to compare with, see ReadTransform().
  std::string reference;
  /// The same as a chain: T_marker_cam (x_marker = T x_cam), and Kalibr's camchain-imucam.yaml.
  std::vector<std::string> chain;
  std::string camera = "cam0";  ///< the one of the chain that T_marker_cam is of
  /// "MM DEG": sigma of reference or chain, per axis.
  std::string reference_std = "0 0";
  /// Where marker -> imu -> cameras goes: this name with .urdf and .tf.launch.
  std::string chain_output;
  std::string report;  ///< page with figures
  bool quiet = false, help = false;
};

/// A line of a table, without blanks at its end.
template <typename... Arguments>
std::string Row(const char* format, Arguments... arguments) {
  return boost::trim_right_copy(Format(format, arguments...)) + "\n";
}

/// The number with four digits after the point; never "-0.0000".
std::string Fixed(double value) { return Format("%.4f", std::round(value * 1e4) / 1e4 + 0.0); }

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

/// "translation x", "accel delay".
std::string Name(ComparedQuantity quantity, int axis) {
  const bool is_vector =
      quantity == ComparedQuantity::kTranslation || quantity == ComparedQuantity::kRotation;
  return std::string(ToString(quantity)) + (is_vector ? std::string(" ") + "xyz"[axis] : "");
}

/// The worst of several comparisons so far.
struct Worst {
  double sigmas = 0.0;
  std::string text = "nothing is judged";

  void Add(const Comparison& comparison, const std::string& of) {
    const Difference* worst = comparison.Worst();
    if (!worst || (sigmas > 0.0 && worst->sigmas <= sigmas)) return;
    const Unit unit = UnitOf(worst->quantity);
    sigmas = worst->sigmas;
    text = of + Name(worst->quantity, worst->axis) + ", " +
           Format("%.4g %s, %.1f sigma", worst->value * unit.factor, unit.name, sigmas);
  }
};

/// Whether all results are of one recording, or of parts of it.
bool AreOfOneRecording(const std::vector<StoredResult>& results, size_t imu) {
  const RecordingInfo& info = results.front().infos.front();
  const ImuSession& clock = results.front().Clock(imu);
  return std::all_of(results.begin(), results.end(), [&](const StoredResult& other) {
    const RecordingInfo& its = other.infos.front();
    const double longest = std::max(results.front().result.sessions[0].poses.duration_s,
                                    other.result.sessions[0].poses.duration_s);
    return other.result.sessions.size() == 1 && its.Source() == info.Source() &&
           its.pose_topic == info.pose_topic &&
           its.imus[imu].GyroSource() == info.imus[imu].GyroSource() &&
           std::abs(other.Clock(imu).clock_reference - clock.clock_reference) <= longest;
  });
}

/// Whether two results have data in common: a recording, and of that the same time.
bool HaveDataInCommon(const StoredResult& a, const StoredResult& b, size_t imu) {
  const bool are_single = a.result.sessions.size() == 1 && b.result.sessions.size() == 1;
  const double apart = std::abs(a.Clock(imu).clock_reference - b.Clock(imu).clock_reference);
  const double half_lengths =
      0.5 * (a.result.sessions[0].poses.duration_s + b.result.sessions[0].poses.duration_s);
  for (const RecordingInfo& its : a.infos)
    for (const RecordingInfo& other : b.infos)
      if (its.Source() == other.Source() && (!are_single || apart < half_lengths)) return true;
  return false;
}

/// What agreement does not tell of results that are not of data of their own.
std::string DependenceRemark(const std::vector<StoredResult>& results, size_t imu) {
  std::string pairs;
  for (size_t i = 0; i < results.size(); ++i)
    for (size_t j = i + 1; j < results.size(); ++j)
      if (HaveDataInCommon(results[i], results[j], imu))
        pairs +=
            (pairs.empty() ? "" : ", ") + std::to_string(i + 1) + " and " + std::to_string(j + 1);
  if (pairs.empty()) return "";
  return Wrap("  note: ",
              "results " + pairs + " are of the same or overlapping data: that they agree does " +
                  "not show that either is right. Compare recordings that share nothing.");
}

/// A guess at why a reference is a thousand times too far away.
std::string UnitRemark(const std::vector<Comparable>& calibrations, const Comparable& reference) {
  constexpr double kLongArm = 1.0, kNear = 0.5;  // [m], [1]
  const Eigen::Vector3d& p = reference.T_MI.p;
  const Eigen::Vector3d& found = calibrations.front().T_MI.p;
  if (p.norm() < kLongArm || (1e-3 * p - found).norm() > kNear * found.norm()) return "";
  return "  note: the reference seems to be in millimetres, must be in m\n";
}

/// Rows of each component, then distance, angle and chi-square.
std::string Table(const Comparison& comparison, const std::string& title) {
  std::string text = Row("\n  %-24s %14s %14s", title.c_str(), "difference", "sigma");
  for (const Difference& component : comparison.components) {
    const Unit unit = UnitOf(component.quantity);
    const std::string judged = component.sigma > 0.0 ? Format("%.1f sigma", component.sigmas) : "-";
    text +=
        Row("  %-24s %10s %-3s %10s %-3s %10s", Name(component.quantity, component.axis).c_str(),
            Fixed(component.value * unit.factor).c_str(), unit.name,
            Fixed(component.sigma * unit.factor).c_str(), unit.name, judged.c_str());
  }
  text += Format("  together: %.3f mm, %.4f deg", comparison.distance * 1e3,
                 comparison.angle * 180.0 / M_PI);
  if (comparison.dof > 0)
    text += Format("; chi-square %.1f with %d degrees of freedom", comparison.chi2, comparison.dof);
  return text + "\n";
}

/// The mean of a component as text; of a rotation none, which has no mean of an axis.
std::string MeanText(const Comparable& mean, ComparedQuantity quantity, int axis) {
  if (quantity == ComparedQuantity::kRotation) return "";
  const double value = quantity == ComparedQuantity::kTranslation  ? mean.T_MI.p[axis]
                       : quantity == ComparedQuantity::kAccelDelay ? mean.accel_delay
                                                                   : mean.time_shift;
  return Fixed(value * UnitOf(quantity).factor);
}

std::string ScatterTable(const Repeatability& repeatability) {
  std::string text = Row("\n  %-16s %14s %12s %12s      %s", "repeatability", "mean", "scatter",
                         "sigma", "chi2 / dof");
  for (const Scatter& scatter : repeatability.scatters) {
    const Unit unit = UnitOf(scatter.quantity);
    for (int axis = 0; axis < scatter.deviation.size(); ++axis) {
      const std::string chi2 =
          axis > 0 || scatter.dof == 0
              ? ""
              : Format("%.1f / %d = %.2f", scatter.chi2, scatter.dof, scatter.chi2 / scatter.dof);
      text += Row("  %-16s %14s %12s %12s %-4s %s", Name(scatter.quantity, axis).c_str(),
                  MeanText(repeatability.mean, scatter.quantity, axis).c_str(),
                  Fixed(scatter.deviation[axis] * unit.factor).c_str(),
                  Fixed(scatter.sigma[axis] * unit.factor).c_str(), unit.name, chi2.c_str());
    }
  }
  Eigen::Vector4d q = repeatability.mean.T_MI.q.coeffs();
  if (q[3] < 0.0) q = -q;
  return text + Format("  mean rotation x y z w: %.8f %.8f %.8f %.8f\n", q[0], q[1], q[2], q[3]);
}

/// Which chance exceeds as rarely as a normal distribution exceeds 3 sigma (Wilson and Hilferty).
double ChiSquareBound(double dof) {
  return dof * std::pow(1.0 - 2.0 / (9.0 * dof) + 3.0 * std::sqrt(2.0 / (9.0 * dof)), 3);
}

/// Names what scatters more than its sigmas say, beyond chance.
std::string ScatterRemark(const Repeatability& repeatability) {
  std::string text;
  for (const Scatter& scatter : repeatability.scatters)
    if (scatter.dof > 0 && scatter.chi2 > ChiSquareBound(scatter.dof))
      text += (text.empty() ? "" : ", ") + std::string(ToString(scatter.quantity)) +
              Format(" %.1f times", std::sqrt(scatter.chi2 / scatter.dof));
  return text.empty() ? "" : "  more scatter than the sigmas say: " + text + "\n";
}

/// One row for each result: how far it is from something, and in what most.
std::string Rows(const std::vector<Comparison>& comparisons, const std::string& title) {
  std::string text =
      Format("\n  %-16s %12s %12s   %s\n", title.c_str(), "distance", "angle", "most");
  for (size_t i = 0; i < comparisons.size(); ++i) {
    Worst worst;
    worst.Add(comparisons[i], "");
    text += Format("  result %-9zu %9.3f mm %8.4f deg   %s\n", i + 1, comparisons[i].distance * 1e3,
                   comparisons[i].angle * 180.0 / M_PI, worst.text.c_str());
  }
  return text;
}

/// T_marker_imu: x_marker = T_marker_cam x_cam, x_cam = T_cam_imu x_imu.
Rigid3 Chain(const CommandLine& line, const std::vector<ChainCamera>& cameras) {
  const auto found = std::find_if(cameras.begin(), cameras.end(), [&](const ChainCamera& camera) {
    return camera.name == line.camera;
  });
  if (found == cameras.end())
    throw InputError("--cam '" + line.camera + "' is not in '" + line.chain[1] + "'");
  return ReadTransform("--chain", line.chain[0]) * found->T_cam_imu;
}

/// Of the sigma given for reference or chain.
Matrix6d Covariance(const std::string& text) {
  const Eigen::VectorXd sigmas = ParseNumbers("--reference-std", text, 2);
  if (sigmas.minCoeff() < 0.0)
    throw InputError("--reference-std '" + text + "' must not be negative");
  const double position = sigmas[0] * 1e-3, rotation = sigmas[1] * M_PI / 180.0;
  Matrix6d covariance = Matrix6d::Zero();
  covariance.diagonal().head<3>().setConstant(position * position);
  covariance.diagonal().tail<3>().setConstant(rotation * rotation);
  return covariance;
}

/// Writes marker -> imu of the result, and imu -> each camera of the chain.
std::vector<std::string> WriteChain(const CommandLine& line, const StoredResult& stored,
                                    const std::vector<ChainCamera>& cameras) {
  std::vector<StaticTransform> transforms = {ImuTransforms(stored)[line.imu]};
  const std::string imu = transforms.front().child;
  for (const ChainCamera& camera : cameras)
    transforms.push_back({imu, camera.name, camera.T_cam_imu.Inverse()});
  const Lines head =
      Head(stored, "marker -> imu -> cameras", true,
           {"cameras: x_cam = T_cam_imu x_imu of " + line.chain[1] + "; published is its inverse"});
  std::vector<std::string> paths = {line.chain_output + ".urdf", line.chain_output + ".tf.launch"};
  WriteFile(paths[0], UrdfText(head, transforms));
  WriteFile(paths[1], LaunchText(head, transforms));
  return paths;
}

/// The results that are compared, and remarks on them.
std::string List(const std::vector<StoredResult>& results) {
  std::string text = "\n";
  const std::string& marker = results.front().infos.front().marker_frame;
  for (size_t i = 0; i < results.size(); ++i) {
    const StoredResult& stored = results[i];
    text += "  result " + std::to_string(i + 1) + ": " + stored.path + "\n";
    if (stored.result.status == Status::kWeak)
      text += "            weak: " + stored.result.message + "\n";
    if (stored.infos.front().marker_frame != marker)
      text += "            its marker is called '" + stored.infos.front().marker_frame +
              "', not '" + marker + "'\n";
  }
  return text;
}

void Check(const CommandLine& line) {
  CheckReportName(line.report);
  if (line.results.empty())
    throw InputError("give the results to compare; see compare_calibrations --help");
  if (!line.chain.empty() && line.chain.size() != 2)
    throw InputError("--chain needs T_marker_cam and a camera chain");
  if (!line.reference.empty() && !line.chain.empty())
    throw InputError("give --reference or --chain, not both");
  if (!line.chain_output.empty() && line.chain.empty())
    throw InputError("--chain-output needs --chain");
  if (line.results.size() < 2 && line.reference.empty() && line.chain.empty())
    throw InputError(
        "one result needs something to compare it with: another one, --reference or "
        "--chain");
}

/// Compares two results, or each of more with the mean of the others.
std::string CompareResults(const std::vector<Comparable>& calibrations,
                           const std::vector<ComparedQuantity>& quantities, Worst* worst) {
  if (calibrations.size() < 2) return "";
  if (calibrations.size() == 2) {
    const Comparison comparison = Compare(calibrations[0], calibrations[1], quantities);
    worst->Add(comparison, "");
    return Table(comparison, "result 2 less result 1");
  }
  const Repeatability repeatability = Repeat(calibrations, quantities);
  for (size_t i = 0; i < calibrations.size(); ++i)
    worst->Add(repeatability.from_others[i], "result " + std::to_string(i + 1) + ", ");
  return ScatterTable(repeatability) + ScatterRemark(repeatability) +
         Rows(repeatability.from_others, "from the others");
}

/// Compares each result with the reference.
std::string CompareWithReference(const std::vector<Comparable>& calibrations,
                                 const Comparable& reference, const std::string& name,
                                 const std::vector<ComparedQuantity>& quantities, Worst* worst) {
  std::vector<Comparison> comparisons;
  for (size_t i = 0; i < calibrations.size(); ++i) {
    comparisons.push_back(Compare(reference, calibrations[i], quantities));
    const std::string of = calibrations.size() > 1 ? "result " + std::to_string(i + 1) + ", " : "";
    worst->Add(comparisons.back(), of + "less " + name + ": ");
  }
  return "\n  reference: " + name + "\n" +
         (calibrations.size() == 1 ? Table(comparisons[0], "result less reference")
                                   : Rows(comparisons, "less reference"));
}

/// They disagree when a component differs by more than kAgreementBound sigma. Time shifts count
/// when the results are of one recording, or when the clocks are said to be the same.
void CompareAll(const CommandLine& line) {
  Check(line);
  std::vector<StoredResult> results;
  for (const std::string& path : line.results) results.push_back(LoadResult(path));
  const std::vector<Comparable> calibrations = ToComparables(results, line.imu);
  const std::vector<ComparedQuantity> transform = {ComparedQuantity::kTranslation,
                                                   ComparedQuantity::kRotation};
  std::vector<ComparedQuantity> quantities = transform;
  quantities.push_back(ComparedQuantity::kAccelDelay);
  const bool has_shift = line.same_clocks || AreOfOneRecording(results, line.imu);
  if (has_shift) quantities.push_back(ComparedQuantity::kTimeShift);

  Worst worst;
  std::string text = List(results) + CompareResults(calibrations, quantities, &worst);
  if (results.size() > 1 && !has_shift)
    text += "  time shifts are not compared: each recording has its own (--same-clocks if not)\n";
  std::vector<ChainCamera> cameras;
  std::string name;  // of the reference, if there is one
  Comparable reference;
  if (!line.reference.empty()) {
    name = "reference";
    reference.T_MI = ReadTransform("--reference", line.reference);
  }
  if (!line.chain.empty()) {
    name = "marker -> " + line.camera + " -> imu";
    cameras = LoadCameraChain(line.chain[1]);
    reference.T_MI = Chain(line, cameras);
  }
  if (!name.empty()) {
    reference.covariance = Covariance(line.reference_std);
    text += CompareWithReference(calibrations, reference, name, transform, &worst) +
            UnitRemark(calibrations, reference);
  }
  const bool agrees = worst.sigmas <= kAgreementBound;
  const std::string verdict =
      (agrees ? "; most apart: " : ": ") + worst.text + Format(" (bound: %.0f)", kAgreementBound);
  text =
      (agrees ? "AGREE" : "DIFFER") + verdict + "\n" + DependenceRemark(results, line.imu) + text;
  if (!line.report.empty()) {
    WriteComparison(
        {results, line.imu, quantities,
         name.empty() ? std::nullopt : std::optional<Comparable>(reference),
         agrees ? "agree" : "differ",
         (agrees ? "most apart: " : "") + worst.text + Format(" (bound: %.0f)", kAgreementBound)},
        line.report);
    text += "\nWritten to " + line.report + "\n";
  }
  if (!line.chain_output.empty())
    for (const std::string& path : WriteChain(line, results.front(), cameras))
      text += "Written to " + path + "\n";
  if (!line.quiet) std::cout << text << std::flush;
  if (!agrees) throw DataError("differ" + verdict);
}

po::options_description Describe(CommandLine* line) {
  po::options_description options("Options");
  auto add = options.add_options();
  add("reference", Value(&line->reference, "T"),
      "T_marker_imu to compare with: \"x y z qx qy qz qw\" [m], or a YAML or JSON file");
  add("chain", Value(&line->chain, "T CAMCHAIN")->multitoken(),
      "the same as T_marker_cam (x_marker = T x_cam), numbers or file, and Kalibr's "
      "camchain-imucam.yaml: T_marker_imu = T_marker_cam T_cam_imu");
  add("cam", ValueOrDefault(&line->camera, "NAME"), "camera of the chain that T_marker_cam is of");
  add("reference-std", ValueOrDefault(&line->reference_std, "\"MM DEG\""),
      "sigma of reference or chain, per axis");
  add("chain-output", Value(&line->chain_output, "PREFIX"),
      "write marker -> imu (result) -> cameras (chain): PREFIX.urdf, PREFIX.tf.launch");
  add("imu", ValueOrDefault(&line->imu, "N"), "which of several imus, from 0");
  add("same-clocks", po::bool_switch(&line->same_clocks),
      "compare the time shifts of different recordings, too");
  add("report", Value(&line->report), "page with figures: FILE.html or FILE.pdf");
  add("quiet", po::bool_switch(&line->quiet), "print errors only");
  add("help", po::bool_switch(&line->help), "print this text");
  return options;
}

void Parse(int argc, char** argv, CommandLine* line) {
  ParseCommandLine(argc, argv, Describe(line), "result", Value(&line->results), -1);
  // --chain takes all words that follow; those after its two are results.
  if (line->chain.size() > 2) {
    line->results.insert(line->results.end(), line->chain.begin() + 2, line->chain.end());
    line->chain.resize(2);
  }
}

void PrintHelp() {
  CommandLine line;
  std::cout << "Usage: compare_calibrations A.yaml B.yaml [...] [options]\n"
            << "       compare_calibrations A.yaml --reference \"x y z qx qy qz qw\"\n"
            << "       compare_calibrations A.yaml --chain T_MARKER_CAM CAMCHAIN.yaml\n\n"
            << "Differences of results of calibrate_bag in mm, deg and ms, in their sigmas, and\n"
            << "the repeatability of more than two.\n\n"
            << Describe(&line)
            << "\nExit status: 0 nothing differs by more than 5 sigma, 1 bad usage or unreadable\n"
            << "input, 2 something does.\n";
}

void Run(int argc, char** argv) {
  CommandLine line;
  Parse(argc, argv, &line);
  if (line.help) return PrintHelp();
  CompareAll(line);
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  return imu_pose_calib::RunCommand("compare_calibrations",
                                    [&] { imu_pose_calib::Run(argc, argv); });
}
