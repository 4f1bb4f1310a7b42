#pragma once

#include <yaml-cpp/yaml.h>

#include <optional>
#include <string>
#include <vector>

#include "imu_pose_calib/core/verdict/comparison.h"
#include "imu_pose_calib/ros/io/result_yaml.h"

namespace imu_pose_calib {

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

/// Draws the page as DrawReport() does and writes it. Throws InputError likewise.
void WriteComparison(const ComparisonInput& input, const std::string& path);

}  // namespace imu_pose_calib
