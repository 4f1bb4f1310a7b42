// Accuracy over simulated recordings of known truth: RMS error in units of the reported sigma, and
// normalised error squared per degree of freedom, of the model's and of the cluster-robust
// covariance. All are 1 for an efficient estimator that knows how sure it is.
//
//   accuracy [SEEDS = 30] [SECONDS = 40]

#include <Eigen/Cholesky>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibration/joint_solver.h"
#include "imu_pose_calib/core/calibration/knot_spacing.h"
#include "imu_pose_calib/core/start/preparation.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

/// Places of translation, rotation, time shift and accel delay in the errors.
constexpr int kTranslation = 0, kRotation = 3, kTimeShift = 6, kAccelDelay = 7, kSize = 8;
using Errors = Eigen::Matrix<double, kSize, 1>;
using Covariance = Eigen::Matrix<double, kSize, kSize>;

struct Trial {
  Errors errors;  ///< estimate less truth
  Covariance model, robust;
};

/// Calibrates a recording of the truth.
Trial Run(const SimulatorOptions& truth) {
  const CalibrationOptions options;
  DataCheck check;
  std::vector<PreparedSession> sessions = {Prepare(options, Simulate(truth), &check)};
  Estimate estimate(sessions[0], options.bias_knot_interval_s);
  const double spacing = ChooseKnotSpacing(options, sessions[0].data);
  const Solution solution = SolveJointly(options, {spacing}, &sessions, &estimate);
  const ConditionedData& data = sessions[0].data;
  const double epochs = 1e-9 * static_cast<double>(data.pose_epoch_ns - data.imus[0].epoch_ns);
  const ImuEstimate& imu = estimate.imus[0];
  Trial trial;
  trial.errors << imu.p_MI - truth.T_MI.p,
      Log(Eigen::Quaterniond(truth.T_MI.q.conjugate() * imu.q_MI)),
      estimate.sessions[0].imus[0].time_shift + epochs - truth.time_shift_s,
      imu.accel_delay - truth.accel_delay_s;

  const Marginals& marginals = solution.marginals;
  std::vector<int> places;
  const auto add = [&](ParameterKind kind, int size) {
    for (int i = 0; i < size; ++i) places.push_back(marginals.Find(kind) + i);
  };
  add(ParameterKind::kTranslation, 3);
  add(ParameterKind::kRotation, 3);
  add(ParameterKind::kTimeShift, 1);
  add(ParameterKind::kAccelDelay, 1);
  for (int i = 0; i < kSize; ++i) {
    for (int j = 0; j < kSize; ++j) {
      const int row = places[static_cast<size_t>(i)], column = places[static_cast<size_t>(j)];
      trial.model(i, j) = marginals.model(row, column);
      trial.robust(i, j) = marginals.robust(row, column);
    }
  }
  return trial;
}

/// Sums over trials of one group of parameters.
struct Group {
  const char* name;
  int place, size;
  double scale;  ///< from SI units to `unit`
  const char* unit;
  double squared_error = 0.0, variance = 0.0, model_nees = 0.0, robust_nees = 0.0;

  void Add(const Trial& trial) {
    const Eigen::VectorXd e = trial.errors.segment(place, size);
    const auto block = [this](const Covariance& C) {
      return Eigen::MatrixXd(C.block(place, place, size, size));
    };
    squared_error += e.squaredNorm();
    variance += block(trial.model).trace();
    model_nees += e.dot(block(trial.model).llt().solve(e)) / size;
    robust_nees += e.dot(block(trial.robust).llt().solve(e)) / size;
  }
};

void Report(double position_std, double rotation_std, int seeds, double duration_s) {
  Group groups[] = {{"translation", kTranslation, 3, 1e3, "mm"},
                    {"rotation", kRotation, 3, 180.0 / M_PI, "deg"},
                    {"time shift", kTimeShift, 1, 1e3, "ms"},
                    {"accel delay", kAccelDelay, 1, 1e3, "ms"},
                    {"all", 0, kSize, 0.0, ""}};
  for (int seed = 1; seed <= seeds; ++seed) {
    SimulatorOptions truth;
    truth.seed = 1000 + static_cast<unsigned>(seed);
    truth.duration_s = duration_s;
    truth.position_std = position_std;
    truth.rotation_std = rotation_std;
    truth.accel_delay_s = 2e-3;
    const Trial trial = Run(truth);
    for (Group& group : groups) group.Add(trial);
  }
  std::printf("\npose noise %g mm, %g mrad\n", 1e3 * position_std, 1e3 * rotation_std);
  for (const Group& group : groups) {
    std::printf("  %-12s", group.name);
    if (group.scale > 0.0)
      std::printf("%10.5f %-4s%11.2f", group.scale * std::sqrt(group.squared_error / seeds),
                  group.unit, std::sqrt(group.squared_error / group.variance));
    else
      std::printf("%26s", "");
    std::printf("%14.2f%14.2f\n", group.model_nees / seeds, group.robust_nees / seeds);
  }
  std::fflush(stdout);
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  const int seeds = argc > 1 ? std::atoi(argv[1]) : 30;
  const double duration_s = argc > 2 ? std::atof(argv[2]) : 40.0;
  if (seeds < 1 || !(duration_s > 0.0)) {
    std::fprintf(stderr, "usage: accuracy [SEEDS] [SECONDS]\n");
    return 1;
  }
  std::printf(
      "%d recordings of %g s each: RMS error, by the mean sigma; normalised error squared\n", seeds,
      duration_s);
  std::printf("%-18s%11s%11s%14s%14s\n", "", "RMS error", "/ sigma", "model", "robust");
  for (const double noise : {0.1e-3, 1e-3, 5e-3, 10e-3})
    imu_pose_calib::Report(noise, noise < 1e-3 ? 2.0 * noise : noise, seeds, duration_s);
  return 0;
}
