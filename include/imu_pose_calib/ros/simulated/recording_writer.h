#pragma once

#include <optional>
#include <string>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/bag_file.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {

/// Shape of a written bag.
struct BagFormat {
  /// Gyroscope and accelerometer on /imu/gyro and /imu/accel instead of both on /imu.
  bool split_imu = false;
  /// "PoseStamped", "TransformStamped", "PoseWithCovarianceStamped" (geometry_msgs), "Odometry"
  /// (nav_msgs) or "tf": an arm of six joints from base, fixed in the world, to the marker. Each
  /// message on /tf moves the last joint and one of the others.
  std::string pose_type = "PoseStamped";
  /// "Imu" (sensor_msgs) or "Vector3Stamped" (geometry_msgs), which is always split.
  std::string imu_type = "Imu";
  std::optional<Ros2Format> ros2 = std::nullopt;  ///< none: a bag of ROS 1
};

/// What to add to the stamps of a sensor to get their record times: 0 or, when its clock starts
/// more than a day from that of the poses, what lets both start together. Of the first stamps [ns].
int64_t RecordOffset(int64_t first_ns, int64_t first_pose_ns);

/// Writes poses on /mocap/pose or /tf (frame world, child marker) and IMU samples (frame imu);
/// further IMUs that have samples on /imu1 (frame imu1) and so on, as Imu, recorded as if they had
/// all started together; pose sensors on /pose_sensor (frame pose_sensor_world), /pose_sensor1 and
/// so on, as PoseStamped.
/// Record times are header times plus RecordOffset().
///
/// Throws InputError when the file cannot be written, when a type is unknown, or when one
/// topic is to hold gyroscope and accelerometer samples of different stamps.
void WriteBag(const std::string& path, const SessionData& data, const BagFormat& format);

// Both write stamps and values so that ReadText() gets back the very same data, and throw
// InputError when a file cannot be written or when one file is to hold gyroscope and accelerometer
// samples of different stamps. `outputs`: of a run with more files, which commits them.

/// ASL dataset (EuRoC) of poses and IMU: folder/mocap0/data.csv and folder/imu0/data.csv; pose
/// sensors in pose_sensor0 and so on.
void WriteAslFolder(const std::string& folder, const SessionData& data,
                    OutputFiles* outputs = nullptr);

/// Tables without any folder: prefix.poses.txt (TUM) and prefix.imu.csv, or for a split IMU
/// prefix.gyro.csv and prefix.accel.csv; pose sensors prefix.pose_sensor.txt, .pose_sensor1.txt and
/// so on.
void WriteTables(const std::string& prefix, const SessionData& data, bool split_imu,
                 OutputFiles* outputs = nullptr);

/// Truth of a simulated bag as YAML: rotation [x, y, z, w] and translation of T_marker_imu,
/// time_shift, accel_delay, gravity, gyro_bias, accel_bias; of pose sensors T_marker_sensor and
/// time_shift.
std::string TruthYaml(const SimulatorOptions& options);

}  // namespace imu_pose_calib
