#pragma once

#include <yaml-cpp/yaml.h>

#include <Eigen/Core>
#include <functional>
#include <string>

namespace imu_pose_calib {

/// Numbers that every reader of YAML takes for numbers.
YAML::Node YamlValue(double value);
YAML::Node YamlList(const Eigen::VectorXd& values);

/// What a page tells of its making: version, command, folder.
YAML::Node ReportHead();

void WriteYaml(const YAML::Node& node, const std::string& path);

/// A page that scripts/report.py, which is installed beside the executables, draws of the numbers
/// that `write` puts into a folder: one HTML file, or PDF when `path` ends in ".pdf". Throws
/// InputError with the reason when it cannot be drawn.
std::string DrawPage(const std::string& path, const std::function<void(const std::string&)>& write);

/// Throws InputError for a report that is of no kind that can be drawn; none is one that can.
void CheckReportName(const std::string& path);

}  // namespace imu_pose_calib
