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
                          const std::string& ending,
                          const Eigen::Quaterniond& q_body_imu = Eigen::Quaterniond::Identity()) {
  for (const ExportFile& file : Export(stored, name, q_body_imu))
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
