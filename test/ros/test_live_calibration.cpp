// LiveCalibration with simulated samples: what it keeps, asks for and concludes.

#include <gtest/gtest.h>

#include <algorithm>
#include <limits>

#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/ros/live/live_calibration.h"
#include "imu_pose_calib/simulation/simulator.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

SimulatorOptions Handheld(double duration_s) {
  SimulatorOptions options;
  options.duration_s = duration_s;
  return options;
}

double Arrival(int64_t t_ns) { return 1e-9 * static_cast<double>(t_ns) + 0.01; }

/// Adds the samples in the order in which they would arrive, `rate` times faster.
void Feed(const SessionData& data, LiveCalibration* live, double rate = 1.0) {
  const double start = Arrival(data.poses.front().t_ns);
  size_t gyro = 0, accel = 0, sensor = 0;
  for (size_t k = 0; k < data.poses.size(); ++k) {
    const double now = start + (Arrival(data.poses[k].t_ns) - start) / rate;
    const auto due = [&](size_t count) { return count * (k + 1) / data.poses.size(); };
    live->AddPose(data.poses[k], now);
    while (gyro < due(data.imus[0].gyro.size())) live->AddGyro(data.imus[0].gyro[gyro++], now);
    while (accel < due(data.imus[0].accel.size())) live->AddAccel(data.imus[0].accel[accel++], now);
    if (data.pose_sensors.empty()) continue;
    const std::vector<PoseSample>& poses = data.pose_sensors[0];
    while (sensor < due(poses.size())) live->AddPose(poses[sensor++], now, 1);
  }
}

/// The samples from `from` to `to` [s] after the first pose.
SessionData Cut(const SessionData& data, double from, double to) {
  const int64_t start = data.poses.front().t_ns;
  const auto cut = [&](const auto& samples) {
    std::decay_t<decltype(samples)> kept;
    for (const auto& sample : samples) {
      const double t = 1e-9 * static_cast<double>(sample.t_ns - start);
      if (t >= from && t < to) kept.push_back(sample);
    }
    return kept;
  };
  return {cut(data.poses), {{cut(data.imus[0].gyro), cut(data.imus[0].accel)}}, {}};
}

SessionData Shift(SessionData data, double seconds) {
  const auto shift = [&](auto* samples) {
    for (auto& sample : *samples) sample.t_ns += static_cast<int64_t>(1e9 * seconds);
  };
  shift(&data.poses);
  shift(&data.imus[0].gyro);
  shift(&data.imus[0].accel);
  return data;
}

double End(const SessionData& data) { return Arrival(data.poses.back().t_ns); }

/// A usable result with one sigma for all [m], and 1 rad and 1 s as precise as 1 m.
Calibration Result(double sigma, double x = 0.0) {
  Calibration result;
  result.status = Status::kOk;
  result.imus[0].T_MI.p.x() = x;
  result.imus[0].covariance = Matrix6d::Identity() * sigma * sigma;
  result.sessions[0].imus[0].time_shift_std = sigma;
  return result;
}

bool EndSolve(const Calibration& result, LiveCalibration* live) {
  live->BeginSolve();
  return live->EndSolve(result);
}

TEST(LiveOptions, NamesTheParameterOutOfRange) {
  LiveOptions options;
  options.window = -1.0;
  ExpectError<InputError>([&] { LiveCalibration{options}; }, {"window", "-1", "positive"});
  options = LiveOptions();
  options.min_duration = 60.0;
  ExpectError<InputError>([&] { LiveCalibration{options}; }, {"min_duration", "60", "window"});
}

TEST(LiveCalibration, SaysWhichStreamIsMissing) {
  LiveCalibration live((LiveOptions()));
  EXPECT_EQ(live.Status(0.0).phase_text, "waiting");
  SessionData data = Simulate(Handheld(2.0));
  data.imus[0].gyro.clear();
  for (ImuSample& sample : data.imus[0].accel) sample.t_ns = 0;
  Feed(data, &live);
  const CalibrationStatus status = live.Status(End(data));
  EXPECT_EQ(status.phase, CalibrationStatus::WAITING);
  EXPECT_EQ(status.message, "waiting for gyroscope, accelerometer with header stamps (all are 0)");
}

TEST(LiveCalibration, KeepsEverySampleOfTheWindow) {
  LiveOptions options;
  options.window = 20.0;
  LiveCalibration live(options);
  const SessionData all = Simulate(Handheld(50.0));
  Feed(all, &live);
  const SessionData kept = live.BeginSolve();
  const auto expect_tail = [](const auto& samples, const auto& tail, size_t count) {
    ASSERT_EQ(tail.size(), count);
    for (size_t k = 0; k < count; ++k)
      ASSERT_EQ(tail[k].t_ns, samples[samples.size() - count + k].t_ns);
  };
  expect_tail(all.poses, kept.poses, 2001);
  expect_tail(all.imus[0].gyro, kept.imus[0].gyro, 4001);
  expect_tail(all.imus[0].accel, kept.imus[0].accel, 4001);
  const CalibrationStatus status = live.Status(End(all));
  EXPECT_EQ(status.pose_count, all.poses.size());
  EXPECT_NEAR(status.pose_rate, 100.0, 0.1);
  EXPECT_NEAR(status.gyro_rate, 200.0, 0.1);
  EXPECT_NEAR(status.buffered, 20.0, 0.01);
  EXPECT_NEAR(live.Streams()[0].delay_s, 0.01, 1e-6);
}

TEST(LiveCalibration, SolvesTheSameDataAsOffline) {
  LiveCalibration live((LiveOptions()));
  const SessionData data = Simulate(Handheld(15.0));
  Feed(data, &live);
  ASSERT_TRUE(live.WantsSolve());
  CalibrationOptions options;
  options.method = Method::kGp;
  const SessionData snapshot = live.BeginSolve();
  ASSERT_TRUE(live.EndSolve(Calibrate(options, snapshot)));
  EXPECT_LT((live.result()->imus[0].T_MI.p - SimulatorOptions().T_MI.p).norm(), 0.01);
}

/// With a camera, which is on a clock of its own.
SimulatorOptions HandheldWithSensor(double duration_s) {
  SimulatorOptions options = Handheld(duration_s);
  options.pose_sensors.resize(1);
  return options;
}

LiveCalibration WithSensor(const LiveOptions& options = LiveOptions()) {
  return LiveCalibration(options, CalibrationOptions(), 1, {"/camera/pose"});
}

CalibrationOptions Gp() {
  CalibrationOptions options;
  options.method = Method::kGp;
  return options;
}

TEST(LiveCalibration, FindsAPoseSensor) {
  LiveCalibration live = WithSensor();
  const SimulatorOptions options = HandheldWithSensor(15.0);
  const SessionData data = Simulate(options);
  Feed(data, &live);
  ASSERT_TRUE(live.EndSolve(Calibrate(Gp(), live.BeginSolve())));
  const PoseSensorCalibration& sensor = live.result()->pose_sensors.at(0);
  EXPECT_EQ(sensor.status, Status::kOk) << sensor.message;
  EXPECT_LT((sensor.T_MS.p - options.pose_sensors[0].T_MS.p).norm(), 0.01);
  EXPECT_LT(sensor.T_MS.q.angularDistance(options.pose_sensors[0].T_MS.q), 0.01);
  EXPECT_FALSE(Contains(live.Status(End(data)).message, "sensor")) << live.Status(End(data));
}

TEST(LiveCalibration, SaysThatAPoseSensorIsNotOk) {
  LiveCalibration live = WithSensor();
  const SessionData data = Simulate(HandheldWithSensor(15.0));
  Feed(data, &live);
  Calibration result = Result(1e-3);
  result.pose_sensors.resize(1);
  result.pose_sensors[0].status = Status::kDegenerate;
  EndSolve(result, &live);
  CalibrationStatus status = live.Status(End(data));
  EXPECT_EQ(status.phase, CalibrationStatus::COLLECTING);
  EXPECT_TRUE(Contains(status.message, "; sensor0 is degenerate")) << status;
  status = live.Status(End(data) + 0.5 * LiveOptions().lost_timeout);
  EXPECT_FALSE(Contains(status.message, "/camera/pose")) << status;
  status = live.Status(End(data) + 2.0 * LiveOptions().lost_timeout);
  EXPECT_TRUE(Contains(status.message, "; no poses of /camera/pose for 2.0 s")) << status;
}

/// One that has never sent anything, has lost its clock, or sent hardly anything.
TEST(LiveCalibration, DoesNotNeedAPoseSensor) {
  SessionData silent = Simulate(HandheldWithSensor(15.0));
  silent.pose_sensors[0].clear();
  SessionData unstamped = silent, brief = silent, broken = silent;
  const SessionData data = Simulate(HandheldWithSensor(15.0));
  unstamped.pose_sensors = brief.pose_sensors = broken.pose_sensors = data.pose_sensors;
  for (PoseSample& pose : unstamped.pose_sensors[0]) pose.t_ns = 0;
  for (PoseSample& pose : broken.pose_sensors[0]) pose.q_WM.coeffs().setZero();
  brief.pose_sensors[0].resize(1);
  for (const auto& [given, note] : {std::make_pair(&silent, "; no poses of /camera/pose"),
                                    {&unstamped, "; no poses of /camera/pose with header stamps"},
                                    {&brief, "; sensor0 is degenerate"},
                                    {&broken, "; sensor0 is degenerate"}}) {
    LiveCalibration live = WithSensor();
    Feed(*given, &live);
    ASSERT_TRUE(live.WantsSolve()) << note;
    ASSERT_TRUE(live.EndSolve(Calibrate(Gp(), live.BeginSolve()))) << note;
    EXPECT_LT((live.result()->imus[0].T_MI.p - SimulatorOptions().T_MI.p).norm(), 0.01) << note;
    const CalibrationStatus status = live.Status(End(data));
    EXPECT_EQ(status.phase, CalibrationStatus::COLLECTING) << status;
    EXPECT_TRUE(Contains(status.message, note)) << status;
  }
}

TEST(LiveCalibration, ForgetsOldPosesOfASensorThatIsSilent) {
  LiveOptions options;
  options.window = 20.0;
  LiveCalibration live = WithSensor(options);
  SessionData data = Simulate(HandheldWithSensor(50.0));
  Feed(Cut(data, 0.0, 30.0), &live);
  for (const PoseSample& pose : data.pose_sensors[0])
    if (pose.t_ns < data.pose_sensors[0].front().t_ns + 30'000'000'000)
      live.AddPose(pose, Arrival(data.poses.front().t_ns) + 30.0, 1);
  EXPECT_NEAR(static_cast<double>(live.BeginSolve().pose_sensors.at(0).size()), 20.0 * 30.0, 2.0);
  Feed(Cut(data, 30.0, 40.0), &live);
  EXPECT_NEAR(static_cast<double>(live.BeginSolve().pose_sensors.at(0).size()), 10.0 * 30.0, 5.0);
  Feed(Cut(data, 40.0, 50.0), &live);
  EXPECT_LT(live.BeginSolve().pose_sensors.at(0).size(), 5u);
}

TEST(LiveCalibration, ForgetsOnlyThePosesOfASensorWhoseClockJumps) {
  LiveCalibration live = WithSensor();
  const SessionData data = Simulate(HandheldWithSensor(15.0));
  Feed(data, &live);
  PoseSample pose = data.pose_sensors[0].back();
  pose.t_ns += 100'000'000'000;
  live.AddPose(pose, End(data), 1);
  EXPECT_EQ(live.BeginSolve().pose_sensors.at(0).size(), 1u);
  EXPECT_NEAR(live.Streams()[0].buffered_s, 15.0, 0.1);
  live.Reset("", End(data));
  EXPECT_FALSE(live.HasPoses(1));
}

TEST(LiveCalibration, UnderstandsThePosesAsTheSolverDoes) {
  CalibrationOptions options;
  options.position_unit = 1e-3;
  options.invert_poses = true;
  const SessionData data = Simulate(Handheld(3.0));
  SessionData recorded = data;
  for (PoseSample& pose : recorded.poses) {
    pose.q_WM = pose.q_WM.conjugate();
    pose.p_WM = -1e3 * (pose.q_WM * pose.p_WM);
  }
  LiveCalibration expected((LiveOptions())), live(LiveOptions(), options);
  Feed(data, &expected);
  Feed(recorded, &live);
  EXPECT_LT((live.pose()->p_WM - data.poses.back().p_WM).norm(), 1e-9);
  EXPECT_LT(live.pose()->q_WM.angularDistance(data.poses.back().q_WM), 1e-6);
  EXPECT_LT((live.Excitation() - expected.Excitation()).norm(), 1e-6);
  EXPECT_EQ(live.BeginSolve().poses.back().p_WM, recorded.poses.back().p_WM);
}

TEST(LiveCalibration, AsksForTheMotionThatIsMissing) {
  LiveCalibration live((LiveOptions()));
  SimulatorOptions simulator = Handheld(40.0);
  simulator.motion = Motion::kPlanar;
  const SessionData planar = Simulate(simulator);
  Feed(planar, &live);
  CalibrationStatus status = live.Status(End(planar));
  EXPECT_EQ(status.phase, CalibrationStatus::COLLECTING);
  EXPECT_EQ(live.Excitation()[2], 1.0);
  EXPECT_LT(live.Excitation()[0], 0.05);
  EXPECT_LT(live.Excitation()[1], 0.05);
  EXPECT_LT(live.Excitation()[5], 0.05);
  EXPECT_TRUE(Contains(status.message, "rotate about the marker's")) << status.message;
  EXPECT_FALSE(Contains(status.message, "z axis")) << status.message;
  EXPECT_FALSE(live.WantsSolve());

  // Handheld motion fills all bars.
  simulator.motion = Motion::kHandheld;
  simulator.start_ns += 40'000'000'000;
  const SessionData handheld = Simulate(simulator);
  Feed(handheld, &live);
  EXPECT_TRUE(live.Excitation().isOnes()) << live.Excitation().transpose();
  EXPECT_TRUE(live.WantsSolve());
}

TEST(LiveCalibration, WantsASolveOnlyWithNewData) {
  LiveCalibration live((LiveOptions()));
  const SessionData data = Simulate(Handheld(40.0));
  Feed(Cut(data, 0.0, 9.0), &live);
  EXPECT_FALSE(live.WantsSolve()) << "before min_duration";
  Feed(Cut(data, 9.0, 20.0), &live);
  EXPECT_TRUE(live.WantsSolve());
  live.BeginSolve();
  Feed(Cut(data, 20.0, 30.0), &live);
  EXPECT_FALSE(live.WantsSolve()) << "while one is running";
  EXPECT_EQ(live.Status(Arrival(data.poses[2999].t_ns)).phase, CalibrationStatus::SOLVING);
  live.EndSolve(Result(1.0));
  EXPECT_TRUE(live.WantsSolve());
  live.BeginSolve();
  live.EndSolve(Result(1.0));
  Feed(Cut(data, 30.0, 34.0), &live);
  EXPECT_FALSE(live.WantsSolve()) << "before solve_interval";
  Feed(Cut(data, 34.0, 36.0), &live);
  EXPECT_TRUE(live.WantsSolve());
}

TEST(LiveCalibration, ConvergesWhenThreeSolvesAgree) {
  LiveCalibration live((LiveOptions()));
  const SessionData data = Simulate(Handheld(20.0));
  Feed(data, &live);
  const auto phase = [&] { return live.Status(End(data)).phase; };
  const double good = 0.5 * LiveOptions().target_time_shift_std;
  EXPECT_TRUE(EndSolve(Result(good, 0.0), &live));
  EXPECT_TRUE(EndSolve(Result(good, 0.01), &live));
  EXPECT_TRUE(EndSolve(Result(good, 0.0), &live));
  EXPECT_EQ(phase(), CalibrationStatus::COLLECTING) << "10 mm apart";
  EndSolve(Result(good, 0.0), &live);
  EndSolve(Result(good, 0.0), &live);
  EXPECT_EQ(phase(), CalibrationStatus::CONVERGED);
  EXPECT_EQ(live.Status(End(data)).solves, 5u);

  live.BeginSolve();
  Calibration failed;
  failed.message = "no overlap";
  live.EndSolve(failed);
  EXPECT_EQ(phase(), CalibrationStatus::COLLECTING);
  EXPECT_TRUE(Contains(live.Status(End(data)).message, "no overlap"));
}

TEST(LiveCalibration, DoesNotConvergeAboveATarget) {
  LiveCalibration live((LiveOptions()));
  const SessionData data = Simulate(Handheld(20.0));
  Feed(data, &live);
  for (int k = 0; k < 3; ++k) EndSolve(Result(2.0 * LiveOptions().target_time_shift_std), &live);
  EXPECT_EQ(live.Status(End(data)).phase, CalibrationStatus::COLLECTING);
  EXPECT_TRUE(Contains(live.Status(End(data)).message, "target 0.5 mm"));
}

TEST(LiveCalibration, OffersTheNewestOfThePreciseResults) {
  LiveCalibration live((LiveOptions()));
  Calibration degenerate = Result(1e-6, 5.0);
  degenerate.status = Status::kDegenerate;
  EXPECT_FALSE(EndSolve(degenerate, &live));
  EXPECT_FALSE(live.result());
  EXPECT_TRUE(EndSolve(Result(1e-3, 1.0), &live));
  EXPECT_TRUE(EndSolve(Result(1e-4, 2.0), &live));
  EXPECT_FALSE(EndSolve(Result(1e-3, 3.0), &live));
  EXPECT_FALSE(EndSolve(degenerate, &live));
  EXPECT_EQ(live.result()->imus[0].T_MI.p.x(), 2.0);
  EXPECT_TRUE(EndSolve(Result(1.1e-4, 4.0), &live));
  EXPECT_FALSE(EndSolve(Result(1.3e-4, 5.0), &live)) << "not worse and worse step by step";
}

TEST(LiveCalibration, NoticesLostStreamsAndMarkers) {
  LiveCalibration live((LiveOptions()));
  const SessionData data = Simulate(Handheld(30.0));
  Feed(Cut(data, 0.0, 10.0), &live);
  SessionData lost = Cut(data, 10.0, 15.0);
  const double lost_end = End(lost);
  const PoseSample last = lost.poses.front();
  lost.poses.resize(1);
  for (const ImuSample& sample : lost.imus[0].gyro) live.AddGyro(sample, Arrival(sample.t_ns));
  for (const ImuSample& sample : lost.imus[0].accel) live.AddAccel(sample, Arrival(sample.t_ns));
  CalibrationStatus status = live.Status(lost_end);
  EXPECT_EQ(status.phase, CalibrationStatus::DEGRADED);
  EXPECT_TRUE(Contains(status.message, "no poses for 5")) << status.message;

  Feed(Cut(data, 15.0, 20.0), &live);
  status = live.Status(Arrival(data.poses[1999].t_ns));
  EXPECT_EQ(status.phase, CalibrationStatus::COLLECTING)
      << "a gap is not a jump: " << status.message;
  EXPECT_NEAR(live.Streams()[0].buffered_s, 20.0, 0.1);

  // A bridge that repeats what it saw last.
  SessionData frozen = Cut(data, 20.0, 23.0);
  for (PoseSample& pose : frozen.poses) pose = {pose.t_ns, last.q_WM, last.p_WM, {}};
  Feed(frozen, &live);
  status = live.Status(End(frozen));
  EXPECT_EQ(status.phase, CalibrationStatus::DEGRADED);
  EXPECT_TRUE(Contains(status.message, "the marker is lost")) << status.message;
}

TEST(LiveCalibration, StartsAnewWhenAClockJumps) {
  const SessionData data = Simulate(Handheld(20.0));
  const auto expect_reset = [&](const SessionData& more, const std::string& text) {
    LiveCalibration live((LiveOptions()));
    Feed(data, &live);
    EndSolve(Result(1e-3), &live);
    ASSERT_TRUE(live.result());
    Feed(more, &live);
    const CalibrationStatus status = live.Status(End(more));
    EXPECT_EQ(status.phase, CalibrationStatus::DEGRADED);
    EXPECT_TRUE(Contains(status.message, text)) << status.message;
    EXPECT_FALSE(live.result());
    EXPECT_NEAR(live.Streams()[0].buffered_s, 3.0, 0.1);
  };
  const SessionData again = Cut(data, 0.0, 3.0);
  expect_reset(again, "time went back by 20 s");
  SessionData back = Shift(again, 20.0), ahead = back;
  for (ImuSample& sample : back.imus[0].gyro) sample.t_ns -= 10'000'000'000;
  expect_reset(back, "the stamps of the gyroscope went back by 9.98 s");
  for (ImuSample& sample : ahead.imus[0].accel) sample.t_ns += 10'000'000'000;
  expect_reset(ahead, "the stamps of the accelerometer jumped ahead by 10 s");
}

TEST(LiveCalibration, TakesFastPlaybackForNoJump) {
  LiveCalibration live((LiveOptions()));
  const SessionData data = Simulate(Handheld(30.0));
  SessionData gap = data;
  gap.poses.erase(gap.poses.begin() + 1000, gap.poses.begin() + 1500);
  Feed(gap, &live, 10.0);
  EXPECT_NEAR(live.Streams()[0].buffered_s, 30.0, 0.1);
}

TEST(LiveCalibration, IgnoresTheResultOfForgottenData) {
  LiveCalibration live((LiveOptions()));
  const SessionData data = Simulate(Handheld(20.0));
  Feed(data, &live);
  live.BeginSolve();
  live.Reset("", End(data));
  EXPECT_FALSE(live.EndSolve(Result(1e-5)));
  EXPECT_FALSE(live.result());
  EXPECT_EQ(live.Status(End(data)).phase, CalibrationStatus::WAITING);
}

TEST(LiveCalibration, StaysAsItWasSaved) {
  LiveCalibration live((LiveOptions()));
  const SessionData data = Simulate(Handheld(20.0));
  Feed(data, &live);
  EndSolve(Result(1e-3), &live);
  live.Freeze("saved to here");
  EXPECT_FALSE(EndSolve(Result(1e-5), &live));
  Feed(data, &live);  // time goes back
  EXPECT_FALSE(live.WantsSolve());
  EXPECT_EQ(live.Status(End(data)).phase, CalibrationStatus::SAVED);
  EXPECT_EQ(live.Status(End(data)).message, "saved to here");
  EXPECT_TRUE(live.result());
  live.Reset("", End(data));
  EXPECT_FALSE(live.IsFrozen());
}

TEST(LiveCalibration, KeepsThePathOfTheWindow) {
  LiveOptions options;
  options.window = 20.0;
  LiveCalibration live(options);
  const SessionData data = Simulate(Handheld(30.0));
  Feed(data, &live);
  const auto length = live.path().back().t_ns - live.path().front().t_ns;
  EXPECT_NEAR(1e-9 * static_cast<double>(length), 20.0, 0.1);
  EXPECT_NEAR(static_cast<double>(live.path().size()), 20.0 / 0.06, 2.0) << "every sixth pose";
}

/// The second pose of all is stamped before the first, by less than what would extend the path.
TEST(LiveCalibration, KeepsAPathWhoseStampsGoBackALittle) {
  LiveCalibration live((LiveOptions()));
  const SessionData data = Simulate(Handheld(1.0));
  EXPECT_TRUE(live.AddPose(data.poses[3], 1.0));
  EXPECT_TRUE(live.AddPose(data.poses[0], 1.01));
  ASSERT_EQ(live.path().size(), 1u);
  EXPECT_EQ(live.path().front().t_ns, data.poses[0].t_ns);
  live.Reset("", 1.02);
  EXPECT_TRUE(live.path().empty());
}

TEST(LiveCalibration, CountsBrokenPosesAsALostMarker) {
  LiveCalibration live((LiveOptions()));
  SessionData data = Simulate(Handheld(5.0));
  for (PoseSample& pose : data.poses)
    if (pose.t_ns > data.poses[200].t_ns) pose.p_WM.x() = std::numeric_limits<double>::quiet_NaN();
  Feed(data, &live);
  EXPECT_EQ(live.Status(End(data)).phase, CalibrationStatus::DEGRADED);
  EXPECT_EQ(live.pose()->t_ns, data.poses[200].t_ns);
}

}  // namespace
}  // namespace imu_pose_calib
