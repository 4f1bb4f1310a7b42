// Ground truth of simulated recordings: how far the track of the IMU is from the truth at three
// noises of the poses, also while 1 s of the poses is missing every 10 s, and what it costs.
//
//   ground_truth accuracy [SEEDS = 5] [SECONDS = 40]
//   ground_truth cost MINUTES [MINUTES ...]      each in a process of its own for its peak memory

#include <sys/resource.h>

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <random>
#include <string>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/ground_truth/imu_track.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

constexpr double kPeriod = 10.0, kMissing = 1.0;  // [s] of which poses are missing
constexpr double kMaxGap = 2.0;                   // [s] that are carried

/// Rotation, position and velocity.
using Error = Eigen::Matrix<double, 9, 1>;
constexpr int kPlaces[] = {0, 3, 9};  // in the covariance

/// Sums over samples.
struct Sums {
  double count = 0.0, nees = 0.0;
  Eigen::Vector3d error2{0.0, 0.0, 0.0};    ///< of rotation, position, velocity, per axis
  Eigen::Vector3d variance{0.0, 0.0, 0.0};  ///< the same, as stated
  double lag = 0.0, speed2 = 0.0;           ///< of the position
  double within = 0.0, largest = 0.0;       ///< components within 3 sigma; largest in sigma

  void Add(const Error& e, const Eigen::Matrix<double, 9, 9>& C, const Eigen::Vector3d& v_W) {
    count += 1.0;
    nees += e.dot(C.llt().solve(e)) / 9.0;
    for (int k = 0; k < 3; ++k) {
      error2[k] += e.segment<3>(3 * k).squaredNorm() / 3.0;
      variance[k] += C.diagonal().segment<3>(3 * k).mean();
    }
    lag -= e.segment<3>(3).dot(v_W);
    speed2 += v_W.squaredNorm();
    for (int i = 0; i < 9; ++i) {
      const double sigmas = std::abs(e[i]) / std::sqrt(C(i, i));
      within += sigmas < 3.0 ? 1.0 / 9.0 : 0.0;
      largest = std::max(largest, sigmas);
    }
  }
  void Print(const char* name) const {
    const Eigen::Vector3d rms = (error2 / count).cwiseSqrt();
    const Eigen::Vector3d ratio = error2.cwiseQuotient(variance).cwiseSqrt();
    std::printf(
        "  %-10s rotation %.4f mrad (%.2f)  position %.4f mm (%.2f)  velocity %.3f mm/s (%.2f)  "
        "nees %.2f  lag %.4f ms  in 3 sigma %.2f %%, largest %.1f sigma, %.0f samples\n",
        name, 1e3 * rms[0], ratio[0], 1e3 * rms[1], ratio[1], 1e3 * rms[2], ratio[2], nees / count,
        1e3 * lag / speed2, 100.0 * within / count, largest, count);
  }
};

struct Accuracy {
  Sums followed, carried;
  double gaps = 0.0, gaps_carried = 0.0;
};

void Compare(const SimulatorOptions& truth, bool with_gaps, Accuracy* sums) {
  SessionData data = Simulate(truth);
  if (with_gaps) {
    const auto is_missing = [&truth](const PoseSample& pose) {
      const double t = 1e-9 * static_cast<double>(pose.t_ns - truth.start_ns);
      return std::fmod(t, kPeriod) > kPeriod - kMissing;
    };
    data.poses.erase(std::remove_if(data.poses.begin(), data.poses.end(), is_missing),
                     data.poses.end());
  }
  const Calibration result = Calibrate({}, data);
  if (!result.solution) return;
  const ImuTrack track(result.solution, 0, 0, TrackClock::kImu, kMaxGap);
  for (const TrackGap& gap : track.gaps()) {
    sums->gaps += 1.0;
    sums->gaps_carried += gap.carried.empty() ? 0.0 : 1.0;
  }
  const TrueTrajectory trajectory(truth);
  for (const ImuTrack::Instant& instant : track.Instants(0.0)) {
    const auto x = track.At(instant.t);
    if (!x) continue;
    // The shift holds at mid-recording.
    const double t_imu = 1e-9 * static_cast<double>(instant.stamp_ns - truth.start_ns);
    const TrueState s = trajectory.At(t_imu + truth.time_shift_s +
                                      truth.clock_drift * (t_imu - 0.5 * truth.duration_s));
    const Eigen::Quaterniond q_WI = Eigen::Quaterniond(s.R_WM) * truth.T_MI.q;
    const Eigen::Vector3d v_WI = s.v_W + s.R_WM * s.omega_M.cross(truth.T_MI.p);
    Error e;
    e << Log(Eigen::Quaterniond(q_WI.conjugate() * x->q_WB)),
        x->p_WB - s.p_WM - s.R_WM * truth.T_MI.p, x->v_W - v_WI;
    Eigen::Matrix<double, 9, 9> C;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        C.block<3, 3>(3 * i, 3 * j) = x->covariance.block<3, 3>(kPlaces[i], kPlaces[j]);
    (x->is_carried ? sums->carried : sums->followed).Add(e, C, v_WI);
  }
}

/// Scale, misalignment and drift as the priors of the solve expect them.
void DrawUnknowns(SimulatorOptions* truth) {
  std::mt19937 random(truth->seed);
  std::normal_distribution<double> normal;
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 3; ++column) {
      const double sigma = row == column ? 0.01 : M_PI / 360.0;
      if (column <= row) truth->gyro_matrix(row, column) += sigma * normal(random);
      truth->accel_matrix(row, column) += sigma * normal(random);
    }
  truth->clock_drift = 1e-4 * normal(random);
}

void PrintAccuracy(uint32_t seeds, double seconds) {
  std::printf("RMS errors per axis at the stamps of the imu, in brackets over the rms sigma\n");
  for (const double noise : {1e-4, 1e-3, 5e-3}) {
    for (const bool with_gaps : {false, true}) {
      Accuracy sums;
      for (uint32_t seed = 1; seed <= seeds; ++seed) {
        SimulatorOptions truth;
        truth.seed = 1000 + seed;
        truth.duration_s = seconds;
        truth.position_std = noise;
        truth.rotation_std = noise == 1e-4 ? 2e-4 : noise;
        DrawUnknowns(&truth);
        Compare(truth, with_gaps, &sums);
      }
      std::printf("poses %.1f mm%s: position rms over that of the poses %.3f\n", 1e3 * noise,
                  with_gaps ? ", 1 s in 10 missing" : "",
                  std::sqrt(sums.followed.error2[1] / sums.followed.count) / noise);
      sums.followed.Print("followed");
      if (!with_gaps) continue;
      std::printf("  %.0f of %.0f gaps carried\n", sums.gaps_carried, sums.gaps);
      sums.carried.Print("carried");
    }
  }
}

/// Of all threads since `start`, which other work on the machine hardly changes.
double CpuSeconds(std::clock_t start) {
  return static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC;
}

double PeakGib() {
  rusage usage;
  getrusage(RUSAGE_SELF, &usage);
  return static_cast<double>(usage.ru_maxrss) / (1024.0 * 1024.0);
}

void PrintCost(double minutes) {
  SimulatorOptions truth;
  truth.seed = 7;
  truth.duration_s = 60.0 * minutes;
  std::clock_t start = std::clock();
  const SessionData data = Simulate(truth);
  std::printf("%.0f min: simulation %.1f s", minutes, CpuSeconds(start));
  start = std::clock();
  CalibrationOptions options;
  options.max_factor_mb = 1e6;  // the covariance needs it
  const Calibration result = Calibrate(options, data);
  std::printf(", calibration %.1f s, peak %.2f GiB", CpuSeconds(start), PeakGib());
  start = std::clock();
  const ImuTrack track(result.solution, 0, 0, TrackClock::kImu, kMaxGap);
  double count = 0.0, sum = 0.0;
  for (const ImuTrack::Instant& instant : track.Instants(0.0)) {
    const auto x = track.At(instant.t);
    if (!x) continue;
    count += 1.0;
    sum += x->covariance.trace();
  }
  std::printf(", %.0f samples %.1f s, peak %.2f GiB (mean trace %.2g)\n", count, CpuSeconds(start),
              PeakGib(), sum / count);
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  const std::string what = argc > 1 ? argv[1] : "";
  if (what == "accuracy") {
    const int seeds = argc > 2 ? std::atoi(argv[2]) : 5;
    imu_pose_calib::PrintAccuracy(static_cast<uint32_t>(seeds),
                                  argc > 3 ? std::atof(argv[3]) : 40.0);
    return 0;
  }
  if (what == "cost") {
    for (int k = 2; k < argc; ++k) imu_pose_calib::PrintCost(std::atof(argv[k]));
    return 0;
  }
  std::fprintf(stderr, "usage: ground_truth accuracy [SEEDS] [SECONDS] | cost MINUTES\n");
  return 1;
}
