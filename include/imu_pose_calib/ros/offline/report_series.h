#pragma once

#include <yaml-cpp/yaml.h>

#include <Eigen/Core>
#include <memory>
#include <string>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/ground_truth/trajectory.h"
#include "imu_pose_calib/ros/io/numpy_table.h"
#include "imu_pose_calib/ros/io/recording.h"

namespace imu_pose_calib {

/// What a report tells of.
struct ReportInput {
  const CalibrationOptions& options;
  const std::vector<SessionData>& sessions;  ///< as recorded
  const std::vector<RecordingInfo>& infos;   ///< of each session
  /// Without a solution: the data were refused before the solve.
  const Calibration& result;
  std::string refusal;      ///< why there is no result; empty: there is one
  std::string run_id = {};  ///< see OutputFiles
};

/// Numbers that every reader of YAML takes for numbers.
YAML::Node YamlValue(double value);
YAML::Node YamlList(const Eigen::VectorXd& values);

/// Writes the time of each sample, in order of arrival; `time` gives that of a stamp.
template <typename Sample, typename Time>
void WriteTimes(const std::string& file, const std::vector<Sample>& samples, Time time) {
  NumpyTable<double> table(1);
  for (const Sample& sample : samples) table.AddRow(time(sample.t_ns));
  table.Write(file);
}

/// Writes what a sensor of an IMU measured.
void WriteValues(const std::string& file, const std::vector<ImuSample>& samples, double unit);

/// Writes the series of a session that was solved to files whose names begin with `prefix`, and
/// what is said of them to `node`. `covariance`: null when it was not kept.
void WriteSolvedSession(const ReportInput& input, size_t session,
                        const std::shared_ptr<const TrajectoryCovariance>& covariance,
                        const std::string& prefix, YAML::Node* node);

}  // namespace imu_pose_calib
