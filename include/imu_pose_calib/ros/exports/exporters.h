#pragma once

#include <vector>

#include "imu_pose_calib/ros/exports/exports.h"

namespace imu_pose_calib {

/// Writes the files of one program.
using Exporter = std::vector<ExportFile> (*)(const StoredResult& stored,
                                             const ExportOptions& options);

// Each states in the files that it writes what its keys mean.

std::vector<ExportFile> ExportKalibr(const StoredResult& stored, const ExportOptions& options);
std::vector<ExportFile> ExportOpenVins(const StoredResult& stored, const ExportOptions& options);
std::vector<ExportFile> ExportVins(const StoredResult& stored, const ExportOptions& options);
std::vector<ExportFile> ExportOrbSlam3(const StoredResult& stored, const ExportOptions& options);
std::vector<ExportFile> ExportKimera(const StoredResult& stored, const ExportOptions& options);
std::vector<ExportFile> ExportEuroc(const StoredResult& stored, const ExportOptions& options);
std::vector<ExportFile> ExportBasalt(const StoredResult& stored, const ExportOptions& options);
std::vector<ExportFile> ExportVicon2Gt(const StoredResult& stored, const ExportOptions& options);
std::vector<ExportFile> ExportMocap2Gt(const StoredResult& stored, const ExportOptions& options);
std::vector<ExportFile> ExportLioSam(const StoredResult& stored, const ExportOptions& options);
std::vector<ExportFile> ExportFastLio(const StoredResult& stored, const ExportOptions& options);
std::vector<ExportFile> ExportPx4(const StoredResult& stored, const ExportOptions& options);
std::vector<ExportFile> ExportEvo(const StoredResult& stored, const ExportOptions& options);
std::vector<ExportFile> ExportUrdf(const StoredResult& stored, const ExportOptions& options);
std::vector<ExportFile> ExportTf(const StoredResult& stored, const ExportOptions& options);
std::vector<ExportFile> ExportRos2(const StoredResult& stored, const ExportOptions& options);

}  // namespace imu_pose_calib
