#pragma once

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/ros/io/result_yaml.h"

namespace imu_pose_calib {

/// A result that no mix-up of direction, sign, axis or element leaves as it is.
inline Calibration ExampleResult(ImuModel model, size_t imus) {
  Calibration result;
  result.status = Status::kWeak;
  result.message = "sigma of p_MI is 12 mm -- use with care";
  result.imu_model = model;
  result.imus.resize(imus);
  SessionCalibration& session = result.sessions[0];
  session.imus.resize(imus);
  session.g_W = {1.0, -2.0, -9.5};
  session.noise = {0.0012, 0.0034};
  session.poses.rate_hz = 120.0;
  session.poses.duration_s = 60.0;
  for (size_t i = 0; i < imus; ++i) {
    const double k = static_cast<double>(i) + 1.0;
    ImuCalibration& imu = result.imus[i];
    imu.T_MI = {Exp(Eigen::Vector3d(0.7 * k, -0.4, 1.1)), {0.11 * k, -0.23, 0.37}};
    imu.covariance = (Vector6d() << 1e-6, 4e-6, 9e-6, 1e-8, 4e-8, 9e-8).finished().asDiagonal();
    imu.accel_delay = 0.0031 * k;
    imu.accel_delay_std = 2e-5;
    if (model == ImuModel::kScaleMisalignment) {
      imu.gyro_matrix << 1.01, 0.0, 0.0, -0.004, 0.99, 0.0, 0.006, 0.003, 1.02;
      imu.accel_matrix << 0.98, 0.01, -0.02, 0.005, 1.03, 0.015, -0.008, 0.012, 0.995;
      imu.accel_positions << 1e-3, 2e-3, -3e-3, 4e-3, 5e-3, 6e-3, -7e-3, 8e-3, 9e-3;
    }
    ImuSession& clock = session.imus[i];
    clock.is_present = true;
    clock.time_shift = 0.0437 + 0.25 * static_cast<double>(i);
    clock.time_shift_std = 1e-5;
    clock.clock_drift = 2e-6;
    clock.clock_drift_std = 1e-6;
    clock.clock_reference = 1600000000.5;
    clock.gyro_bias = {0.01, -0.02, 0.03};
    clock.accel_bias = {0.1, -0.2, 0.3};
    clock.noise = {0.0021 * k, 0.043 * k};
    clock.gyro.rate_hz = 200.0;
    clock.accel.rate_hz = 250.0;
  }
  return result;
}

inline RecordingInfo ExampleInfo(size_t imus) {
  RecordingInfo info;
  info.bag = "x.bag";
  info.pose_topic = "/vicon/rig";
  info.world_frame = "world";
  info.marker_frame = "rig/marker";
  info.imus.resize(imus);
  for (size_t i = 0; i < imus; ++i) {
    info.imus[i].imu_topic = "/imu" + std::to_string(i);
    info.imus[i].imu_frame = "imu_" + std::to_string(i) + "_link";
  }
  return info;
}

inline CalibrationOptions ExampleOptions() {
  CalibrationOptions options;
  options.gyro_bias_walk = 3e-5;
  options.accel_bias_walk = 7e-4;
  return options;
}

inline std::string ExampleYaml(ImuModel model = ImuModel::kCalibrated, size_t imus = 1) {
  return ToYaml(ExampleResult(model, imus), {ExampleInfo(imus)}, ExampleOptions());
}

inline StoredResult Example(ImuModel model = ImuModel::kCalibrated, size_t imus = 1) {
  return ParseResult(ExampleYaml(model, imus), "dir/my.calibration.yaml");
}

}  // namespace imu_pose_calib
