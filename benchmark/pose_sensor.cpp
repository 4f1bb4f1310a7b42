// Errors of pose sensors over simulated recordings of 40 s: rms error, of the sigma that is stated,
// and (over the Cramer-Rao bound of a marker and a noise that are known).
//
//   pose_sensor [SEEDS = 20] [NAME]

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <string>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

/// Least sigmas, norms over the axes, of p_MS [m], R_MS [rad] and time shift [s] when the marker's
/// trajectory and the sensor's noise are known and its world does not drift: by the Fisher
/// information at the truth; no code is shared with the solve. Outliers tell nothing.
std::array<double, 3> FindBound(const SimulatorOptions& options) {
  const SimulatedPoseSensor& own = options.pose_sensors[0];
  const TrueTrajectory trajectory(options);
  // p_MS, turn of R_MS, time shift, scale, then p_VW and turn of R_VW of each piece.
  const int columns = 8 + 6 * (own.jumps + 1);
  Eigen::MatrixXd information = Eigen::MatrixXd::Zero(columns, columns);
  if (own.scale == 1.0) information(7, 7) = 1.0 / (2e-3 * 2e-3);
  const auto count = static_cast<int>(options.duration_s * own.rate_hz);
  for (int k = 0; k < count; ++k) {
    const TrueState s = trajectory.At(k / own.rate_hz);
    const Eigen::Matrix3d R_VW = own.T_VW.q.toRotationMatrix();
    const Eigen::Matrix3d R_MS = own.T_MS.q.toRotationMatrix();
    const Eigen::Vector3d p_WS = s.p_WM + s.R_WM * own.T_MS.p;
    const Eigen::Vector3d v_W = s.v_W + s.R_WM * s.omega_M.cross(own.T_MS.p);
    const int piece = 8 + 6 * (k * (own.jumps + 1) / count);
    Eigen::MatrixXd J = Eigen::MatrixXd::Zero(6, columns);
    J.block<3, 3>(0, 0) = own.scale * R_VW * s.R_WM;
    J.block<3, 1>(0, 6) = own.scale * R_VW * v_W;
    J.block<3, 1>(0, 7) = R_VW * p_WS;
    J.block<3, 3>(0, piece).setIdentity();
    J.block<3, 3>(0, piece + 3) = -own.scale * Hat(Eigen::Vector3d(R_VW * p_WS));
    J.block<3, 3>(3, 3).setIdentity();
    J.block<3, 1>(3, 6) = R_MS.transpose() * s.omega_M;
    J.block<3, 3>(3, piece + 3) = (R_VW * s.R_WM * R_MS).transpose();
    J.topRows<3>() /= own.position_std;
    J.bottomRows<3>() /= own.rotation_std;
    information += (1.0 - own.outliers) * J.transpose() * J;
  }
  const Eigen::MatrixXd C = information.inverse();
  return {std::sqrt(C.block<3, 3>(0, 0).trace()), std::sqrt(C.block<3, 3>(3, 3).trace()),
          std::sqrt(C(6, 6))};
}

struct Case {
  const char* name;
  bool has_imu;
  std::function<void(SimulatorOptions*)> set;
};

void Run(const Case& it, int seeds) {
  double nees = 0.0, squares[3] = {}, predicted[3] = {}, bounds[3] = {};
  int count = 0, weak = 0, beyond = 0;
  const auto begin = std::chrono::steady_clock::now();
  for (int seed = 1; seed <= seeds; ++seed) {
    SimulatorOptions truth;
    truth.seed = 4000u + static_cast<uint32_t>(seed);
    truth.duration_s = 40.0;
    truth.pose_sensors.resize(1);
    it.set(&truth);
    SessionData data = Simulate(truth);
    if (!it.has_imu) data.imus.clear();
    CalibrationOptions options;
    options.estimate_sensor_scale = truth.pose_sensors[0].scale != 1.0;
    Calibration result;
    try {
      result = Calibrate(options, data);
    } catch (const std::exception& error) {
      std::printf("  seed %d: %s\n", seed, error.what());
      continue;
    }
    const PoseSensorCalibration& sensor = result.pose_sensors[0];
    const SimulatedPoseSensor& own = truth.pose_sensors[0];
    const PoseSensorSession& session = sensor.sessions[0];
    weak += sensor.status != Status::kOk;
    if (sensor.status == Status::kDegenerate) {
      std::printf("  seed %d: %s\n", seed, sensor.message.c_str());
      continue;
    }
    ++count;
    Vector6d error;
    error << sensor.T_MS.p - own.T_MS.p,
        Log(Eigen::Quaterniond(own.T_MS.q.conjugate() * sensor.T_MS.q));
    const double dt = session.time_shift - own.time_shift_s;
    nees += error.dot(sensor.covariance.ldlt().solve(error)) / 7.0 +
            std::pow(dt / session.time_shift_std, 2) / 7.0;
    const Vector6d std = sensor.Std();
    const std::array<double, 3> bound = FindBound(truth);
    const double errors[3] = {error.head<3>().norm(), error.tail<3>().norm(), dt};
    const double sigmas[3] = {std.head<3>().norm(), std.tail<3>().norm(), session.time_shift_std};
    for (int k = 0; k < 3; ++k) {
      squares[k] += errors[k] * errors[k];
      predicted[k] += sigmas[k] * sigmas[k];
      bounds[k] += bound[k] * bound[k];
      beyond += std::abs(errors[k]) > 3.0 * sigmas[k];
    }
  }
  const double n = std::max(count, 1);
  const double s = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  std::printf("%-28s n %2d weak %d beyond 3 sigma %d NEES %.2f", it.name, count, weak, beyond,
              nees / n);
  const char* units[3] = {"mm", "mrad", "ms"};
  for (int k = 0; k < 3; ++k)
    std::printf(" | %.3f of %.3f %s (%.2f)", 1e3 * std::sqrt(squares[k] / n),
                1e3 * std::sqrt(predicted[k] / n), units[k], std::sqrt(squares[k] / bounds[k]));
  std::printf(" | %.2f s\n", s / seeds);
  std::fflush(stdout);
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  using imu_pose_calib::SimulatorOptions;
  const int seeds = argc > 1 ? std::atoi(argv[1]) : 20;
  const std::string only = argc > 2 ? argv[2] : "";
  const auto first = [](SimulatorOptions* o) -> imu_pose_calib::SimulatedPoseSensor& {
    return o->pose_sensors[0];
  };
  const std::function<void(SimulatorOptions*)> sensors[] = {
      [](SimulatorOptions*) {},
      [=](SimulatorOptions* o) { first(o).outliers = 0.2; },
      [=](SimulatorOptions* o) {
        first(o).drift = 0.01;
        first(o).position_std = 2e-3;
        first(o).rotation_std = 1e-3;
      },
      [=](SimulatorOptions* o) { first(o).scale = 0.3; },
      [=](SimulatorOptions* o) { first(o).jumps = 3; },
      [=](SimulatorOptions* o) {
        first(o).time_shift_s = 1034771.5;
        first(o).clock_drift = 3e-5;
      },
  };
  const char* names[] = {"tags",  "tags, 20 % outliers", "odometry, 1 %", "monocular",
                         "jumps", "foreign clock"};
  for (const bool has_imu : {false, true})
    for (size_t k = 0; k < std::size(sensors); ++k) {
      const std::string name = std::string(names[k]) + (has_imu ? " + imu" : "");
      if (name.find(only) != std::string::npos)
        imu_pose_calib::Run({name.c_str(), has_imu, sensors[k]}, seeds);
    }
}
