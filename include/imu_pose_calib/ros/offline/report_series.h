#pragma once

#include <yaml-cpp/yaml.h>

#include <Eigen/Core>
#include <string>

#include "imu_pose_calib/ros/offline/report_data.h"

namespace imu_pose_calib {

/// Numbers that every reader of YAML takes for numbers.
YAML::Node YamlValue(double value);
YAML::Node YamlList(const Eigen::VectorXd& values);

/// Writes the series of a session that was solved to files whose names begin with `prefix`, and
/// what is said of them to `node`.
void WriteSolvedSession(const ReportInput& input,
                        size_t session,
                        const std::string& prefix,
                        YAML::Node* node);

}  // namespace imu_pose_calib
