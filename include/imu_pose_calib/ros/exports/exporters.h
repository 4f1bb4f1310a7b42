#pragma once

#include <Eigen/Geometry>
#include <string>
#include <vector>

#include "imu_pose_calib/ros/io/result_yaml.h"

namespace imu_pose_calib {

/// What a consumer needs beyond the result.
struct ExportOptions {
  /// px4: imu axes to the autopilot's body axes forward, right, down: v_body = q v_imu.
  Eigen::Quaterniond q_body_imu = Eigen::Quaterniond::Identity();
};

/// One file of an export.
struct ExportFile {
  std::string ending;  ///< "kalibr.imu0.yaml", what follows the name of the result and a dot
  std::string text;
};

/// Gives the files of one program, which state what their keys mean.
using Exporter = std::vector<ExportFile>(const StoredResult& stored, const ExportOptions& options);

Exporter ExportKalibr, ExportOpenVins, ExportVins, ExportOrbSlam3, ExportKimera, ExportBasalt;
Exporter ExportEuroc, ExportVicon2Gt, ExportMocap2Gt, ExportLioSam, ExportFastLio, ExportPx4;
Exporter ExportEvo, ExportUrdf, ExportTf, ExportRos2;

}  // namespace imu_pose_calib
