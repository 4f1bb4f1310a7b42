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

/// A camera and a lidar, which the last of the sessions alone has.
inline void AddSensors(Calibration* result, RecordingInfo* info) {
  for (const double k : {1.0, 2.0}) {
    PoseSensorCalibration& sensor = result->pose_sensors.emplace_back();
    sensor.status = k == 1.0 ? Status::kOk : Status::kWeak;
    sensor.message = k == 1.0 ? "every sigma is within its bound" : "sigma of p_MS is 11 mm";
    sensor.T_MS = {Exp(Eigen::Vector3d(-0.5, 0.9 * k, 0.3)), {0.31, 0.07 * k, -0.19}};
    sensor.covariance =
        (Vector6d() << 4e-6, 1e-6, 16e-6, 4e-8, 1e-8, 25e-8).finished().asDiagonal();
    sensor.covariance(0, 4) = sensor.covariance(4, 0) = 1e-8;
    sensor.observability = {{"p_MS along marker z", 4e-3, "m", Status::kOk}};
    sensor.sessions.resize(result->sessions.size());
    PoseSensorSession& session = sensor.sessions.back();
    session.is_present = true;
    session.time_shift = -0.021 * k;
    session.time_shift_std = 2e-4;
    session.clock_drift = 3e-4;
    session.clock_drift_std = 1e-6;
    session.clock_reference = 1600000007.25;
    session.scale = 1.0 + 0.25 * k;
    session.scale_std = 3e-4;
    session.noise = {0.0051, 0.0062};
    session.rms = {0.0053, 0.0064};
    session.drift = {0.0011, 0.0007};
    const auto knot = [&](double t, bool begins) {
      session.world.push_back({t, {Exp(Eigen::Vector3d(t, 0.2, 0.1)), {t, 2.0, 3.0}}, begins});
    };
    knot(0.5, true);
    knot(1.5, false);
    knot(2.5, true);
    session.poses.used = 1790;
    session.poses.outlier = 12;
    session.poses.rate_hz = 30.0;
    session.poses.duration_s = 59.5;
    const std::string name = k == 1.0 ? "camera" : "lidar";
    info->pose_sensors.push_back({"/" + name + "/pose", name + "_link", name + "_map"});
  }
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

/// With the pose sensors.
inline std::string SensorYaml(size_t imus = 1, ImuModel model = ImuModel::kCalibrated) {
  Calibration result = ExampleResult(model, imus);
  RecordingInfo info = ExampleInfo(imus);
  AddSensors(&result, &info);
  return ToYaml(result, {info}, ExampleOptions());
}

inline StoredResult SensorExample(size_t imus = 1, ImuModel model = ImuModel::kCalibrated) {
  return ParseResult(SensorYaml(imus, model), "dir/my.calibration.yaml");
}

}  // namespace imu_pose_calib
