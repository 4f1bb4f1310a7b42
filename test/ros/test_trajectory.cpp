// Ground truth files of calibrate_bag, read by parsers written from the consumers' documentation
// and compared with the truth of simulated recordings.

#include <nav_msgs/Odometry.h>
#include <nav_msgs/Path.h>
#include <rosbag/bag.h>
#include <rosbag/view.h>
#include <std_msgs/Bool.h>
#include <tf2_msgs/TFMessage.h>
#include <yaml-cpp/yaml.h>

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <map>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/offline/ground_truth.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "run_executable.h"

namespace imu_pose_calib {
namespace {

using Row = std::vector<std::string>;

Row Split(const std::string& line, char separator) {
  Row fields;
  std::string field;
  for (const char c : line + separator) {
    if (c != separator) {
      field += c;
      continue;
    }
    fields.push_back(field);
    field.clear();
  }
  return fields;
}

std::vector<std::string> Lines(const std::string& path) {
  std::vector<std::string> lines;
  std::ifstream file(path);
  for (std::string line; std::getline(file, line);) lines.push_back(line);
  return lines;
}

/// Those of a file of TUM or of ov_eval that are no comments.
std::vector<std::string> States(const std::string& path) {
  std::vector<std::string> lines = Lines(path);
  lines.erase(std::remove_if(lines.begin(), lines.end(),
                             [](const std::string& line) { return line[0] == '#'; }),
              lines.end());
  return lines;
}

/// The whole field is a number.
double Number(const std::string& field) {
  size_t used = 0;
  const double value = std::stod(field, &used);
  EXPECT_EQ(used, field.size()) << field;
  EXPECT_TRUE(std::isfinite(value)) << field;
  return value;
}

Eigen::Vector3d Vector(const Row& row, size_t first) {
  return {Number(row[first]), Number(row[first + 1]), Number(row[first + 2])};
}

/// "12.345678900" in nanoseconds.
int64_t FromSeconds(const std::string& field) {
  const size_t point = field.find('.');
  EXPECT_EQ(field.size() - point, 10u) << field;
  return std::stoll(field.substr(0, point)) * 1'000'000'000 + std::stoll(field.substr(point + 1));
}

class TrajectoryTest : public ExecutableTest {
 protected:
  static SimulatorOptions Truth() {
    SimulatorOptions truth;
    truth.seed = 500;
    truth.duration_s = 14.0;
    truth.time_shift_s = 100.5;  // on the clock of the imu it is 100.5 s earlier
    truth.gyro_bias_walk = truth.accel_bias_walk = 0.0;
    return truth;
  }
  /// x.bag, without the poses from 6 s to 7 s.
  void SetUp() override {
    ExecutableTest::SetUp();
    SessionData data = Simulate(truth_);
    const auto is_out = [this](const PoseSample& pose) {
      const int64_t t = pose.t_ns - truth_.start_ns;
      return t > 6'000'000'000 && t < 7'000'000'000;
    };
    data.poses.erase(std::remove_if(data.poses.begin(), data.poses.end(), is_out),
                     data.poses.end());
    WriteBag(Path("x.bag"), data, {});
  }
  Outcome Run(const std::string& arguments) {
    return Calibrate("x.bag --output x.yaml --trajectory " + arguments);
  }
  /// The state of the IMU at a stamp of its clock is the truth to within 3 mm and 3 mrad.
  void ExpectTrue(int64_t stamp_ns, const Eigen::Vector3d& p, const Eigen::Quaterniond& q,
                  const Eigen::Vector3d* v = nullptr) {
    const TrueState s = trajectory_.At(1e-9 * static_cast<double>(stamp_ns - truth_.start_ns) +
                                       truth_.time_shift_s);
    EXPECT_NEAR(q.norm(), 1.0, 1e-9);
    ASSERT_LT((p - s.p_WM - s.R_WM * truth_.T_MI.p).norm(), 3e-3) << stamp_ns;
    const Eigen::Quaterniond q_WI = Eigen::Quaterniond(s.R_WM) * truth_.T_MI.q;
    ASSERT_LT(Log(Eigen::Quaterniond(q_WI.conjugate() * q)).norm(), 3e-3) << stamp_ns;
    if (v == nullptr) return;
    ASSERT_LT((*v - s.v_W - s.R_WM * s.omega_M.cross(truth_.T_MI.p)).norm(), 1e-2) << stamp_ns;
  }

  const SimulatorOptions truth_ = Truth();
  const TrueTrajectory trajectory_{truth_};
};

TEST_F(TrajectoryTest, TumIsAsEvoReadsIt) {
  const Outcome outcome = Run("x.tum");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_TRUE(Contains(outcome.out, "by the imu alone in 1 gap of up to 1.0")) << outcome.out;
  // evo: all rows of 8 fields with one blank between; quaternions of unit norm; rising stamps.
  // Comments say which states no poses support.
  const std::string carried = "# by the imu alone, no poses: ";
  const std::vector<std::string> all = Lines(Path("x.tum"));
  ASSERT_EQ(all[1].compare(0, carried.size(), carried), 0) << all[1];
  const Row run = Split(all[1].substr(carried.size()), ' ');
  EXPECT_NEAR(std::stod(run[0]) + truth_.time_shift_s - 1.6e9, 6.0, 0.03);
  EXPECT_NEAR(std::stod(run[2]) + truth_.time_shift_s - 1.6e9, 7.0, 0.03);
  const std::vector<std::string> lines = States(Path("x.tum"));
  ASSERT_EQ(all.size(), lines.size() + 2);
  ASSERT_GT(lines.size(), 2780u);
  int64_t last = 0;
  Eigen::Quaterniond last_q(0.0, 0.0, 0.0, 0.0);
  for (const std::string& line : lines) {
    const Row row = Split(line, ' ');
    ASSERT_EQ(row.size(), 8u) << line;
    const int64_t stamp = FromSeconds(row[0]);
    ASSERT_GT(stamp, last);
    if (last > 0) {
      ASSERT_LT(stamp - last, 6'000'000);  // no gap
    }
    last = stamp;
    const Eigen::Quaterniond q(Number(row[7]), Number(row[4]), Number(row[5]), Number(row[6]));
    ASSERT_GE(q.dot(last_q), 0.0);
    last_q = q;
    ExpectTrue(stamp, Vector(row, 1), q);
  }
}

TEST_F(TrajectoryTest, GapsAreLeftOutWhenTheyAreLongerThanAskedFor) {
  const Outcome outcome = Run("x.txt --trajectory-gaps 0 --trajectory-rate 50");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_TRUE(Contains(outcome.out, ", 1 gap left out (1.0 s)")) << outcome.out;
  size_t gaps = 0;
  int64_t last = 0;
  for (const std::string& line : States(Path("x.txt"))) {
    const int64_t stamp = FromSeconds(Split(line, ' ')[0]);
    if (last > 0 && stamp - last != 20'000'000) {
      ++gaps;
      EXPECT_NEAR(1e-9 * static_cast<double>(stamp - last), 1.06, 0.03);
    }
    last = stamp;
  }
  EXPECT_EQ(gaps, 1u);
}

TEST_F(TrajectoryTest, OvEvalHasCovariances) {
  ASSERT_EQ(Run("x.txt --trajectory-format ov_eval --trajectory-rate 20").status, 0);
  const std::vector<std::string> lines = States(Path("x.txt"));
  ASSERT_GT(lines.size(), 250u);
  double largest_in_gap = 0.0, largest = 0.0;
  for (const std::string& line : lines) {
    const Row row = Split(line, ' ');
    ASSERT_EQ(row.size(), 20u) << line;
    const int64_t stamp = FromSeconds(row[0]);
    ExpectTrue(stamp, Vector(row, 1),
               {Number(row[7]), Number(row[4]), Number(row[5]), Number(row[6])});
    for (const size_t first : {size_t{8}, size_t{14}}) {
      // 11 12 13 22 23 33
      Eigen::Matrix3d C;
      C.row(0) = Vector(row, first);
      C.row(1) << C(0, 1), Number(row[first + 3]), Number(row[first + 4]);
      C.row(2) << C(0, 2), C(1, 2), Number(row[first + 5]);
      EXPECT_GT(C.selfadjointView<Eigen::Upper>().eigenvalues().minCoeff(), 0.0);
      EXPECT_LT(C.trace(), 1e-5);
      if (first == 8) continue;
      const double t = 1e-9 * static_cast<double>(stamp - truth_.start_ns) + truth_.time_shift_s;
      double* most = t > 6.0 && t < 7.0 ? &largest_in_gap : &largest;
      if (t > 0.2 && t < 13.8 && std::abs(t - 6.5) > 0.7 + (most == &largest ? 0.0 : -0.7))
        *most = std::max(*most, C.trace());
    }
  }
  EXPECT_GT(largest_in_gap, 1.5 * largest);
}

TEST_F(TrajectoryTest, EurocHasOneHeaderAndSeventeenColumns) {
  const Outcome outcome = Run("x.csv");
  ASSERT_EQ(outcome.status, 0);
  EXPECT_TRUE(Contains(outcome.out, "by the imu alone, which the format cannot say: 1599999"))
      << outcome.out;
  std::vector<std::string> lines = Lines(Path("x.csv"));
  // As in the dataset, comma and blank.
  const Row header = Split(lines[0], ',');
  ASSERT_EQ(header.size(), 17u);
  EXPECT_EQ(header[0], "#timestamp");
  EXPECT_EQ(header[1], " p_RS_R_x [m]");
  EXPECT_EQ(header[4], " q_RS_w []");
  EXPECT_EQ(header[8], " v_RS_R_x [m s^-1]");
  EXPECT_EQ(header[11], " b_w_RS_S_x [rad s^-1]");
  EXPECT_EQ(header[16], " b_a_RS_S_z [m s^-2]");
  lines.erase(lines.begin());
  ASSERT_GT(lines.size(), 2780u);
  for (const std::string& line : lines) {
    const Row row = Split(line, ',');
    ASSERT_EQ(row.size(), 17u) << line;
    ASSERT_EQ(row[0].find_first_not_of("0123456789"), std::string::npos) << row[0];
    const Eigen::Vector3d v = Vector(row, 8);
    ExpectTrue(std::stoll(row[0]), Vector(row, 1),
               {Number(row[4]), Number(row[5]), Number(row[6]), Number(row[7])}, &v);
    ASSERT_LT((Vector(row, 11) - truth_.gyro_bias).norm(), 2e-3);
    ASSERT_LT((Vector(row, 14) - truth_.accel_bias).norm(), 0.1);
  }
}

TEST_F(TrajectoryTest, AslFolderIsADataset) {
  const Outcome outcome = Run("out --trajectory-clock poses");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  const std::string truth = "out/mav0/state_groundtruth_estimate0/";
  const std::vector<std::string> states = Lines(Path(truth + "data.csv"));
  const std::vector<std::string> sigmas = Lines(Path(truth + "sigma.csv"));
  ASSERT_EQ(states.size(), sigmas.size());
  size_t carried = 0;
  for (size_t k = 1; k < states.size(); ++k) {
    const Row state = Split(states[k], ','), sigma = Split(sigmas[k], ',');
    ASSERT_EQ(sigma.size(), 17u);
    ASSERT_EQ(state[0], sigma[0]);
    for (size_t i = 1; i < 16; ++i) ASSERT_GT(Number(sigma[i]), 0.0);
    if (sigma[16] == "1") ++carried;
    if (k % 100 != 0) continue;
    // On the clock of the poses.
    ExpectTrue(std::stoll(state[0]) - 100'500'000'000, Vector(state, 1),
               {Number(state[4]), Number(state[5]), Number(state[6]), Number(state[7])});
  }
  EXPECT_NEAR(static_cast<double>(carried), 208.0, 10.0);
  const std::string imu = "out/mav0/imu0/";
  EXPECT_EQ(Lines(Path(imu + "data.csv"))[0],
            "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
            "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]");
  EXPECT_EQ(ReadText(Path(imu + "sensor.yaml")).find("%YAML:1.0\n"), 0u);
  const YAML::Node sensor = YAML::Load(ReadText(Path(imu + "sensor.yaml")).substr(10));
  EXPECT_EQ(sensor["T_BS"]["data"].size(), 16u);
  EXPECT_NEAR(sensor["rate_hz"].as<double>(), truth_.gyro_rate_hz, 0.01);
  EXPECT_NEAR(sensor["gyroscope_noise_density"].as<double>(),
              truth_.gyro_std / std::sqrt(truth_.gyro_rate_hz),
              0.1 * truth_.gyro_std / std::sqrt(truth_.gyro_rate_hz));

  // The IMU calibrated against its own ground truth: nowhere else, at no other time.
  const Outcome again = Calibrate("out --output again.yaml");
  ASSERT_EQ(again.status, 0) << again.err;
  const YAML::Node result = YAML::LoadFile(Path("again.yaml"));
  for (int i = 0; i < 3; ++i) {
    EXPECT_NEAR(result["transform"]["translation"][i].as<double>(), 0.0, 1e-3);
    EXPECT_NEAR(result["transform"]["rotation"][i].as<double>(), 0.0, 1e-3);
  }
  EXPECT_NEAR(result["time_shift"].as<double>(), 0.0, 1e-4);
  EXPECT_NEAR(result["accel_delay"].as<double>(), 0.0, 2e-4);

  // Ours is written again, another one is not.
  EXPECT_EQ(Run("out/").status, 0);
  std::filesystem::create_directories(Path("theirs/mav0/imu0"));
  Write("theirs/mav0/imu0/data.csv", "precious");
  ExpectFailure("x.bag --trajectory theirs", 1, {"trajectory", "theirs", "another dataset"});
  EXPECT_EQ(ReadText(Path("theirs/mav0/imu0/data.csv")), "precious");
  EXPECT_EQ(Calibrate("out --output out.yaml --trajectory out").status, 1);  // its own input
}

TEST_F(TrajectoryTest, BagHasOdometryPathAndTf) {
  ASSERT_EQ(Run("t.bag --imu-frame body").status, 0);
  rosbag::Bag bag(Path("t.bag"), rosbag::bagmode::Read);
  size_t odometries = 0, transforms = 0, paths = 0, same = 0;
  nav_msgs::Odometry::ConstPtr odometry;
  std::vector<bool> carried;
  for (const rosbag::MessageInstance& message : rosbag::View(bag)) {
    if (const auto o = message.instantiate<nav_msgs::Odometry>()) {
      ++odometries;
      odometry = o;
      EXPECT_EQ(message.getTopic(), "/ground_truth/odometry");
      EXPECT_EQ(o->header.frame_id, "world");
      EXPECT_EQ(o->child_frame_id, "body_ground_truth");
      const PoseSample pose = ToPoseSample(o->header.stamp, o->pose);
      const Eigen::Vector3d v_I(o->twist.twist.linear.x, o->twist.twist.linear.y,
                                o->twist.twist.linear.z);
      const Eigen::Vector3d v_W = pose.q_WM * v_I;  // twist is in the child's frame
      ExpectTrue(pose.t_ns, pose.p_WM, pose.q_WM, &v_W);
      const TrueState s = trajectory_.At(1e-9 * static_cast<double>(pose.t_ns - truth_.start_ns) +
                                         truth_.time_shift_s);
      const Eigen::Vector3d omega(o->twist.twist.angular.x, o->twist.twist.angular.y,
                                  o->twist.twist.angular.z);
      EXPECT_LT((omega - truth_.T_MI.q.conjugate() * s.omega_M).norm(), 0.05)
          << pose.t_ns - truth_.start_ns;
      for (size_t i = 0; i < 36; ++i) {
        if (i % 7 == 0) {
          EXPECT_GT(o->pose.covariance[i], 0.0);
          EXPECT_GT(o->twist.covariance[i], 0.0);
        }
        EXPECT_NEAR(o->pose.covariance[i], o->pose.covariance[6 * (i % 6) + i / 6], 1e-15);
      }
    } else if (const auto tf = message.instantiate<tf2_msgs::TFMessage>()) {
      ++transforms;
      ASSERT_EQ(tf->transforms.size(), 1u);
      EXPECT_EQ(tf->transforms[0].child_frame_id, "body_ground_truth");
      const ros::Time stamp = tf->transforms[0].header.stamp;
      EXPECT_EQ(tf->transforms[0].header.frame_id, "world");
      if (odometry && odometry->header.stamp == stamp) {
        ++same;
        EXPECT_EQ(tf->transforms[0].transform.translation.x, odometry->pose.pose.position.x);
      }
    } else if (const auto path = message.instantiate<nav_msgs::Path>()) {
      ++paths;
      EXPECT_NEAR(static_cast<double>(path->poses.size()), 20.0 * 14.0, 10.0);
    } else if (const auto flag = message.instantiate<std_msgs::Bool>()) {
      EXPECT_EQ(message.getTopic(), "/ground_truth/by_imu_alone");
      carried.push_back(flag->data != 0);
    }
  }
  EXPECT_GT(odometries, 2780u);
  EXPECT_EQ(odometries, transforms);
  EXPECT_GT(same, 1u);
  EXPECT_EQ(paths, 1u);
  EXPECT_EQ(carried, (std::vector<bool>{false, true, false}));
}

TEST_F(TrajectoryTest, SeveralImusAndSessionsHaveAFileEach) {
  SimulatorOptions other = truth_;
  other.seed = 501;
  WriteBag(Path("a.bag"), Simulate(truth_, 2), {});
  WriteBag(Path("b.bag"), Simulate(other, 2), {});
  const Outcome outcome = Calibrate(
      "a.bag b.bag --imu-topic /imu --imu-topic /imu1 --output x.yaml --trajectory t.tum "
      "--trajectory-rate 10");
  ASSERT_EQ(outcome.status, 0) << outcome.err;
  EXPECT_FALSE(std::filesystem::exists(Path("t.tum")));
  for (const char* name :
       {"t_session1_imu0.tum", "t_session1_imu1.tum", "t_session2_imu0.tum", "t_session2_imu1.tum"})
    EXPECT_GT(States(Path(name)).size(), 130u) << name;
  for (const std::string& line : States(Path("t_session1_imu0.tum"))) {
    const Row row = Split(line, ' ');
    ExpectTrue(FromSeconds(row[0]), Vector(row, 1),
               {Number(row[7]), Number(row[4]), Number(row[5]), Number(row[6])});
  }
}

TEST_F(TrajectoryTest, RefusesBeforeItCalibrates) {
  ExpectFailure("x.bag --trajectory t.foo", 1, {"t.foo", ".tum", "trajectory_format"});
  ExpectFailure("x.bag --trajectory t.tum --trajectory-format g2o", 1, {"'g2o'", "ov_eval"});
  ExpectFailure("x.bag --trajectory t.tum --trajectory-clock mars", 1, {"'mars'", "poses"});
  ExpectFailure("x.bag --trajectory t.tum --trajectory-rate -1", 1, {"trajectory_rate = -1.0"});
  ExpectFailure("x.bag --trajectory-rate 5", 1, {"trajectory"});
  ExpectFailure("x.bag --trajectory none/t.tum", 1, {"there is no folder 'none'"});
  ExpectFailure("x.bag --trajectory x.bag", 1, {"trajectory 'x.bag' would replace the bag"});
  ExpectFailure("x.bag --trajectory x.calibration.yaml --trajectory-format tum", 1,
                {"trajectory and output are both"});
  ExpectFailure("x.bag --method gp --trajectory t.txt --trajectory-format ov_eval", 1,
                {"ov_eval", "method joint"});
  std::filesystem::create_directory(Path("folder.tum"));
  ExpectFailure("x.bag --trajectory folder.tum --trajectory-format tum", 1, {"is a folder"});
  EXPECT_FALSE(std::filesystem::exists(Path("t.tum")));
}

TEST_F(TrajectoryTest, GpGivesStatesWithoutSigmas) {
  ASSERT_EQ(Run("out --method gp").status, 0);
  EXPECT_GT(Lines(Path("out/mav0/state_groundtruth_estimate0/data.csv")).size(), 2000u);
  EXPECT_FALSE(std::filesystem::exists(Path("out/mav0/state_groundtruth_estimate0/sigma.csv")));
}

/// Largest distance of the states of two files of TUM at the same stamps [m], and how many there
/// are.
std::pair<double, size_t> Apart(const std::vector<std::string>& a,
                                const std::vector<std::string>& b) {
  std::map<int64_t, Eigen::Vector3d> positions;
  for (const std::string& line : a) {
    const Row row = Split(line, ' ');
    positions[FromSeconds(row[0])] = Vector(row, 1);
  }
  std::pair<double, size_t> apart{0.0, 0};
  for (const std::string& line : b) {
    const Row row = Split(line, ' ');
    const auto same = positions.find(FromSeconds(row[0]));
    if (same == positions.end()) continue;
    apart.first = std::max(apart.first, (same->second - Vector(row, 1)).norm());
    ++apart.second;
  }
  return apart;
}

TEST_F(TrajectoryTest, SimulationWritesTheTruth) {
  ASSERT_EQ(ExecutableTest::Run("simulate_bag",
                                "y.bag --duration 14 --seed 500 --time-shift 100.5 --truth y.tum")
                .status,
            0);
  const std::vector<std::string> lines = States(Path("y.tum"));
  ASSERT_EQ(lines.size(), 2800u);
  for (const std::string& line : lines) {
    const Row row = Split(line, ' ');
    const TrueState s = trajectory_.At(
        1e-9 * static_cast<double>(FromSeconds(row[0]) - truth_.start_ns) + truth_.time_shift_s);
    ASSERT_LT((Vector(row, 1) - s.p_WM - s.R_WM * truth_.T_MI.p).norm(), 1e-8) << line;
  }
  // Ours against it; then with filters, drift and late stamps, on the same clock all the same.
  for (const char* effects : {"", "--gyro-filter 40 --imu-burst 5 --clock-drift 3e-5"}) {
    SCOPED_TRACE(effects);
    ASSERT_EQ(ExecutableTest::Run("simulate_bag",
                                  std::string("y.bag --duration 14 --truth y.tum ") + effects)
                  .status,
              0);
    ASSERT_EQ(Calibrate("y.bag --trajectory z.tum --trajectory-rate 200").status, 0);
    const auto [distance, count] = Apart(States(Path("y.tum")), States(Path("z.tum")));
    if (*effects == '\0') {
      EXPECT_GT(count, 2700u);
    }
    EXPECT_LT(distance, 3e-3);
  }
  ASSERT_EQ(ExecutableTest::Run("simulate_bag", "y.bag --duration 3 --imus 2 --truth t").status, 0);
  EXPECT_TRUE(std::filesystem::exists(Path("t_imu1/mav0/state_groundtruth_estimate0/data.csv")));
  const Outcome refused = ExecutableTest::Run("simulate_bag", "new.bag --duration 3 --truth t.xyz");
  EXPECT_EQ(refused.status, 1);
  EXPECT_FALSE(std::filesystem::exists(Path("new.bag")));
}

/// The trajectory of a pose sensor, with an IMU and without.
TEST_F(TrajectoryTest, OfAPoseSensorIsOnItsClock) {
  SimulatorOptions truth = Truth();
  truth.duration_s = 20.0;
  truth.pose_sensors.resize(2);
  truth.pose_sensors[1].time_shift_s = -30.5;
  const SessionData data = Simulate(truth);
  const TrueTrajectory trajectory(truth);
  RecordingInfo info;
  info.world_frame = "map";
  info.pose_sensors = {{"/a", "camera", "a"}, {"/b", "lidar", "b"}};
  for (const bool has_imu : {true, false}) {
    SessionData recorded = data;
    if (!has_imu) recorded.imus.clear();
    const Calibration result = imu_pose_calib::Calibrate({}, recorded);
    ASSERT_EQ(result.status, Status::kOk) << result.message;
    TrajectoryRequest request;
    request.path = Path(has_imu ? "with.tum" : "without.tum");
    request.frame = "lidar";
    const auto targets =
        PlanTrajectories(request, Method::kJoint, 1, recorded.imus.size(), info.pose_sensors);
    ASSERT_EQ(targets.size(), 1u);
    EXPECT_TRUE(targets[0].IsIn(result));
    OutputFiles outputs;
    outputs.Plan("trajectory", targets[0].path, false);
    const auto lines = WriteTrajectories(request, targets, {{}, {}, {info}, result}, &outputs);
    outputs.Commit();
    EXPECT_EQ(Contains(lines[0], ", without sigmas"), !has_imu) << lines[0];
    const std::vector<std::string> states = States(request.path);
    ASSERT_GT(states.size() + 10, data.pose_sensors[1].size());
    auto pose = data.pose_sensors[1].begin();
    for (const std::string& line : states) {
      const Row row = Split(line, ' ');
      const int64_t stamp = FromSeconds(row[0]);
      while (pose->t_ns < stamp) ++pose;
      ASSERT_EQ(pose->t_ns, stamp);
      const TrueState s = trajectory.At(1e-9 * static_cast<double>(stamp - truth.start_ns) - 30.5);
      const Rigid3 T_WS = Rigid3{Eigen::Quaterniond(s.R_WM), s.p_WM} * truth.pose_sensors[1].T_MS;
      ASSERT_LT((Vector(row, 1) - T_WS.p).norm(), 3e-3);
      ASSERT_LT(T_WS.q.angularDistance(Eigen::Quaterniond(Number(row[7]), Number(row[4]),
                                                          Number(row[5]), Number(row[6]))),
                3e-3);
    }
  }
}

TEST_F(TrajectoryTest, PlansPoseSensors) {
  const std::vector<PoseSensorInfo> two = {{"/a", "camera", "a"}, {"/b", "lidar", "b"}};
  const auto plan = [&](const TrajectoryRequest& request, size_t imus) {
    std::vector<std::string> names;
    for (const TrajectoryTarget& target : PlanTrajectories(request, Method::kJoint, 1, imus, two))
      names.push_back(target.path + (target.is_sensor ? " sensor" : " imu") +
                      std::to_string(target.place));
    return names;
  };
  const auto error = [&](const TrajectoryRequest& request, size_t imus) -> std::string {
    try {
      plan(request, imus);
    } catch (const InputError& e) {
      return e.what();
    }
    return "none";
  };
  using Names = std::vector<std::string>;
  EXPECT_EQ(plan({"t.tum", "", "", ""}, 1), Names{"t.tum imu0"});
  EXPECT_EQ(plan({"t.tum", "", "", "sensor1"}, 2), Names{"t.tum sensor1"});
  EXPECT_EQ(plan({"t.tum", "", "", ""}, 0),
            (Names{"t_sensor0.tum sensor0", "t_sensor1.tum sensor1"}));
  EXPECT_EQ(error({"t.tum", "", "", "sensor"}, 1),
            "trajectory_frame 'sensor' is no pose sensor of the recording; must be sensor0 "
            "(camera), sensor1 (lidar)");
  EXPECT_TRUE(Contains(error({"t.csv", "", "", "camera"}, 1), "a pose sensor has none"));
  EXPECT_TRUE(Contains(error({"t.tum", "ov_eval", "", ""}, 0), "there are none without an imu"));
  EXPECT_TRUE(Contains(error({"t.tum", "", "imu", "camera"}, 1), "trajectory_clock imu"));
}

}  // namespace
}  // namespace imu_pose_calib
