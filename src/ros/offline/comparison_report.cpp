#include "imu_pose_calib/ros/offline/comparison_report.h"

#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <cmath>
#include <map>

#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/offline/report.h"

namespace imu_pose_calib {
namespace {

/// One result, on its own.
YAML::Node Describe(const StoredResult& stored, const ImuStd& noise) {
  YAML::Node node;
  node["path"] = Printable(stored.path);
  node["source"] = Printable(stored.infos.front().Source());
  node["status"] = ToString(stored.result.status);
  const PoseStd& pose_noise = stored.result.sessions.front().noise;
  node["noise"]["gyro"] = YamlValue(noise.gyro);
  node["noise"]["accel"] = YamlValue(noise.accel);
  node["noise"]["position"] = YamlValue(pose_noise.position);
  node["noise"]["rotation"] = YamlValue(pose_noise.rotation);
  return node;
}

}  // namespace

const std::vector<ComparedQuantity> kTransform = {ComparedQuantity::kTranslation,
                                                  ComparedQuantity::kRotation};

YAML::Node Describe(const Comparable& calibration) {
  YAML::Node node;
  node["translation"] = YamlList(calibration.T_MI.p);
  node["rotation"] = YamlList(calibration.T_MI.q.coeffs());
  for (int row = 0; row < 6; ++row)
    node["covariance"].push_back(YamlList(calibration.covariance.row(row)));
  node["accel_delay"] =
      YamlList(Eigen::Vector2d(calibration.accel_delay, calibration.accel_delay_std));
  node["time_shift"] =
      YamlList(Eigen::Vector2d(calibration.time_shift, calibration.time_shift_std));
  return node;
}

YAML::Node Describe(const Comparison& comparison) {
  YAML::Node node;
  node["distance"] = YamlValue(comparison.distance);
  node["angle"] = YamlValue(comparison.angle);
  node["chi2"] = YamlValue(comparison.chi2);
  node["dof"] = comparison.dof;
  const Difference* worst = comparison.Worst();
  node["sigmas"] = YamlValue(worst ? worst->sigmas : 0.0);
  node["worst"] = worst ? ToString(worst->quantity) : "";
  node["axis"] = worst ? worst->axis : 0;
  std::map<std::string, double> most;
  for (const Difference& component : comparison.components) {
    double& sigmas = most[ToString(component.quantity)];
    sigmas = std::max(sigmas, component.sigmas);
  }
  for (const auto& [quantity, sigmas] : most) node["most"][quantity] = YamlValue(sigmas);
  return node;
}

YAML::Node Describe(const Scatter& scatter) {
  YAML::Node node;
  node["quantity"] = ToString(scatter.quantity);
  node["deviation"] = YamlList(scatter.deviation);
  node["sigma"] = YamlList(scatter.sigma);
  node["chi2"] = YamlValue(scatter.chi2);
  node["dof"] = scatter.dof;
  return node;
}

std::vector<Comparable> ToComparables(const std::vector<StoredResult>& results, size_t imu) {
  double reference = 0.0;
  for (const StoredResult& stored : results) {
    if (imu >= stored.result.imus.size())
      throw InputError("--imu " + std::to_string(imu) + ": '" + stored.path + "' has " +
                       std::to_string(stored.result.imus.size()) + " imus, from 0");
    reference += stored.Clock(imu).clock_reference / static_cast<double>(results.size());
  }
  std::vector<Comparable> calibrations;
  for (const StoredResult& stored : results) {
    const ImuCalibration& calibration = stored.result.imus[imu];
    const ImuSession& clock = stored.Clock(imu);
    const double away = reference - clock.clock_reference;
    calibrations.push_back({calibration.T_MI, calibration.covariance, calibration.accel_delay,
                            calibration.accel_delay_std,
                            clock.time_shift + clock.clock_drift * away,
                            std::hypot(clock.time_shift_std, clock.clock_drift_std * away)});
  }
  return calibrations;
}

void WriteComparison(const ComparisonInput& input, const std::string& path) {
  const std::vector<Comparable> calibrations = ToComparables(input.results, input.imu);
  YAML::Node head = ReportHead();
  head["status"] = input.status;
  head["message"] = Printable(input.message);
  Repeatability repeatability;
  repeatability.mean = input.reference.value_or(calibrations.front());
  if (calibrations.size() > 1) repeatability = Repeat(calibrations, input.quantities);
  head["mean"] = Describe(repeatability.mean);
  for (const Scatter& scatter : repeatability.scatters)
    head["scatters"].push_back(Describe(scatter));
  for (size_t i = 0; i < calibrations.size(); ++i) {
    const StoredResult& stored = input.results[i];
    YAML::Node node = Describe(stored, stored.Clock(input.imu).noise);
    node["calibration"] = Describe(calibrations[i]);
    if (calibrations.size() > 1) node["from_others"] = Describe(repeatability.from_others[i]);
    if (input.reference)
      node["from_reference"] = Describe(Compare(*input.reference, calibrations[i], kTransform));
    head["results"].push_back(node);
  }
  if (input.reference) head["reference"] = Describe(*input.reference);
  WriteFile(path, DrawPage(path, "", [&](const std::string& folder) {
              WriteYaml(head, folder + "/report.yaml");
            }));
}

}  // namespace imu_pose_calib
