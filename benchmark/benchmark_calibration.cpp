// Times of the stages of a calibration (doc/math.md) and of whole ones, on 60 s handheld: poses at
// pose_rate [Hz], IMU at twice that, so that 500 is the window of a live calibration.
//
//   benchmark_calibration [--benchmark_filter=REGEXP] [--benchmark_repetitions=N]

#include <benchmark/benchmark.h>

#include <map>
#include <vector>

#include "imu_pose_calib/core/calibration/band.h"
#include "imu_pose_calib/core/calibration/gp_problem.h"
#include "imu_pose_calib/core/calibration/joint_problem.h"
#include "imu_pose_calib/core/calibration/joint_solver.h"
#include "imu_pose_calib/core/calibration/knot_spacing.h"
#include "imu_pose_calib/core/calibration/marginals.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/core/data/stamp_recovery.h"
#include "imu_pose_calib/core/start/initializer.h"
#include "imu_pose_calib/core/start/preparation.h"
#include "imu_pose_calib/core/trajectory/pose_trajectory.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

SessionData Recording(const benchmark::State& state, size_t imus = 1, double latency_s = 0.0) {
  SimulatorOptions options;
  options.duration_s = 60.0;
  options.pose_rate_hz = static_cast<double>(state.range(0));
  options.gyro_rate_hz = options.accel_rate_hz = 2.0 * options.pose_rate_hz;
  options.effects.pose_stream.latency_s = options.effects.imu_stream.latency_s = latency_s;
  return Simulate(options, imus);
}

CalibrationOptions Options(const benchmark::State& state, Method method = Method::kJoint) {
  CalibrationOptions options;
  options.method = method;
  options.num_threads = static_cast<int>(state.range(1));
  return options;
}

/// A recording up to S2 and up to its knot spacing: the same for all stages that come after.
struct Prepared {
  std::vector<PreparedSession> sessions;
  Estimate estimate;
  double knot_spacing_s;
};
const Prepared& PreparedRecording(const benchmark::State& state) {
  static std::map<int64_t, Prepared> cache;
  const auto found = cache.find(state.range(0));
  if (found != cache.end()) return found->second;
  const CalibrationOptions options;
  DataCheck check;
  Prepared made;
  made.sessions = {Prepare(options, Recording(state), &check)};
  made.estimate = Estimate(made.sessions[0], options.bias_knot_interval_s);
  made.knot_spacing_s = ChooseKnotSpacing(options, made.sessions[0].data);
  return cache.emplace(state.range(0), std::move(made)).first->second;
}

/// CPU is that of all threads.
void Cases(benchmark::internal::Benchmark* stage) {
  stage->ArgNames({"pose_rate", "threads"})
      ->Unit(benchmark::kMillisecond)
      ->MeasureProcessCPUTime()
      ->UseRealTime();
  for (const int pose_rate : {100, 500})
    for (const int threads : {1, 2}) stage->Args({pose_rate, threads});
}

/// S0 to S2 with their checks: what --check does.
void Preparation(benchmark::State& state) {
  const CalibrationOptions options = Options(state);
  const SessionData data = Recording(state);
  DataCheck check;
  for (auto _ : state) benchmark::DoNotOptimize(Prepare(options, data, &check));
}
BENCHMARK(Preparation)->Apply(Cases);

/// S0, with even stamps and with those of arrival, which are recovered.
void Conditioning(benchmark::State& state, double latency_s) {
  const CalibrationOptions options = Options(state);
  const SessionData recorded = Recording(state, 1, latency_s);
  for (auto _ : state) {
    SessionData session = recorded;
    const SessionStamps stamps = RecoverStamps(options.recover_stamps, &session);
    benchmark::DoNotOptimize(ConditionData(options, session, stamps));
  }
}
BENCHMARK_CAPTURE(Conditioning, even, 0.0)->Apply(Cases);
BENCHMARK_CAPTURE(Conditioning, arrival, 2e-3)->Apply(Cases);

/// S1.
void Trajectory(benchmark::State& state) {
  const CalibrationOptions options = Options(state);
  const ConditionedData data = ConditionData(options, Recording(state));
  for (auto _ : state) {
    ConditionedData copy = data;
    benchmark::DoNotOptimize(FitTrajectory(options, &copy));
  }
}
BENCHMARK(Trajectory)->Apply(Cases);

/// Of S1, once the hyperparameters are known.
void TrajectoryKnown(benchmark::State& state) {
  const CalibrationOptions options = Options(state);
  const PreparedSession& session = PreparedRecording(state).sessions[0];
  for (auto _ : state)
    benchmark::DoNotOptimize(PoseTrajectory(
        session.data.poses, session.data.segments, session.trajectory->position_hyperparameters(),
        session.trajectory->rotation_hyperparameters(), options.Threads()));
}
BENCHMARK(TrajectoryKnown)->Apply(Cases);

/// S2.
void Start(benchmark::State& state) {
  const CalibrationOptions options = Options(state);
  const PreparedSession& session = PreparedRecording(state).sessions[0];
  for (auto _ : state)
    benchmark::DoNotOptimize(Initialise(options, *session.trajectory, session.data, 0));
}
BENCHMARK(Start)->Apply(Cases);

/// S3.
void GpSolve(benchmark::State& state) {
  const CalibrationOptions options = Options(state);
  const Prepared& prepared = PreparedRecording(state);
  for (auto _ : state) {
    Estimate estimate = prepared.estimate;
    benchmark::DoNotOptimize(SolveAgainstTrajectory(options, prepared.sessions, &estimate));
  }
}
BENCHMARK(GpSolve)->Apply(Cases);

/// Of S4, before the solve.
void KnotSpacing(benchmark::State& state) {
  const CalibrationOptions options = Options(state);
  const PreparedSession& session = PreparedRecording(state).sessions[0];
  for (auto _ : state) benchmark::DoNotOptimize(ChooseKnotSpacing(options, session.data));
}
BENCHMARK(KnotSpacing)->Apply(Cases);

/// S4 with S5's covariance.
void JointSolve(benchmark::State& state) {
  const CalibrationOptions options = Options(state);
  const Prepared& prepared = PreparedRecording(state);
  for (auto _ : state) {
    Estimate estimate = prepared.estimate;
    std::vector<PreparedSession> sessions = prepared.sessions;
    benchmark::DoNotOptimize(
        SolveJointly(options, {prepared.knot_spacing_s}, &sessions, &estimate));
  }
}
BENCHMARK(JointSolve)->Apply(Cases);

/// Of that, the covariance.
void JointMarginals(benchmark::State& state) {
  const CalibrationOptions options = Options(state);
  const Prepared& prepared = PreparedRecording(state);
  const double spacing = prepared.knot_spacing_s;
  const std::vector<PreparedSession> sessions = {
      LimitBand(prepared.sessions[0], Band(spacing), options.Threads())};
  Estimate estimate = prepared.estimate;
  const std::vector<SensorModel> models = InitialModels(options, sessions);
  std::vector<CorrectionSplines> splines = {
      CorrectionSplines(sessions[0].data, estimate, 0, spacing)};
  const auto joint = BuildJointProblem(options, sessions, models, &estimate, &splines);
  joint->Step();
  for (auto _ : state) benchmark::DoNotOptimize(FindMarginals(joint.get()));
}
BENCHMARK(JointMarginals)->Apply(Cases);

/// All stages.
void Whole(benchmark::State& state, Method method, size_t imus) {
  const CalibrationOptions options = Options(state, method);
  const SessionData data = Recording(state, imus);
  for (auto _ : state) benchmark::DoNotOptimize(Calibrate(options, data));
}
BENCHMARK_CAPTURE(Whole, gp, Method::kGp, 1)->Apply(Cases);
BENCHMARK_CAPTURE(Whole, joint, Method::kJoint, 1)->Apply(Cases);
BENCHMARK_CAPTURE(Whole, joint_of_two_imus, Method::kJoint, 2)->Apply(Cases);

}  // namespace
}  // namespace imu_pose_calib

BENCHMARK_MAIN();
