// Errors of pose sensors over simulated recordings, against the bound of a marker that is known.
//
//   pose_sensor [SEEDS = 20]

#include <Eigen/Cholesky>
#include <algorithm>
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

using Vector7d = Eigen::Matrix<double, 7, 1>;

struct Case {
  const char* name;
  bool has_imu;
  std::function<void(SimulatorOptions*)> set;
};

void Run(const Case& it, int seeds) {
  double nees = 0.0, squares[3] = {}, predicted[3] = {};
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
    error << sensor.T_MS.p - own.T_MS.p, Log(Eigen::Quaterniond(own.T_MS.q.conjugate() * sensor.T_MS.q));
    const double dt = session.time_shift - own.time_shift_s;
    nees += error.dot(sensor.covariance.ldlt().solve(error)) / 7.0 +
            std::pow(dt / session.time_shift_std, 2) / 7.0;
    const Vector6d std = sensor.Std();
    const double errors[3] = {error.head<3>().norm(), error.tail<3>().norm(), dt};
    const double sigmas[3] = {std.head<3>().norm(), std.tail<3>().norm(), session.time_shift_std};
    for (int k = 0; k < 3; ++k) {
      squares[k] += errors[k] * errors[k];
      predicted[k] += sigmas[k] * sigmas[k];
      beyond += std::abs(errors[k]) > 3.0 * sigmas[k];
    }
    if (seed == 1)
      std::printf("  noise %.2f mm %.2f mrad drift %.3g mm %.3g mrad scale %.5f knots %zu %s\n",
                  1e3 * session.noise.position, 1e3 * session.noise.rotation,
                  1e3 * session.drift.position, 1e3 * session.drift.rotation, session.scale,
                  session.world.size(), sensor.message.c_str());
  }
  const double n = std::max(count, 1);
  const double s = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
  std::printf("%-28s n %2d weak %d beyond 3 sigma %d NEES %.2f", it.name, count, weak, beyond,
              nees / n);
  const char* units[3] = {"mm", "mrad", "ms"};
  for (int k = 0; k < 3; ++k)
    std::printf(" | %.3f of %.3f %s", 1e3 * std::sqrt(squares[k] / n),
                1e3 * std::sqrt(predicted[k] / n), units[k]);
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
      [=](SimulatorOptions* o) { first(o).drift = 0.01; first(o).position_std = 2e-3; first(o).rotation_std = 1e-3; },
      [=](SimulatorOptions* o) { first(o).scale = 0.3; },
      [=](SimulatorOptions* o) { first(o).jumps = 3; },
      [=](SimulatorOptions* o) { first(o).time_shift_s = 1034771.5; first(o).clock_drift = 3e-5; },
  };
  const char* names[] = {"tags", "tags, 20 % outliers", "odometry, 1 %", "monocular", "jumps", "foreign clock"};
  for (const bool has_imu : {false, true})
    for (size_t k = 0; k < std::size(sensors); ++k) {
      const std::string name = std::string(names[k]) + (has_imu ? " + imu" : "");
      if (name.find(only) != std::string::npos)
        imu_pose_calib::Run({name.c_str(), has_imu, sensors[k]}, seeds);
    }
}
