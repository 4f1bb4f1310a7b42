#pragma once

#include <exception>
#include <string>

#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/data_check.h"
#include "imu_pose_calib/ros/bag_reader.h"
#include "imu_pose_calib/ros/recording.h"

namespace imu_pose_calib {

/// Calibration of one bag as calibrate_bag and calibrate_node offer it. Empty: the default.
struct OfflineRequest {
  BagRequest bag;
  std::string config;  ///< YAML of CalibrationOptions
  std::string method;  ///< name of a Method; wins over `config`
  std::string output;  ///< result YAML; default: bag path with .calibration.yaml for .bag
  std::string marker_frame, imu_frame;  ///< replace the names found in the bag
};

/// A usable calibration and what to do with it.
struct OfflineResult {
  Calibration result;
  RecordingInfo info;
  std::string output;  ///< path of the result file, not written yet
  std::string yaml;    ///< its text
};

/// Reads the bag and calibrates. A result of an earlier run at the output path is removed first, so
/// that a failure leaves none behind.
///
/// Throws InputError when something cannot be used as given, DataError when no calibration can come
/// from the data: so the result is always usable.
OfflineResult CalibrateOffline(const OfflineRequest& request);

/// Checks of one bag without a calibration.
struct OfflineCheck {
  DataCheck check;
  RecordingInfo info;
};

/// Reads the bag and judges it; writes and removes nothing.
/// Throws InputError when something cannot be used as given.
OfflineCheck CheckOffline(const OfflineRequest& request);

/// Exit status of an executable that failed: 2 for data that cannot be calibrated, else 1.
int ExitStatus(const std::exception& error);

/// The text of an error on one line.
std::string OneLine(const std::exception& error);

}  // namespace imu_pose_calib
