#include "imu_pose_calib/ros/offline/compare.h"

#include <algorithm>
#include <boost/algorithm/string/trim.hpp>
#include <cmath>
#include <optional>

#include "imu_pose_calib/core/comparison.h"
#include "imu_pose_calib/ros/exports/export_text.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/stored_result.h"
#include "imu_pose_calib/ros/io/transform_file.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

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

Comparable ToComparable(const StoredResult& stored, size_t imu) {
  if (imu >= stored.result.imus.size())
    throw InputError("--imu " + std::to_string(imu) + ": '" + stored.path + "' has " +
                     std::to_string(stored.result.imus.size()) + " imus, from 0");
  const ImuCalibration& calibration = stored.result.imus[imu];
  Comparable comparable;
  comparable.T_MI = calibration.T_MI;
  comparable.covariance = calibration.covariance;
  comparable.accel_delay = calibration.accel_delay;
  comparable.accel_delay_std = calibration.accel_delay_std;
  return comparable;
}

/// Time shifts at the mean of the instants at which they hold.
void SetTimeShifts(const std::vector<StoredResult>& results,
                   size_t imu,
                   std::vector<Comparable>* calibrations) {
  double reference = 0.0;
  for (const StoredResult& stored : results)
    reference += stored.Clock(imu).clock_reference / static_cast<double>(results.size());
  for (size_t i = 0; i < results.size(); ++i) {
    const ImuSession& clock = results[i].Clock(imu);
    const double away = reference - clock.clock_reference;
    (*calibrations)[i].time_shift = clock.time_shift + clock.clock_drift * away;
    (*calibrations)[i].time_shift_std =
        std::hypot(clock.time_shift_std, clock.clock_drift_std * away);
  }
}

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

/// Rows of each component, then distance, angle and chi-square.
std::string Table(const Comparison& comparison, const std::string& title) {
  std::string text = Row("\n  %-24s %14s %14s", title.c_str(), "difference", "sigma");
  for (const Difference& component : comparison.components) {
    const Unit unit = UnitOf(component.quantity);
    const std::string judged = component.sigma > 0.0 ? Format("%.1f sigma", component.sigmas) : "-";
    text += Row("  %-24s %10s %-3s %10s %-3s %10s",
                Name(component.quantity, component.axis).c_str(),
                Fixed(component.value * unit.factor).c_str(),
                unit.name,
                Fixed(component.sigma * unit.factor).c_str(),
                unit.name,
                judged.c_str());
  }
  text += Format(
      "  together: %.3f mm, %.4f deg", comparison.distance * 1e3, comparison.angle * 180.0 / M_PI);
  if (comparison.dof > 0)
    text += Format("; chi-square %.1f with %d degrees of freedom", comparison.chi2, comparison.dof);
  return text + "\n";
}

/// The mean of a component as text; of a rotation none, which has no mean of an axis.
std::string MeanText(const Comparable& mean, ComparedQuantity quantity, int axis) {
  const double factor = UnitOf(quantity).factor;
  switch (quantity) {
    case ComparedQuantity::kTranslation:
      return Fixed(mean.T_MI.p[axis] * factor);
    case ComparedQuantity::kRotation:
      return "";
    case ComparedQuantity::kAccelDelay:
      return Fixed(mean.accel_delay * factor);
    case ComparedQuantity::kTimeShift:
      return Fixed(mean.time_shift * factor);
  }
  return "";
}

std::string ScatterTable(const Repeatability& repeatability) {
  std::string text = Row("\n  %-16s %14s %12s %12s      %s",
                         "repeatability",
                         "mean",
                         "scatter",
                         "sigma",
                         "chi2 / dof");
  for (const Scatter& scatter : repeatability.scatters) {
    const Unit unit = UnitOf(scatter.quantity);
    for (int axis = 0; axis < scatter.deviation.size(); ++axis) {
      const std::string chi2 =
          axis > 0 || scatter.dof == 0
              ? ""
              : Format("%.1f / %d = %.2f", scatter.chi2, scatter.dof, scatter.chi2 / scatter.dof);
      text += Row("  %-16s %14s %12s %12s %-4s %s",
                  Name(scatter.quantity, axis).c_str(),
                  MeanText(repeatability.mean, scatter.quantity, axis).c_str(),
                  Fixed(scatter.deviation[axis] * unit.factor).c_str(),
                  Fixed(scatter.sigma[axis] * unit.factor).c_str(),
                  unit.name,
                  chi2.c_str());
    }
  }
  Eigen::Vector4d q = repeatability.mean.T_MI.q.coeffs();
  if (q[3] < 0.0) q = -q;
  return text + Format("  mean rotation x y z w: %.8f %.8f %.8f %.8f\n", q[0], q[1], q[2], q[3]);
}

/// Names what scatters more than its sigmas say, beyond chance.
std::string ScatterRemark(const Repeatability& repeatability) {
  std::string text;
  for (const Scatter& scatter : repeatability.scatters)
    if (scatter.chi2 > scatter.dof + 3.0 * std::sqrt(2.0 * scatter.dof))
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
    text += Format("  result %-9zu %9.3f mm %8.4f deg   %s\n",
                   i + 1,
                   comparisons[i].distance * 1e3,
                   comparisons[i].angle * 180.0 / M_PI,
                   worst.text.c_str());
  }
  return text;
}

/// T_marker_imu that is given, or chained of two transforms, with the sigma given for it.
struct Reference {
  std::string name;
  Comparable value;
};

/// x_marker = T_marker_cam x_cam, x_cam = T_cam_imu x_imu.
Reference Chain(const CompareRequest& request, const std::vector<ChainCamera>& cameras) {
  const auto found = std::find_if(cameras.begin(), cameras.end(), [&](const ChainCamera& camera) {
    return camera.name == request.camera;
  });
  if (found == cameras.end())
    throw InputError("--cam '" + request.camera + "' is not in '" + request.chain[1] + "'");
  Reference reference;
  reference.name = "marker -> " + request.camera + " -> imu";
  reference.value.T_MI = ReadTransform("--chain", request.chain[0]) * found->T_cam_imu;
  return reference;
}

void SetStd(const std::string& text, Reference* reference) {
  const Eigen::VectorXd sigmas = ParseNumbers("--reference-std", text, 2);
  if (sigmas.minCoeff() < 0.0)
    throw InputError("--reference-std '" + text + "' must not be negative");
  const double position = sigmas[0] * 1e-3, rotation = sigmas[1] * M_PI / 180.0;
  reference->value.covariance.diagonal().head<3>().setConstant(position * position);
  reference->value.covariance.diagonal().tail<3>().setConstant(rotation * rotation);
}

/// Writes marker -> imu of the result, and imu -> each camera of the chain.
std::vector<std::string> WriteChain(const CompareRequest& request,
                                    const StoredResult& stored,
                                    const std::vector<ChainCamera>& cameras) {
  std::vector<StaticTransform> transforms = {ImuTransforms(stored)[request.imu]};
  const std::string imu = transforms.front().child;
  for (const ChainCamera& camera : cameras)
    transforms.push_back({imu, camera.name, camera.T_cam_imu.Inverse()});
  const Lines head = Head(
      stored,
      "marker -> imu -> cameras",
      true,
      {"cameras: x_cam = T_cam_imu x_imu of " + request.chain[1] + "; published is its inverse"});
  std::vector<std::string> paths = {request.chain_output + ".urdf",
                                    request.chain_output + ".tf.launch"};
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

void Check(const CompareRequest& request) {
  if (request.results.empty())
    throw InputError("give the results to compare; see compare_calibrations --help");
  if (!request.chain.empty() && request.chain.size() != 2)
    throw InputError("--chain needs T_marker_cam and a camera chain");
  if (!request.reference.empty() && !request.chain.empty())
    throw InputError("give --reference or --chain, not both");
  if (!request.chain_output.empty() && request.chain.empty())
    throw InputError("--chain-output needs --chain");
  if (request.results.size() < 2 && request.reference.empty() && request.chain.empty())
    throw InputError(
        "one result needs something to compare it with: another one, --reference or "
        "--chain");
}

}  // namespace

CompareOutcome CompareResults(const CompareRequest& request) {
  Check(request);
  std::vector<StoredResult> results;
  std::vector<Comparable> calibrations;
  for (const std::string& path : request.results) {
    results.push_back(LoadResult(path));
    calibrations.push_back(ToComparable(results.back(), request.imu));
  }
  SetTimeShifts(results, request.imu, &calibrations);
  std::vector<ComparedQuantity> quantities = {ComparedQuantity::kTranslation,
                                              ComparedQuantity::kRotation};
  const std::vector<ComparedQuantity> transform = quantities;
  quantities.push_back(ComparedQuantity::kAccelDelay);
  const bool has_shift = request.same_clocks || AreOfOneRecording(results, request.imu);
  if (has_shift) quantities.push_back(ComparedQuantity::kTimeShift);

  CompareOutcome outcome;
  Worst worst;
  outcome.text = List(results);
  if (results.size() == 2) {
    const Comparison comparison = Compare(calibrations[0], calibrations[1], quantities);
    worst.Add(comparison, "");
    outcome.text += Table(comparison, "result 2 less result 1");
  } else if (results.size() > 2) {
    const Repeatability repeatability = Repeat(calibrations, quantities);
    for (size_t i = 0; i < results.size(); ++i)
      worst.Add(repeatability.from_others[i], "result " + std::to_string(i + 1) + ", ");
    outcome.text += ScatterTable(repeatability) + ScatterRemark(repeatability) +
                    Rows(repeatability.from_others, "from the others");
  }
  if (results.size() > 1 && !has_shift)
    outcome.text +=
        "  time shifts are not compared: each recording has its own (--same-clocks if not)\n";

  std::vector<ChainCamera> cameras;
  std::optional<Reference> reference;
  if (!request.reference.empty())
    reference = {"reference", {ReadTransform("--reference", request.reference)}};
  if (!request.chain.empty()) {
    cameras = LoadCameraChain(request.chain[1]);
    reference = Chain(request, cameras);
  }
  if (reference) {
    SetStd(request.reference_std, &*reference);
    std::vector<Comparison> comparisons;
    for (size_t i = 0; i < results.size(); ++i) {
      comparisons.push_back(Compare(reference->value, calibrations[i], transform));
      const std::string of = results.size() > 1 ? "result " + std::to_string(i + 1) + ", " : "";
      worst.Add(comparisons.back(), of + "less " + reference->name + ": ");
    }
    outcome.text += "\n  reference: " + reference->name + "\n";
    outcome.text += results.size() == 1 ? Table(comparisons[0], "result less reference")
                                        : Rows(comparisons, "less reference");
  }
  outcome.agrees = worst.sigmas <= kAgreementBound;
  outcome.verdict = (outcome.agrees ? "agree; most apart: " : "differ: ") + worst.text +
                    Format(" (bound: %.0f)", kAgreementBound);
  outcome.text = (outcome.agrees ? "AGREE" : "DIFFER") +
                 outcome.verdict.substr(outcome.agrees ? 5 : 6) + "\n" + outcome.text;
  if (!request.chain_output.empty())
    outcome.written = WriteChain(request, results.front(), cameras);
  return outcome;
}

}  // namespace imu_pose_calib
