#pragma once

#include <yaml-cpp/yaml.h>

#include <Eigen/Core>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/core/verdict/comparison.h"
#include "imu_pose_calib/ros/io/result_yaml.h"

namespace imu_pose_calib {

// --- What the report of a calibration and that of a comparison share ---

/// Numbers that every reader of YAML takes for numbers.
YAML::Node YamlValue(double value);
YAML::Node YamlList(const Eigen::VectorXd& values);

/// What every page tells of its making: version, command, folder.
YAML::Node ReportHead();

void WriteYaml(const YAML::Node& node, const std::string& path);

/// A page that scripts/report.py, which is installed beside the executables, draws of the numbers
/// that `write` puts into a folder: one HTML file, or PDF when `path` ends in ".pdf". Throws
/// InputError with the reason when it cannot be drawn.
std::string DrawPage(const std::string& path, const std::function<void(const std::string&)>& write);

/// Throws InputError for a report that is of no kind that can be drawn; none is one that can.
void CheckReportName(const std::string& path);

// --- Comparison ---

/// What is compared with a transform alone.
extern const std::vector<ComparedQuantity> kTransform;

/// Results of one IMU as they are compared, with time shifts at the mean of the instants at which
/// they hold. Throws InputError when a result has no such IMU.
std::vector<Comparable> ToComparables(const std::vector<StoredResult>& results, size_t imu);

// As scripts take them.
YAML::Node Describe(const Comparable& calibration);
/// Its worst component, too, and the most sigmas of each quantity.
YAML::Node Describe(const Comparison& comparison);
YAML::Node Describe(const Scatter& scatter);

/// What a page of results beside each other tells of.
struct ComparisonInput {
  const std::vector<StoredResult>& results;
  size_t imu;
  const std::vector<ComparedQuantity>& quantities;  ///< that are judged
  std::optional<Comparable> reference;              ///< what all are compared with, too
  std::string status;                               ///< "agree", "differ", or "compared" of a fleet
  std::string message;
};

/// Draws the page and writes it. Throws InputError likewise.
void WriteComparison(const ComparisonInput& input, const std::string& path);

}  // namespace imu_pose_calib
