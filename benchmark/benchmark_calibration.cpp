#include <benchmark/benchmark.h>

#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/conditioning.h"
#include "imu_pose_calib/core/pose_trajectory.h"
#include "imu_pose_calib/core/simulator.h"

namespace imu_pose_calib {
namespace {

CalibrationData Recording(double duration_s) {
  SimulatorOptions options;
  options.duration_s = duration_s;
  return Simulate(options);
}

/// S1 on `range` seconds of poses at 100 Hz.
void BenchmarkFitTrajectory(benchmark::State& state) {
  const CalibrationOptions options;
  const ConditionedData data = Condition(options, Recording(static_cast<double>(state.range(0))));
  for (auto _ : state) {
    ConditionedData copy = data;
    benchmark::DoNotOptimize(FitTrajectory(options, &copy));
  }
}
BENCHMARK(BenchmarkFitTrajectory)->Arg(20)->Arg(40)->Arg(80)->Unit(benchmark::kMillisecond);

/// One query of value and derivatives, and one of the variances.
void BenchmarkTrajectoryQuery(benchmark::State& state) {
  const CalibrationOptions options;
  ConditionedData data = Condition(options, Recording(20.0));
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
  ConditionedData data = Condition(options, Recording(20.0));
  const PoseTrajectory trajectory = FitTrajectory(options, &data);
  double t = 1.0;
  for (auto _ : state) {
    t = t < 19.0 ? t + 0.0137 : 1.0;
    benchmark::DoNotOptimize(trajectory.Variance(t));
  }
}
BENCHMARK(BenchmarkTrajectoryVariance);

/// The whole calibration of `range` seconds: poses 100 Hz, IMU 200 Hz.
void BenchmarkCalibrate(benchmark::State& state, Method method) {
  const CalibrationData data = Recording(static_cast<double>(state.range(0)));
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
