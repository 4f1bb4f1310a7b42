#pragma once

// Compares what was read back from an exported file with the result of stored_example.h.

#include <cmath>
#include <string>

#include "export_parsers.h"
#include "imu_pose_calib/ros/exports/exports.h"
#include "stored_example.h"
#include "test_util.h"

namespace imu_pose_calib {

/// Text of the file with that ending.
inline std::string FileOf(const StoredResult& stored, const std::string& name,
                          const std::string& ending, const ExportChoice& choice = {}) {
  for (const ExportFile& file : Export(stored, name, choice))
    if (file.ending == ending) return file.text;
  ADD_FAILURE() << name << " has no " << ending;
  return "";
}

inline Eigen::Matrix4d T_MI(const StoredResult& stored, size_t imu = 0) {
  return stored.result.imus[imu].T_MI.Matrix();
}

inline double TimeShift(const StoredResult& stored, size_t imu = 0) {
  return stored.Clock(imu).time_shift;
}

/// Expects that a point is mapped to the same place.
inline void ExpectSame(const Eigen::Matrix4d& T_XY, const Eigen::Matrix4d& expected) {
  const Eigen::Vector4d point(0.3, -1.7, 2.9, 1.0);
  EXPECT_LT((T_XY * point - expected * point).norm(), 1e-9) << T_XY << "\n\n" << expected;
  EXPECT_LT((T_XY - expected).norm(), 1e-9);
}

/// The stamp of the pose that is taken at the IMU's stamp, from what a consumer adds to a pose's
/// stamp to have that of the IMU.
inline void ExpectStamp(double pose_to_imu, const StoredResult& stored) {
  const double t_imu = 12.5, t_pose = t_imu + TimeShift(stored);
  EXPECT_NEAR(t_pose + pose_to_imu, t_imu, 1e-12);
}

/// Of the pose sensor `k` of AddSensors(): x_S = T x_I.
inline Eigen::Matrix4d T_SI(const StoredResult& stored, size_t k) {
  return stored.result.pose_sensors[k].T_MS.Matrix().inverse() * T_MI(stored);
}

/// The stamp of the IMU for what pose sensor `k` stamps, from what a consumer adds to the stamp of
/// the sensor; at the middle of the recording, by the drift of the sensor's clock.
inline void ExpectSensorStamp(double sensor_to_imu, const StoredResult& stored, size_t k) {
  const PoseSensorSession& sensor = stored.result.pose_sensors[k].sessions[0];
  const double t_imu = stored.Clock(0).clock_reference, t_sensor = t_imu - sensor_to_imu;
  const double t_pose =
      t_sensor + sensor.time_shift + sensor.clock_drift * (t_sensor - sensor.clock_reference);
  EXPECT_NEAR(t_pose, t_imu + TimeShift(stored), 1e-6);  // of doubles of this epoch
}

/// Densities times the root of the rates are the sigmas of the result.
inline void ExpectNoise(double gyro, double gyro_walk, double accel, double accel_walk,
                        size_t imu = 0) {
  const double k = static_cast<double>(imu) + 1.0;
  EXPECT_NEAR(gyro * std::sqrt(200.0), 0.0021 * k, 1e-12);
  EXPECT_NEAR(accel * std::sqrt(250.0), 0.043 * k, 1e-12);
  EXPECT_EQ(gyro_walk, 3e-5);
  EXPECT_EQ(accel_walk, 7e-4);
}

inline void ExpectNoise(const YAML::Node& node, size_t imu = 0) {
  ExpectNoise(node["gyroscope_noise_density"].as<double>(),
              node["gyroscope_random_walk"].as<double>(),
              node["accelerometer_noise_density"].as<double>(),
              node["accelerometer_random_walk"].as<double>(), imu);
}

}  // namespace imu_pose_calib
