#include <sstream>

#include "imu_pose_calib/ros/offline/offline.h"
#include "imu_pose_calib/ros/offline/summary.h"
#include "stored_example.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

Calibration MakeResult() {
  Calibration result;
  result.status = Status::kWeak;
  result.message =
      "the sigma of p_MI along z exceeds its bound of 10 mm, so use the result with care";
  result.imus[0].T_MI = {Eigen::Quaterniond(0.5, -0.5, 0.5, -0.5), {-1.0501, -0.2034, -0.3}};
  result.imus[0].covariance =
      (Vector6d() << 1e-6, 4e-6, 9e-6, 1e-4, 4e-4, 9e-4).finished().asDiagonal();
  result.sessions[0].imus[0].is_present = true;
  result.sessions[0].imus[0].time_shift = -1034771.50664123456;
  result.sessions[0].imus[0].time_shift_std = 1.25e-3;
  result.imus[0].accel_delay = -0.0037;
  result.imus[0].accel_delay_std = 2e-5;
  result.pose_smoothing = 1.6e-5;
  result.pose_smoothing_std = 2e-6;
  result.sessions[0].g_W = {-0.1, -0.2, -9.8};
  result.sessions[0].imus[0].gyro_bias = {-0.01, -0.02, -0.03};
  result.sessions[0].imus[0].accel_bias = {-0.4, -0.5, -0.6};
  result.sessions[0].poses.used = 22562;
  result.sessions[0].poses.rate_hz = 300.0;
  result.sessions[0].poses.duration_s = 75.2;
  result.sessions[0].poses.stamps_recovered = true;
  result.sessions[0].poses.stamp_jitter_s = 3.1e-3;
  result.sessions[0].poses.outlier = 1234;
  result.sessions[0].poses.in_short_segment = 4321;
  result.sessions[0].poses.duplicate_stamp = 17;
  result.sessions[0].poses.not_finite = 18;
  result.observability = {{"p_MI along marker z", 3e-3, "m", Status::kWeak},
                          {"R_MI about imu z", 3e-2, "rad", Status::kOk},
                          {"time_shift", 1.25e-3, "s", Status::kOk},
                          {"accel_delay", 2e-5, "s", Status::kOk}};
  result.warnings = {
      "the position residuals are 3.2 times larger than the noise: a warning text long enough to "
      "wrap"};
  return result;
}

RecordingInfo MakeInfo() {
  RecordingInfo info;
  info.imus[0].gyro_topic = "/imu/gyro";
  info.imus[0].accel_topic = "/imu/accel";
  info.pose_topic = "/mocap/pose";
  info.marker_frame = "rig";
  info.imus[0].imu_frame = "imu_link";
  return info;
}

TEST(OneLine, IsPrintable) {
  EXPECT_EQ(OneLine(InputError("there is no\noption '\x1b[2J'")), "there is no option '\\x1b[2J'");
}

TEST(Summary, SaysWhatAPersonNeeds) {
  const std::string text = Summary(MakeResult(), {MakeInfo()});
  EXPECT_EQ(text.compare(0, 6, "WEAK: "), 0) << text;
  for (const char* part :
       {"/imu/gyro", "/imu/accel", "/mocap/pose: 22562 at 300.0 Hz over 75.2 s",
        "stamps: recovered", "3.10 ms; dropped 18 not finite", "1234 outlier",
        "x_marker = R x_imu + p", "[-1050.100, -203.400, -300.000] mm",
        "-1050.100, -203.400, -300.000 1.000, 2.000, 3.000    weak",
        "[-0.500000, 0.500000, -0.500000, 0.500000] (x, y, z, w)",
        "-90.000, -0.000, -90.000      0.5730, 1.7189, 1.1459 ok", "x_imu = R x_marker + p",
        "t_pose = t_imu + time_shift", "t_imu = t_pose - time_shift",
        "-1034771.5066412 s            1.2500 ms              ok",
        "t_pose = t_accel + time_shift - accel_delay",
        "-3.7000 ms                    0.0200 ms              ok",
        "[-0.10000, -0.20000, -9.80000] m/s^2", "warning: the position residuals"})
    EXPECT_TRUE(Contains(text, part)) << "'" << part << "' is missing in\n" << text;
}

/// The row of the table that begins with `name`.
std::string RowOf(const Calibration& result, const std::string& name) {
  std::istringstream lines(Summary(result, {MakeInfo()}, 20));
  for (std::string line; std::getline(lines, line);)
    if (Contains(line, "  " + name)) return line;
  return "";
}

TEST(Summary, VerdictsOfRowsFollowTheirOwnBounds) {
  Calibration result = MakeResult();
  ImuSession& clock = result.sessions[0].imus[0];
  clock.gyro.duration_s = 75.0;
  const auto expect = [&](const std::string& name, const std::string& verdict) {
    const std::string row = RowOf(result, name);
    ASSERT_GT(row.size(), verdict.size()) << name;
    EXPECT_EQ(row.substr(row.size() - verdict.size() - 1), " " + verdict) << row;
  };
  expect("translation", "weak");
  expect("rpy", "ok");
  clock.clock_drift = 115e-6;
  clock.clock_drift_std = 709e-6;
  expect("clock drift", "prior");
  clock.clock_drift_std = 95e-6;
  expect("clock drift", "prior");
  clock.clock_drift_std = 70e-6;  // 2.6 ms at the ends
  expect("clock drift", "weak");
  clock.clock_drift_std = 1e-6;
  expect("clock drift", "ok");
  // Weak for a reason that no sigma shows.
  result.observability[0].status = Status::kOk;
  for (const char* name : {"translation", "rpy", "time shift", "accel delay", "clock drift"})
    expect(name, "in doubt");
  result.status = Status::kOk;
  expect("translation", "ok");
}

TEST(Summary, BriefHasAsManyWarningsAsFit) {
  Calibration result = MakeResult();
  result.warnings = {std::string(100, 'a') + " " + std::string(40, 'b'), "short", "third",
                     "fourth"};
  const auto brief = [&](size_t lines) {
    const std::string text = Summary(result, {MakeInfo()}, lines);
    EXPECT_LE(std::count(text.begin(), text.end(), '\n'), std::max<int64_t>(16, lines));
    return text;
  };
  EXPECT_TRUE(Contains(brief(0), "\n  4 warnings: --verbose\n"));
  EXPECT_TRUE(Contains(brief(19), "short\n  2 more warnings: --verbose\n")) << brief(19);
  EXPECT_TRUE(Contains(brief(30), "warning: fourth\n\nrosrun")) << brief(30);
}

/// With a pitch of 60 deg roll and yaw are coupled.
TEST(Summary, SigmasOfAnglesAreThoseOfTheAngles) {
  Calibration result = MakeResult();
  ImuCalibration& imu = result.imus[0];
  imu.covariance = Matrix6d::Identity() * 1e-8;
  // Yaw 0, pitch 60 deg, roll 0: about x and z of the body, roll and yaw are coupled.
  imu.T_MI.q = Eigen::AngleAxisd(M_PI / 3.0, Eigen::Vector3d::UnitY());
  imu.covariance(3, 3) = std::pow(1e-3, 2);
  imu.covariance(5, 5) = std::pow(2e-3, 2);
  // yaw = z / cos(pitch), roll = x + z tan(pitch)
  EXPECT_TRUE(Contains(RowOf(result, "rpy"), "0.2066, 0.0057, 0.2292")) << RowOf(result, "rpy");
  imu.T_MI.q = Eigen::AngleAxisd(M_PI / 2.0 - 1e-3, Eigen::Vector3d::UnitY());
  EXPECT_TRUE(Contains(RowOf(result, "rpy"), "0.0573, 0.0057, 0.1146"));
  EXPECT_TRUE(Contains(Summary(result, {MakeInfo()}, 20), "pitch near 90 deg"));
}

TEST(Summary, ShowsNamesWithoutControlCharacters) {
  RecordingInfo info = MakeInfo();
  info.imus[0].gyro_topic = info.imus[0].accel_topic = info.pose_topic = "/\x1b[2J";
  info.marker_frame = info.imus[0].imu_frame = info.imu_yaml = "\xff";
  for (const std::string& text : {Summary(MakeResult(), {info}), Summary(DataCheck(), info)}) {
    EXPECT_TRUE(Contains(text, "/\\x1b[2J")) << text;
    EXPECT_FALSE(Contains(text, "\x1b"));
    EXPECT_FALSE(Contains(text, "\xff"));
  }
}

TEST(Summary, SaysWhichSideIsSmoothed) {
  Calibration result = MakeResult();
  EXPECT_TRUE(Contains(Summary(result, {MakeInfo()}),
                       "Poses smoothed over 4.0 ms (sigma 0.2 ms) more than the imu"));
  result.pose_smoothing = -2.5e-5;
  EXPECT_TRUE(Contains(Summary(result, {MakeInfo()}),
                       "Imu smoothed over 5.0 ms (sigma 0.2 ms) more than the poses"));
  result.pose_smoothing_std = 1e-5;
  EXPECT_FALSE(Contains(Summary(result, {MakeInfo()}), "smoothed"));
  result.pose_smoothing = result.pose_smoothing_std = 0.0;  // not estimated
  EXPECT_FALSE(Contains(Summary(result, {MakeInfo()}), "smoothed"));
}

TEST(Summary, SaysWhereTheAxesOfTheAccelerometerAre) {
  Calibration result = MakeResult();
  EXPECT_FALSE(Contains(Summary(result, {MakeInfo()}), "Size effect"));
  result.imus[0].accel_positions(0, 1) = 1.25e-3;  // x of the axis y
  result.imus[0].accel_positions_std.setConstant(1e-4);
  const std::string text = Summary(result, {MakeInfo()});
  EXPECT_TRUE(Contains(text, "Size effect")) << text;
  EXPECT_TRUE(Contains(text, "  0.00125,   0.00000,   0.00000] +- [0.00010")) << text;
}

TEST(Summary, SaysWhatIsKnownOfThePositions) {
  Calibration result = MakeResult();
  EXPECT_FALSE(Contains(Summary(result, {MakeInfo()}), "averages"));
  EXPECT_FALSE(Contains(Summary(result, {MakeInfo()}), "too large"));
  result.position_smoothing = 4e-4;
  result.position_smoothing_std = 1e-5;
  result.position_delay = 7.5e-3;
  result.position_delay_std = 4e-5;
  result.pose_scale = 1.0031;
  result.pose_scale_std = 4e-4;
  const std::string text = Summary(result, {MakeInfo()});
  EXPECT_TRUE(
      Contains(text, "Position of the poses averages over 20.0 ms more than their rotation"))
      << text;
  EXPECT_TRUE(Contains(text, "Positions are too large by 0.31 % (sigma 0.04 %)")) << text;
  EXPECT_TRUE(Contains(text,
                       "Positions of the poses are 7.50 ms (sigma 0.04 ms) later than their "
                       "rotations"))
      << text;
}

TEST(Summary, FitsEightyColumns) {
  std::istringstream lines(Summary(MakeResult(), {MakeInfo()}));
  for (std::string line; std::getline(lines, line);) EXPECT_LE(line.size(), 80u) << line;
}

TEST(Summary, OffersACommandForTf) {
  const std::string text = Summary(MakeResult(), {MakeInfo()});
  const std::string command =
      "rosrun tf2_ros static_transform_publisher \\\n"
      "  -1.050100 -0.203400 -0.300000 -0.50000000 0.50000000 -0.50000000 0.50000000 \\\n"
      "  rig imu_link\n";
  EXPECT_TRUE(Contains(text, command)) << text;
  RecordingInfo info = MakeInfo();
  info.marker_frame = "Rig's Body";
  info.imus[0].imu_frame = "a-b/c.d:e_f0";
  EXPECT_TRUE(Contains(Summary(MakeResult(), {info}), "\n  'Rig'\\''s Body' a-b/c.d:e_f0\n"));
}

/// As if there were no line breaks.
std::string InOneLine(const std::string& text) {
  std::istringstream words(text);
  std::string line;
  for (std::string word; words >> word;) line += word + " ";
  return line;
}

TEST(Summary, ShowsPoseSensors) {
  for (const size_t imus : {0, 1, 2})
    for (const size_t sessions : {1, 2}) {
      SCOPED_TRACE(testing::Message() << imus << " imus, " << sessions << " sessions");
      Calibration result = ExampleResult(ImuModel::kCalibrated, imus);
      result.sessions.resize(sessions, result.sessions[0]);
      std::vector<RecordingInfo> infos(sessions, ExampleInfo(imus));
      AddSensors(&result, &infos[0]);
      infos.back().pose_sensors = infos[0].pose_sensors;
      const std::string brief = Summary(result, infos, 25), all = Summary(result, infos);
      for (const std::string& text : {brief, all}) {
        for (const char* part :
             {"sensor0 310.00, 70.00, -190.00 4.000", "  sensor0: camera_link, /camera/pose\n",
              "OK: every sigma is", "WEAK: sigma of p_MS is 11 mm", "scale 1.25000 +- 0.00030;",
              "time shift -0.0210000 s +- 0.2000 ms, clock drift 300.00 +- 1.00 ppm;",
              "noise 5.1 mm, 0.355 deg;", "drift 1.1 mm, 0.0401 deg per sqrt(s); jumps: 1",
              "rig/marker camera_link\n", "rig/marker lidar_link\n", "12 outlier"}) {
          EXPECT_TRUE(Contains(InOneLine(text), InOneLine(part))) << part << " is missing in\n"
                                                                  << text;
        }
        std::istringstream lines(text);
        for (std::string line; std::getline(lines, line);) EXPECT_LE(line.size(), 80u) << line;
        EXPECT_EQ(Contains(text, "imu"), imus > 0) << text;
        EXPECT_EQ(Contains(text, "session 2: time shift"), sessions == 2) << text;
      }
      EXPECT_TRUE(Contains(all, "t_pose = t_sensor + time_shift"));
      EXPECT_TRUE(Contains(all, "/lidar/pose: 1790 at 30.0 Hz over 59.5 s"));
    }
}

TEST(Summary, ShowsNoNumbersOfAPoseSensorThatIsNotUsable) {
  Calibration result = ExampleResult(ImuModel::kCalibrated, 1);
  RecordingInfo info = ExampleInfo(1);
  AddSensors(&result, &info);
  result.pose_sensors.pop_back();
  result.pose_sensors[0].status = Status::kDegenerate;
  result.pose_sensors[0].message = "turns otherwise";
  for (const std::string& text : {Summary(result, {info}), Summary(result, {info}, 25)}) {
    EXPECT_TRUE(Contains(text, "  sensor0: camera_link, /camera/pose\n")) << text;
    EXPECT_TRUE(Contains(text, "DEGENERATE: turns otherwise\n")) << text;
    EXPECT_FALSE(Contains(text, "310.000") || Contains(text, "scale")) << text;
    EXPECT_FALSE(Contains(text, "rig/marker camera_link")) << text;
  }
}

/// A weak sensor does not put the IMU in doubt.
TEST(Summary, RowsOfTheImuDoNotDependOnPoseSensors) {
  Calibration result = MakeResult();
  for (Observability& o : result.observability) o.status = Status::kOk;
  result.message = "sensor0: sigma of p_MS is 11 mm";
  EXPECT_TRUE(Contains(RowOf(result, "translation"), " ok"));
}

TEST(Summary, ShowsWhatTheCovariancesOfThePosesSay) {
  RecordingInfo info = MakeInfo();
  EXPECT_FALSE(Contains(Summary(MakeResult(), {info}), "covariances"));
  info.stated_pose_std = PoseStd{0.02, M_PI / 180};
  EXPECT_TRUE(Contains(Summary(MakeResult(), {info}), "covariances say 20 mm and 1 deg per axis"));
}

TEST(Summary, ShowsNoNumbersThatAreNoResult) {
  Calibration result = MakeResult();
  result.status = Status::kDegenerate;
  result.unobservable = {"p_MI along marker z"};
  const std::string text = Summary(result, {MakeInfo()});
  EXPECT_EQ(text.compare(0, 12, "DEGENERATE: "), 0);
  EXPECT_TRUE(Contains(text, "p_MI along marker z"));
  EXPECT_FALSE(Contains(text, "x_marker"));
  EXPECT_FALSE(Contains(text, "static_transform_publisher"));
}

TEST(Summary, ShowsADataCheckAtAGlance) {
  DataCheck check;
  check.verdict = DataVerdict::kUsable;
  check.message = "see the warnings";
  check.poses.count = 22562;
  check.poses.rate_hz = 300.0;
  check.poses.longest_gap_s = 0.25;
  check.poses.repeated = 0.125;
  check.poses.report.flipped = 321;
  check.poses.cut_s = 0.01;
  check.poses.report.stamps_even = false;
  check.poses.report.stamps_recovered = true;
  check.poses.report.stamp_jitter_s = 3.1e-3;
  check.imus[0].gyro.report.stamps_even = false;
  check.imus[0].is_matched = true;
  check.imus[0].time_shift = -1034771.5066;
  check.imus[0].overlap_s = 65.1;
  check.imus[0].drift_ppm = -48.2;
  check.imus[0].drift_ppm_std = 1.3;
  check.imus[0].explained = 0.994;
  check.turns_M = {0.82, 0.57, 0.88};
  check.warnings = {"a warning that is long enough to be wrapped, for it goes on and on and on so"};
  RecordingInfo info = MakeInfo();
  info.imus[0].gyro_latency = Latency{-1034771.5, 2.5e-3};
  const std::string text = Summary(check, info);
  EXPECT_EQ(text.compare(0, 8, "USABLE: "), 0) << text;
  for (const char* part :
       {"22562   300.0  0.00 ms 250.00 ms", "12.5", "-12.0 days 2.50 ms",
        "/mocap/pose, /imu/gyro, /imu/accel", "dropped 321 flipped; stamps are multiples of 10 ms",
        "stamps: recovered,", "gyro: stamps: uneven, as recorded",
        "about -1034771.5066 s (-12.0 days); 65.1 s in common", "-48.2 +- 1.3 ppm",
        "explain 99.4 %", "[0.82, 0.57, 0.88] rad/s", "warning: a warning"})
    EXPECT_TRUE(Contains(text, part)) << "'" << part << "' is missing in\n" << text;
  std::istringstream lines(text);
  for (std::string line; std::getline(lines, line);) EXPECT_LE(line.size(), 80u) << line;

  check.verdict = DataVerdict::kRecordAgain;
  EXPECT_EQ(Summary(check, info).compare(0, 14, "RECORD AGAIN: "), 0);
}

}  // namespace
}  // namespace imu_pose_calib
