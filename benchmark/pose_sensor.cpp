// Errors of pose sensors over simulated recordings: rms error, of the sigma that is stated, and
// (over the Cramer-Rao bound of a marker and a noise that are known). Below, those of the ground
// truth that follows for the sensor, at the stamps of its poses and from each to the next one.
//
//   pose_sensor [SEEDS = 20] [SECONDS = 40] [NAME]

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/pose_sensor/sensor_track.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

/// Least sigmas, norms over the axes, of p_MS [m], R_MS [rad] and time shift [s] when the marker's
/// trajectory, the sensor's noise and the density of its world's drift are known: by the Fisher
/// information at the truth; no code is shared with the solve. Outliers tell nothing.
std::array<double, 3> FindBound(const SimulatorOptions& options) {
  const SimulatedPoseSensor& own = options.pose_sensors[0];
  const TrueTrajectory trajectory(options);
  // p_MS, turn of R_MS, time shift, scale, p_VW, turn of R_VW; as good as unknown at first.
  using Matrix14d = Eigen::Matrix<double, 14, 14>;
  Matrix14d C = Matrix14d::Identity();
  if (own.scale == 1.0) C(7, 7) = 2e-3 * 2e-3;
  const auto count = static_cast<int>(options.duration_s * own.rate_hz);
  Eigen::Vector3d last_p_WS;
  for (int k = 0; k < count; ++k) {
    const TrueState s = trajectory.At(k / own.rate_hz);
    const Eigen::Matrix3d R_VW = own.T_VW.q.toRotationMatrix();
    const Eigen::Matrix3d R_MS = own.T_MS.q.toRotationMatrix();
    const Eigen::Vector3d p_WS = s.p_WM + s.R_WM * own.T_MS.p;
    const Eigen::Vector3d v_W = s.v_W + s.R_WM * s.omega_M.cross(own.T_MS.p);
    const Eigen::Matrix3d lever = own.scale * Hat(Eigen::Vector3d(R_VW * p_WS));
    // V moves on: by its walk about where the sensor is, anywhere at a jump.
    const double way = k == 0 ? 0.0 : (p_WS - last_p_WS).norm();
    last_p_WS = p_WS;
    Matrix6d walk = Matrix6d::Identity();
    walk.topLeftCorner<3, 3>() *= own.scale;
    walk.topRightCorner<3, 3>() = lever;
    walk.leftCols<3>() *= own.drift;
    walk.rightCols<3>() *= 0.1 * own.drift;
    C.bottomRightCorner<6, 6>() += way * walk * walk.transpose();
    const int pieces = own.jumps + 1;
    if (k > 0 && k * pieces / count != (k - 1) * pieces / count)
      C.bottomRightCorner<6, 6>() += Matrix6d::Identity();
    Eigen::Matrix<double, 6, 14> J = Eigen::Matrix<double, 6, 14>::Zero();
    J.block<3, 3>(0, 0) = own.scale * R_VW * s.R_WM;
    J.block<3, 1>(0, 6) = own.scale * R_VW * v_W;
    J.block<3, 1>(0, 7) = R_VW * p_WS;
    J.block<3, 3>(0, 8).setIdentity();
    J.block<3, 3>(0, 11) = -lever;
    J.block<3, 3>(3, 3).setIdentity();
    J.block<3, 1>(3, 6) = R_MS.transpose() * s.omega_M;
    J.block<3, 3>(3, 11) = (R_VW * s.R_WM * R_MS).transpose();
    J.topRows<3>() /= own.position_std;
    J.bottomRows<3>() /= own.rotation_std;
    C = (C.inverse() + (1.0 - own.outliers) * J.transpose() * J).inverse().eval();
  }
  return {std::sqrt(C.block<3, 3>(0, 0).trace()), std::sqrt(C.block<3, 3>(3, 3).trace()),
          std::sqrt(C(6, 6))};
}

/// Sums over poses of errors of the ground truth of the sensor.
struct TrackErrors {
  double position2 = 0.0, rotation2 = 0.0, count = 0.0;            ///< absolute, lengths
  double mount2 = 0.0;                                             ///< of position, by that of p_MS
  double step_position2 = 0.0, step_rotation2 = 0.0, steps = 0.0;  ///< from pose to pose
  double nees = 0.0, marker_nees = 0.0;  ///< all that is stated, and with the true T_MS and clock

  void Add(const SimulatorOptions& truth, const Calibration& result) {
    const SimulatedPoseSensor& own = truth.pose_sensors[0];
    const TrueTrajectory trajectory(truth);
    const auto T_WS = [&](double t) {
      const TrueState s = trajectory.At(t);
      return Rigid3{Eigen::Quaterniond(s.R_WM), s.p_WM} * own.T_MS;
    };
    const auto error = [](const ImuState& state, const Rigid3& of) {
      Vector6d e;
      e << Log(Eigen::Quaterniond(of.q.conjugate() * state.q_WB)), state.p_WB - of.p;
      return e;
    };
    const PoseSensorCalibration& sensor = result.pose_sensors[0];
    const SensorTrack track(result.solution, 0, sensor);
    PoseSensorCalibration known = sensor;
    known.T_MS = own.T_MS;
    known.covariance.setZero();
    const SensorTrack on_poses(result.solution, 0, known, TrackClock::kPoses);
    const double epoch =
        1e-9 * static_cast<double>(result.solution->pose_epochs_ns[0] - truth.start_ns);
    std::optional<std::pair<Rigid3, Rigid3>> last;  // true, found
    double last_t = 0.0;
    for (const ImuTrack::Instant& instant : track.Instants(0.0)) {
      const auto state = track.At(instant.t), marker = on_poses.At(instant.t);
      if (!state || !marker) continue;
      const double s =
          1e-9 * static_cast<double>(instant.stamp_ns - truth.start_ns) + own.time_shift_s;
      const Rigid3 was = T_WS(s + own.clock_drift * (s - 0.5 * truth.duration_s));
      const Rigid3 found{state->q_WB, state->p_WB};
      const Vector6d e = error(*state, was);
      rotation2 += e.head<3>().squaredNorm();
      position2 += e.tail<3>().squaredNorm();
      mount2 += (sensor.T_MS.p - own.T_MS.p).squaredNorm();
      count += 1.0;
      if (track.has_covariance()) {
        const auto nees_of = [](const Vector6d& x, const ImuState& of) {
          return x.dot(of.covariance.topLeftCorner<6, 6>().ldlt().solve(x)) / 6.0;
        };
        nees += nees_of(e, *state);
        marker_nees += nees_of(error(*marker, T_WS(instant.t + epoch)), *marker);
      }
      if (last && instant.t - last_t < 1.5 / own.rate_hz) {  // some poses were not used
        const Rigid3 step =
            (last->first.Inverse() * was).Inverse() * (last->second.Inverse() * found);
        step_position2 += step.p.squaredNorm();
        step_rotation2 += Log(step.q).squaredNorm();
        steps += 1.0;
      }
      last = {was, found};
      last_t = instant.t;
    }
  }
  void Print() const {
    const auto rms = [](double sum, double n) { return std::sqrt(sum / n); };
    constexpr double kDegrees = 180.0 / M_PI;
    std::printf(
        "    truth: %.3f mm (T_MS %.3f) %.4f deg | between %.4f mm %.5f deg | NEES %.2f, marker "
        "alone %.2f\n",
        1e3 * rms(position2, count), 1e3 * rms(mount2, count), kDegrees * rms(rotation2, count),
        1e3 * rms(step_position2, steps), kDegrees * rms(step_rotation2, steps), nees / count,
        marker_nees / count);
  }
};

struct Case {
  const char* name;
  bool has_imu;
  std::function<void(SimulatorOptions*)> set;
};

void Run(const Case& it, int seeds, double seconds) {
  double nees = 0.0, squares[3] = {}, predicted[3] = {}, bounds[3] = {};
  int count = 0, weak = 0, beyond = 0;
  TrackErrors track;
  const auto begin = std::chrono::steady_clock::now();
  for (int seed = 1; seed <= seeds; ++seed) {
    SimulatorOptions truth;
    truth.seed = 4000u + static_cast<uint32_t>(seed);
    truth.duration_s = seconds;
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
    if (sensor.status != Status::kOk) std::printf("  seed %d: %s\n", seed, sensor.message.c_str());
    if (sensor.status == Status::kDegenerate) continue;
    ++count;
    track.Add(truth, result);
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
  track.Print();
  std::fflush(stdout);
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  using imu_pose_calib::SimulatorOptions;
  const int seeds = argc > 1 ? std::atoi(argv[1]) : 20;
  const double seconds = argc > 2 ? std::atof(argv[2]) : 40.0;
  const std::string only = argc > 3 ? argv[3] : "";
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
      [=](SimulatorOptions* o) { o->position_std = o->rotation_std = 5e-3; },
  };
  const char* names[] = {"tags",  "tags, 20 % outliers", "odometry, 1 %",      "monocular",
                         "jumps", "foreign clock",       "tags, coarse marker"};
  for (const bool has_imu : {false, true})
    for (size_t k = 0; k < std::size(sensors); ++k) {
      const std::string name = std::string(names[k]) + (has_imu ? " + imu" : "");
      if (name.find(only) != std::string::npos)
        imu_pose_calib::Run({name.c_str(), has_imu, sensors[k]}, seeds, seconds);
    }
}
