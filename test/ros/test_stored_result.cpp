#include <boost/algorithm/string/replace.hpp>

#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "stored_example.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

void ExpectSame(const ImuSession& read, const ImuSession& written) {
  EXPECT_TRUE(read.is_present);
  EXPECT_EQ(read.time_shift, written.time_shift);
  EXPECT_EQ(read.time_shift_std, written.time_shift_std);
  EXPECT_EQ(read.clock_drift, written.clock_drift);
  EXPECT_EQ(read.clock_drift_std, written.clock_drift_std);
  EXPECT_EQ(read.clock_reference, written.clock_reference);
  EXPECT_EQ(read.gyro_bias, written.gyro_bias);
  EXPECT_EQ(read.accel_bias, written.accel_bias);
  EXPECT_EQ(read.noise.gyro, written.noise.gyro);
  EXPECT_EQ(read.noise.accel, written.noise.accel);
  EXPECT_EQ(read.gyro.rate_hz, written.gyro.rate_hz);
  EXPECT_EQ(read.accel.rate_hz, written.accel.rate_hz);
}

TEST(StoredResult, HoldsWhatWasWritten) {
  for (const size_t imus : {1, 2}) {
    const Calibration written = ExampleResult(ImuModel::kScaleMisalignment, imus);
    const StoredResult stored = Example(ImuModel::kScaleMisalignment, imus);
    EXPECT_EQ(stored.path, "dir/my.calibration.yaml");
    EXPECT_EQ(stored.version, kVersion);
    EXPECT_EQ(stored.result.status, Status::kWeak);
    EXPECT_EQ(stored.result.message, written.message);
    EXPECT_EQ(stored.result.imu_model, ImuModel::kScaleMisalignment);
    ASSERT_EQ(stored.result.imus.size(), imus);
    for (size_t i = 0; i < imus; ++i) {
      const ImuCalibration &read = stored.result.imus[i], &imu = written.imus[i];
      EXPECT_TRUE(read.T_MI.Matrix().isApprox(imu.T_MI.Matrix(), 1e-15));
      EXPECT_EQ(read.covariance, imu.covariance);
      EXPECT_EQ(read.accel_delay, imu.accel_delay);
      EXPECT_EQ(read.accel_delay_std, imu.accel_delay_std);
      EXPECT_EQ(read.gyro_matrix, imu.gyro_matrix);
      EXPECT_EQ(read.accel_matrix, imu.accel_matrix);
      EXPECT_EQ(read.accel_positions, imu.accel_positions);
      ExpectSame(stored.Clock(i), written.sessions[0].imus[i]);
      EXPECT_EQ(stored.Info(i).imu_topic, "/imu" + std::to_string(i));
      EXPECT_EQ(stored.Info(i).imu_frame, "imu_" + std::to_string(i) + "_link");
    }
    EXPECT_EQ(stored.result.sessions[0].g_W, written.sessions[0].g_W);
    EXPECT_EQ(stored.result.sessions[0].noise.position, 0.0012);
    EXPECT_EQ(stored.result.sessions[0].noise.rotation, 0.0034);
    EXPECT_EQ(stored.result.sessions[0].poses.duration_s, 60.0);
    EXPECT_EQ(stored.infos[0].marker_frame, "rig/marker");
    EXPECT_EQ(stored.infos[0].world_frame, "world");
    EXPECT_EQ(stored.infos[0].pose_topic, "/vicon/rig");
    EXPECT_EQ(stored.infos[0].Source(), "x.bag");
    EXPECT_EQ(stored.options.gyro_bias_walk, 3e-5);
    EXPECT_EQ(stored.options.accel_bias_walk, 7e-4);
  }
}

/// Sessions that lack an IMU, and an IMU on two topics.
TEST(StoredResult, HoldsSessions) {
  Calibration written = ExampleResult(ImuModel::kCalibrated, 2);
  written.sessions.push_back(written.sessions[0]);
  written.sessions[0].imus[1].is_present = false;
  written.sessions[1].g_W = {0.0, 0.0, -9.8};
  written.sessions[1].imus[0].time_shift = 77.0;
  RecordingInfo info = ExampleInfo(2), second = info;
  info.imus[1].imu_topic.clear();
  info.imus[1].gyro_topic = "/gyro";
  info.imus[1].accel_topic = "/accel";
  second.bag = "y.bag";
  second.world_frame = "lab";
  const StoredResult stored =
      ParseResult(ToYaml(written, {info, second}, ExampleOptions()), "r.yaml");
  ASSERT_EQ(stored.result.sessions.size(), 2u);
  EXPECT_FALSE(stored.result.sessions[0].imus[1].is_present);
  ExpectSame(stored.Clock(0), written.sessions[0].imus[0]);
  ExpectSame(stored.Clock(1), written.sessions[1].imus[1]);
  EXPECT_EQ(stored.result.sessions[1].imus[0].time_shift, 77.0);
  EXPECT_EQ(stored.result.sessions[1].g_W.z(), -9.8);
  ASSERT_EQ(stored.infos.size(), 2u);
  EXPECT_EQ(stored.infos[1].Source(), "y.bag");
  EXPECT_EQ(stored.infos[1].world_frame, "lab");
  EXPECT_EQ(stored.Info(1).gyro_topic, "/gyro");
  EXPECT_EQ(stored.Info(1).accel_topic, "/accel");
}

void ExpectSame(const PoseStd& read, const PoseStd& written) {
  EXPECT_EQ(read.position, written.position);
  EXPECT_EQ(read.rotation, written.rotation);
}

void ExpectSame(const PoseSensorSession& read, const PoseSensorSession& written) {
  EXPECT_EQ(read.is_present, written.is_present);
  EXPECT_EQ(read.time_shift, written.time_shift);
  EXPECT_EQ(read.time_shift_std, written.time_shift_std);
  EXPECT_EQ(read.clock_drift, written.clock_drift);
  EXPECT_EQ(read.clock_drift_std, written.clock_drift_std);
  EXPECT_EQ(read.clock_reference, written.clock_reference);
  EXPECT_EQ(read.scale, written.scale);
  EXPECT_EQ(read.scale_std, written.scale_std);
  ExpectSame(read.noise, written.noise);
  ExpectSame(read.rms, written.rms);
  ExpectSame(read.drift, written.drift);
  EXPECT_EQ(read.poses.used, written.poses.used);
  EXPECT_EQ(read.poses.rate_hz, written.poses.rate_hz);
  EXPECT_EQ(read.poses.duration_s, written.poses.duration_s);
  ASSERT_EQ(read.world.size(), written.is_present ? 2u : 0u);  // where pieces begin
  for (size_t k = 0; k < read.world.size(); ++k) {
    EXPECT_EQ(read.world[k].t, written.world[2 * k].t);
    EXPECT_TRUE(read.world[k].T_VW.Matrix().isApprox(written.world[2 * k].T_VW.Matrix(), 1e-15));
    EXPECT_TRUE(read.world[k].begins_piece);
  }
}

/// Also where there is no IMU, where a session lacks a sensor, and where one could not be used.
TEST(StoredResult, HoldsPoseSensors) {
  for (const size_t imus : {0, 1, 2})
    for (const size_t sessions : {1, 2}) {
      Calibration written = ExampleResult(ImuModel::kCalibrated, imus);
      written.sessions.resize(sessions, written.sessions[0]);
      std::vector<RecordingInfo> infos(sessions, ExampleInfo(imus));
      AddSensors(&written, &infos[0]);
      infos.back().pose_sensors = infos[0].pose_sensors;
      PoseSensorCalibration& refused = written.pose_sensors.emplace_back();
      refused.status = Status::kDegenerate;
      refused.message = "turns otherwise than the marker";
      refused.sessions.resize(sessions);
      for (RecordingInfo& info : infos) info.pose_sensors.push_back({"/slam", "head", "map"});
      const StoredResult stored = ParseResult(ToYaml(written, infos, ExampleOptions()), "r.yaml");
      EXPECT_EQ(stored.result.imus.size(), imus);
      EXPECT_EQ(stored.infos[0].imus.size(), imus);
      ASSERT_EQ(stored.result.sessions.size(), sessions);
      EXPECT_EQ(stored.result.sessions.back().imus.size(), imus);
      ASSERT_EQ(stored.result.pose_sensors.size(), 3u);
      for (size_t k = 0; k < 3; ++k) {
        const PoseSensorCalibration &read = stored.result.pose_sensors[k],
                                    &sensor = written.pose_sensors[k];
        EXPECT_EQ(read.status, sensor.status);
        EXPECT_EQ(read.message, sensor.message);
        EXPECT_TRUE(read.T_MS.Matrix().isApprox(sensor.T_MS.Matrix(), 1e-15));
        EXPECT_EQ(read.covariance, sensor.covariance);
        ASSERT_EQ(read.sessions.size(), sessions);
        for (size_t s = 0; s < sessions; ++s) ExpectSame(read.sessions[s], sensor.sessions[s]);
        EXPECT_EQ(stored.infos[0].pose_sensors[k].topic, infos[0].pose_sensors[k].topic);
        EXPECT_EQ(stored.infos[0].pose_sensors[k].frame, infos[0].pose_sensors[k].frame);
        EXPECT_EQ(stored.infos[0].pose_sensors[k].world_frame,
                  infos[0].pose_sensors[k].world_frame);
      }
    }
}

/// A result in which one text is replaced.
void ExpectRefused(const std::string& from, const std::string& to,
                   const std::vector<std::string>& parts) {
  std::string yaml = SensorYaml(2);
  ASSERT_TRUE(Contains(yaml, from)) << from;
  boost::replace_first(yaml, from, to);
  ExpectError<InputError>([&] { ParseResult(yaml, "r.yaml"); }, parts);
}

TEST(StoredResult, ErrorsNameTheKey) {
  ExpectRefused("\nimu_pose_calib:", "\nother:", {"no key imu_pose_calib"});
  ExpectRefused("status: \"weak\"", "status: \"degenerate\"", {"status is 'degenerate'"});
  ExpectRefused("time_shift: 0.0437", "time_shift: soon", {"time_shift must hold finite numbers"});
  ExpectRefused("time_shift: 0.0437", "time_shift: .nan", {"time_shift must hold finite numbers"});
  ExpectRefused("translation: [", "translation: [1.0, ", {"transform: translation", "3 numbers"});
  ExpectRefused("rotation: [", "rotations: [", {"transform: rotation is missing"});
  ExpectRefused("name: \"imu1\"", "name: \"imu7\"", {"sessions: 0: imus: 1: name is not among"});
  ExpectRefused("session: 1", "session: 2", {"session must be from 1 to 1"});
  ExpectRefused("session: 1", "session: one", {"session must be a whole number"});
  ExpectRefused("scale: 1.25", "scales: 1.25", {"pose_sensors: 0: sessions: 0: scale is missing"});
  ExpectRefused("gyro_bias_walk:", "walk:", {"options: gyro_bias_walk is missing"});
  ExpectError<InputError>([] { ParseResult("- 1\n", ""); }, {"no key imu_pose_calib"});
}

TEST(StoredResult, RotationMustBeAUnitQuaternion) {
  std::string yaml = ExampleYaml();
  const size_t at = yaml.find("rotation: [");
  yaml.replace(at, yaml.find(']', at) - at, "rotation: [0.1, 0.2, 0.3, 0.4");
  ExpectError<InputError>([&] { ParseResult(yaml, ""); },
                          {"transform: rotation must be a unit quaternion"});
}

using StoredResultFile = TempDirTest;

TEST_F(StoredResultFile, ErrorsNameTheFile) {
  ExpectError<InputError>([&] { LoadResult(Path("none.yaml")); },
                          {"result '" + Path("none.yaml") + "'", "No such file"});
  const std::string path = Write("r.yaml", "a: [\n");
  ExpectError<InputError>([&] { LoadResult(path); }, {"'" + path + "'", "line 2"});
}

TEST_F(StoredResultFile, OfManySessionsIsRead) {
  Calibration written = ExampleResult(ImuModel::kCalibrated, 2);
  written.sessions.resize(60, written.sessions[0]);
  const std::vector<RecordingInfo> infos(60, ExampleInfo(2));
  const std::string path = Write("r.yaml", ToYaml(written, infos, ExampleOptions()));
  EXPECT_GT(std::filesystem::file_size(path), 100'000u);
  EXPECT_EQ(LoadResult(path).result.sessions.size(), 60u);
}

}  // namespace
}  // namespace imu_pose_calib
