#include <benchmark/benchmark.h>
#include <ceres/cost_function.h>

#include <memory>
#include <vector>

#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/conditioning.h"
#include "imu_pose_calib/core/joint_residuals.h"
#include "imu_pose_calib/core/joint_solver.h"
#include "imu_pose_calib/core/pose_trajectory.h"
#include "imu_pose_calib/core/preparation.h"
#include "imu_pose_calib/core/simulator.h"

namespace imu_pose_calib {
namespace {

SessionData Recording(double duration_s) {
  SimulatorOptions options;
  options.duration_s = duration_s;
  return Simulate(options);
}

/// S1 on `range` seconds of poses at 100 Hz.
void BenchmarkFitTrajectory(benchmark::State& state) {
  const CalibrationOptions options;
  const ConditionedData data =
      ConditionData(options, Recording(static_cast<double>(state.range(0))));
  for (auto _ : state) {
    ConditionedData copy = data;
    benchmark::DoNotOptimize(FitTrajectory(options, &copy));
  }
}
BENCHMARK(BenchmarkFitTrajectory)->Arg(20)->Arg(40)->Arg(80)->Unit(benchmark::kMillisecond);

/// One query of value and derivatives, and one of the variances.
void BenchmarkTrajectoryQuery(benchmark::State& state) {
  const CalibrationOptions options;
  ConditionedData data = ConditionData(options, Recording(20.0));
  const PoseTrajectory trajectory = FitTrajectory(options, &data);
  MarkerState<double> motion, rate;
  double t = 1.0;
  for (auto _ : state) {
    t = t < 19.0 ? t + 0.0137 : 1.0;
    benchmark::DoNotOptimize(trajectory.Evaluate(t, &motion, &rate));
  }
}
BENCHMARK(BenchmarkTrajectoryQuery);

void BenchmarkTrajectoryVariance(benchmark::State& state) {
  const CalibrationOptions options;
  ConditionedData data = ConditionData(options, Recording(20.0));
  const PoseTrajectory trajectory = FitTrajectory(options, &data);
  double t = 1.0;
  for (auto _ : state) {
    t = t < 19.0 ? t + 0.0137 : 1.0;
    benchmark::DoNotOptimize(trajectory.Variance(t));
  }
}
BENCHMARK(BenchmarkTrajectoryVariance);

/// Residuals and Jacobians of `range` accelerometer samples in one block, the joint solve's
/// largest.
void BenchmarkJointAccelResidual(benchmark::State& state) {
  const Eigen::Vector3d omega_M(1.0, -2.0, 0.5), alpha_M(10.0, 5.0, -3.0), f_I(0.0, 0.0, 9.8);
  const JointAccelSample sample{{{0, 0.3, 0.01}, omega_M, alpha_M, f_I, 0.5, 0.0, 0.0, 0.02},
                                Eigen::Quaterniond::Identity(),
                                {1.0, 2.0, 3.0},
                                {}};
  const auto samples = static_cast<size_t>(state.range(0));
  const std::unique_ptr<ceres::CostFunction> block(
      CreateJointAccelResidual(std::vector<JointAccelSample>(samples, sample),
                               Eigen::Matrix3d::Identity(),
                               std::make_shared<const std::vector<ClockMotion>>()));
  std::vector<std::vector<double>> parameters, jacobians;
  std::vector<double*> parameter_blocks, jacobian_blocks;
  for (const int size : block->parameter_block_sizes()) {
    parameters.emplace_back(static_cast<size_t>(size), 0.01);
    jacobians.emplace_back(static_cast<size_t>(size * block->num_residuals()));
    parameter_blocks.push_back(parameters.back().data());
    jacobian_blocks.push_back(jacobians.back().data());
  }
  std::vector<double> residuals(static_cast<size_t>(block->num_residuals()));
  for (auto _ : state) {
    block->Evaluate(parameter_blocks.data(), residuals.data(), jacobian_blocks.data());
    benchmark::DoNotOptimize(residuals.data());
  }
}
BENCHMARK(BenchmarkJointAccelResidual)->Arg(1)->Arg(4);

/// S4 alone on `range` seconds: poses 100 Hz, IMU 200 Hz.
void BenchmarkSolveJointly(benchmark::State& state) {
  const CalibrationOptions options;
  DataCheck check;
  const std::vector<PreparedSession> sessions = {
      Prepare(options, Recording(static_cast<double>(state.range(0))), &check)};
  Estimate first(sessions[0], options.bias_knot_interval_s);
  const JointStart start = ChooseKnotSpacing(options, sessions[0], &first);
  for (auto _ : state) {
    Estimate estimate = first;
    benchmark::DoNotOptimize(SolveJointly(options, sessions, {start}, &estimate));
  }
}
BENCHMARK(BenchmarkSolveJointly)->Arg(40)->Arg(80)->Unit(benchmark::kMillisecond);

/// The whole calibration of `range` seconds: poses 100 Hz, IMU 200 Hz.
void BenchmarkCalibrate(benchmark::State& state, Method method) {
  const SessionData data = Recording(static_cast<double>(state.range(0)));
  CalibrationOptions options;
  options.method = method;
  for (auto _ : state) benchmark::DoNotOptimize(Calibrate(options, data));
}
BENCHMARK_CAPTURE(BenchmarkCalibrate, gp, Method::kGp)
    ->Arg(40)
    ->Arg(80)
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(BenchmarkCalibrate, joint, Method::kJoint)
    ->Arg(40)
    ->Arg(80)
    ->Unit(benchmark::kMillisecond);

}  // namespace
}  // namespace imu_pose_calib

BENCHMARK_MAIN();
