#pragma once

#include <string>

#include "imu_pose_calib/core/types.h"

namespace imu_pose_calib {

/// Decimal seconds, exact: "-12.000000345".
std::string SecondsText(int64_t t_ns);

// Both write stamps and values so that ReadText() gets back the very same data, and throw
// InputError when a file cannot be written or when one file is to hold gyroscope and accelerometer
// samples of different stamps.

/// ASL dataset (EuRoC) of poses and IMU: folder/mocap0/data.csv and folder/imu0/data.csv.
void WriteAslFolder(const std::string& folder, const SessionData& data);

/// Tables without any folder: prefix.poses.txt (TUM) and prefix.imu.csv, or for a split IMU
/// prefix.gyro.csv and prefix.accel.csv.
void WriteTables(const std::string& prefix, const SessionData& data, bool split_imu);

}  // namespace imu_pose_calib
