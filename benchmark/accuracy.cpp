// Accuracy over simulated recordings of known truth: RMS error in units of the reported sigma, and
// normalised error squared per degree of freedom, of the model's and of the cluster-robust
// covariance. All are 1 for an efficient estimator that knows how sure it is.
//
//   accuracy [SEEDS = 30] [SECONDS = 40]

#include <Eigen/Cholesky>
#include <cmath>
#include <cstdio>
#include <cstdlib>

#include "imu_pose_calib/core/conditioning.h"
#include "imu_pose_calib/core/initializer.h"
#include "imu_pose_calib/core/joint_solver.h"
#include "imu_pose_calib/core/pose_trajectory.h"
#include "imu_pose_calib/core/simulator.h"
#include "imu_pose_calib/core/so3.h"

namespace imu_pose_calib {
namespace {

constexpr int kSize = kAccelDelay + 1;  // translation, rotation, time shift, accel delay
using Errors = Eigen::Matrix<double, kSize, 1>;
using Covariance = Eigen::Matrix<double, kSize, kSize>;

struct Trial {
  Errors errors;  ///< estimate less truth, in the order of CalibrationIndex
  Covariance model, robust;
};

/// Calibrates a recording of the truth.
Trial Run(const SimulatorOptions& truth) {
  const CalibrationOptions options;
  ConditionedData data = Condition(options, Simulate(truth));
  const PoseTrajectory trajectory = FitTrajectory(options, &data);
  Estimate estimate(Initialise(options, trajectory, data), data, options.bias_knot_interval_s);
  const JointStart start = ChooseKnotSpacing(options, trajectory, data, &estimate);
  const Solution solution = SolveJointly(options, trajectory, data, start, &estimate);
  const double epochs = 1e-9 * static_cast<double>(data.pose_epoch_ns - data.imu_epoch_ns);
  Trial trial;
  trial.errors << estimate.p_MI - truth.T_MI.p,
      Log(Eigen::Quaterniond(truth.T_MI.q.conjugate() * estimate.q_MI)),
      estimate.time_shift + epochs - truth.time_shift_s, estimate.accel_delay - truth.accel_delay_s;
  trial.model = solution.covariance.model.topLeftCorner<kSize, kSize>();
  trial.robust = solution.covariance.robust.topLeftCorner<kSize, kSize>();
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
      std::printf("%10.5f %-4s%11.2f",
                  group.scale * std::sqrt(group.squared_error / seeds),
                  group.unit,
                  std::sqrt(group.squared_error / group.variance));
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
      "%d recordings of %g s each: RMS error, by the mean sigma; normalised error squared\n",
      seeds,
      duration_s);
  std::printf("%-18s%11s%11s%14s%14s\n", "", "RMS error", "/ sigma", "model", "robust");
  for (const double noise : {0.1e-3, 1e-3, 5e-3, 10e-3})
    imu_pose_calib::Report(noise, noise < 1e-3 ? 2.0 * noise : noise, seeds, duration_s);
  return 0;
}
