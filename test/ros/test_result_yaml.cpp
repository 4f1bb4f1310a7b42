#include <yaml-cpp/yaml.h>

#include <functional>

#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/result_yaml.h"
#include "imu_pose_calib/ros/io/ros_options.h"
#include "imu_pose_calib/ros/io/text.h"
#include "stored_example.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

Calibration MakeResult() {
  Calibration result;
  result.status = Status::kOk;
  result.method = Method::kGp;
  result.message = "fine: \"really\"";
  result.imus[0].T_MI = {Eigen::Quaterniond(0.5, -0.5, 0.5, 0.5), {1.0 / 3.0, -0.2, 3e-8}};
  result.imus[0].covariance =
      (Vector6d() << 1e-6, 4e-6, 9e-6, 1e-8, 4e-8, 9e-8).finished().asDiagonal();
  result.imus[0].covariance(1, 4) = result.imus[0].covariance(4, 1) = 1e-9;
  result.sessions[0].imus[0].time_shift = -1034771.50664123456;
  result.sessions[0].imus[0].time_shift_std = 1e-5;
  result.imus[0].accel_delay = 0.0037;
  result.imus[0].accel_delay_std = 2e-5;
  result.pose_smoothing = -1.5e-5;
  result.pose_smoothing_std = 2.5e-6;
  result.position_smoothing = 1e-4;
  result.position_smoothing_std = 3e-6;
  result.pose_cumulants = {3e-5, -4e-7};
  result.pose_cumulants_std = {2e-6, 5e-8};
  result.position_cumulants = {1e-6, 6e-8};
  result.position_cumulants_std = {7e-7, 8e-8};
  result.position_delay = -2e-3;
  result.position_delay_std = 4e-5;
  result.pose_scale = 1.002;
  result.pose_scale_std = 4e-4;
  result.sessions[0].g_W = {0.0, 3.0, -4.0};
  result.sessions[0].imus[0].gyro_bias = {0.1, 0.2, 0.3};
  result.sessions[0].imus[0].accel_bias = {0.4, 0.5, 0.6};
  result.sessions[0].noise = {0.001, 0.002};
  result.sessions[0].imus[0].noise = {0.003, 0.004};
  result.sessions[0].rms = {0.011, 0.012};
  result.sessions[0].imus[0].rms = {0.013, 0.014};
  result.warnings = {"w1"};
  result.observability = {{"p_MI along marker z", 0.25, "m", Status::kWeak}};
  result.unobservable = {"p_MI along marker z: turn about a second axis"};
  result.sessions[0].poses.used = 4000;
  result.sessions[0].poses.outlier = 3;
  result.sessions[0].poses.rate_hz = 100.0;
  result.sessions[0].poses.duration_s = 39.5;
  result.sessions[0].poses.stamps_recovered = true;
  result.sessions[0].poses.stamp_jitter_s = 3.1e-3;
  result.sessions[0].imus[0].gyro.used = 7920;
  result.sessions[0].imus[0].gyro.duplicate_stamp = 2;
  result.sessions[0].imus[0].accel.used = 7919;
  result.sessions[0].gaps = 2;
  return result;
}

RecordingInfo MakeInfo() {
  RecordingInfo info;
  info.bag = "dir/x.bag";
  info.imus[0].imu_topic = "/imu";
  info.pose_topic = "/mocap/pose";
  info.world_frame = "world";
  info.marker_frame = "marker";
  info.imus[0].imu_frame = "imu";
  return info;
}

YAML::Node Parsed() { return YAML::Load(ToYaml(MakeResult(), {MakeInfo()}, CalibrationOptions())); }

Eigen::MatrixXd Matrix(const YAML::Node& node) {
  Eigen::MatrixXd matrix(node.size(), node[0].size());
  for (Eigen::Index i = 0; i < matrix.rows(); ++i)
    for (Eigen::Index j = 0; j < matrix.cols(); ++j) matrix(i, j) = node[i][j].as<double>();
  return matrix;
}

using Doubles = std::vector<double>;
using Strings = std::vector<std::string>;

TEST(ResultYaml, HoldsHeadAndFrames) {
  const YAML::Node yaml = Parsed();
  const YAML::Node head = yaml["imu_pose_calib"];
  EXPECT_EQ(head["version"].as<std::string>(), kVersion);
  EXPECT_EQ(head["method"].as<std::string>(), "gp");
  EXPECT_EQ(head["status"].as<std::string>(), "ok");
  EXPECT_EQ(head["message"].as<std::string>(), "fine: \"really\"");
  EXPECT_EQ(head["date"].as<std::string>().size(), std::string("2020-01-01T00:00:00Z").size());
  EXPECT_EQ(yaml["frames"]["world"].as<std::string>(), "world");
  EXPECT_EQ(yaml["frames"]["marker"].as<std::string>(), "marker");
  EXPECT_EQ(yaml["frames"]["imu"].as<std::string>(), "imu");
}

TEST(ResultYaml, HoldsTransformExactly) {
  const Calibration result = MakeResult();
  const YAML::Node transform = Parsed()["transform"];
  EXPECT_EQ(transform["translation"].as<Doubles>(), Doubles({1.0 / 3.0, -0.2, 3e-8}));
  EXPECT_EQ(transform["rotation"].as<Doubles>(), Doubles({-0.5, 0.5, 0.5, 0.5}));
  EXPECT_EQ(Matrix(transform["matrix"]), result.imus[0].T_MI.Matrix());
  EXPECT_EQ(Matrix(transform["covariance"]), result.imus[0].covariance);
  for (size_t i = 0; i < 3; ++i) {
    EXPECT_EQ(transform["translation_std"][i].as<double>(), result.imus[0].Std()[i]);
    EXPECT_EQ(transform["rotation_std"][i].as<double>(), result.imus[0].Std()[3 + i]);
  }
}

TEST(ResultYaml, InverseUndoesTransform) {
  const YAML::Node yaml = Parsed();
  const Eigen::MatrixXd product =
      Matrix(yaml["transform"]["matrix"]) * Matrix(yaml["inverse_transform"]["matrix"]);
  EXPECT_TRUE(product.isIdentity(1e-12)) << product;
  const auto p = yaml["inverse_transform"]["translation"].as<Doubles>();
  const auto q = yaml["inverse_transform"]["rotation"].as<Doubles>();
  EXPECT_EQ(q, Doubles({0.5, -0.5, -0.5, 0.5}));
  EXPECT_EQ(p[2], Matrix(yaml["inverse_transform"]["matrix"])(2, 3));
}

TEST(ResultYaml, HoldsClocksGravityAndBiases) {
  const Calibration result = MakeResult();
  const YAML::Node yaml = Parsed();
  EXPECT_EQ(yaml["time_shift"].as<double>(), result.sessions[0].imus[0].time_shift);
  EXPECT_EQ(yaml["time_shift_std"].as<double>(), 1e-5);
  EXPECT_EQ(yaml["accel_delay"].as<double>(), 0.0037);
  EXPECT_EQ(yaml["accel_delay_std"].as<double>(), 2e-5);
  EXPECT_EQ(yaml["pose_smoothing"].as<double>(), -1.5e-5);
  EXPECT_EQ(yaml["pose_smoothing_std"].as<double>(), 2.5e-6);
  EXPECT_EQ(yaml["position_smoothing"].as<double>(), 1e-4);
  EXPECT_EQ(yaml["position_smoothing_std"].as<double>(), 3e-6);
  using Pair = std::vector<double>;
  EXPECT_EQ(yaml["pose_cumulants"].as<Pair>(), (Pair{3e-5, -4e-7}));
  EXPECT_EQ(yaml["pose_cumulants_std"].as<Pair>(), (Pair{2e-6, 5e-8}));
  EXPECT_EQ(yaml["position_cumulants"].as<Pair>(), (Pair{1e-6, 6e-8}));
  EXPECT_EQ(yaml["position_cumulants_std"].as<Pair>(), (Pair{7e-7, 8e-8}));
  EXPECT_EQ(yaml["position_delay"].as<double>(), -2e-3);
  EXPECT_EQ(yaml["position_delay_std"].as<double>(), 4e-5);
  EXPECT_EQ(yaml["pose_scale"].as<double>(), 1.002);
  EXPECT_EQ(yaml["pose_scale_std"].as<double>(), 4e-4);
  EXPECT_EQ(yaml["gravity"]["vector"].as<Doubles>(), Doubles({0.0, 3.0, -4.0}));
  EXPECT_EQ(yaml["gravity"]["magnitude"].as<double>(), 5.0);
  EXPECT_EQ(yaml["biases"]["gyro"].as<Doubles>(), Doubles({0.1, 0.2, 0.3}));
  EXPECT_EQ(yaml["biases"]["accel"].as<Doubles>(), Doubles({0.4, 0.5, 0.6}));
}

TEST(ResultYaml, HoldsNoiseAndQuality) {
  const YAML::Node noise = Parsed()["noise"], quality = Parsed()["quality"];
  EXPECT_EQ(noise["position_std"].as<double>(), 0.001);
  EXPECT_EQ(noise["rotation_std"].as<double>(), 0.002);
  EXPECT_EQ(noise["gyro_std"].as<double>(), 0.003);
  EXPECT_EQ(noise["accel_std"].as<double>(), 0.004);
  EXPECT_EQ(quality["position_rms"].as<double>(), 0.011);
  EXPECT_EQ(quality["rotation_rms"].as<double>(), 0.012);
  EXPECT_EQ(quality["gyro_rms"].as<double>(), 0.013);
  EXPECT_EQ(quality["accel_rms"].as<double>(), 0.014);
  ASSERT_EQ(quality["observability"].size(), 1u);
  const YAML::Node direction = quality["observability"][0];
  EXPECT_EQ(direction["direction"].as<std::string>(), "p_MI along marker z");
  EXPECT_EQ(direction["std"].as<double>(), 0.25);
  EXPECT_EQ(direction["unit"].as<std::string>(), "m");
  EXPECT_EQ(direction["status"].as<std::string>(), "weak");
  EXPECT_EQ(quality["warnings"].as<Strings>(), Strings({"w1"}));
}

TEST(ResultYaml, HoldsDataAndOptions) {
  const YAML::Node yaml = Parsed(), data = yaml["data"];
  EXPECT_EQ(data["bag"].as<std::string>(), "dir/x.bag");
  EXPECT_EQ(data["imu_topic"].as<std::string>(), "/imu");
  EXPECT_EQ(data["pose_topic"].as<std::string>(), "/mocap/pose");
  EXPECT_EQ(data["duration"].as<double>(), 39.5);
  EXPECT_EQ(data["counts"]["poses"].as<int>(), 4000);
  EXPECT_EQ(data["counts"]["gyro"].as<int>(), 7920);
  EXPECT_EQ(data["counts"]["accel"].as<int>(), 7919);
  EXPECT_EQ(data["rates"]["poses"].as<double>(), 100.0);
  EXPECT_TRUE(data["stamps_recovered"]["poses"].as<bool>());
  EXPECT_FALSE(data["stamps_recovered"]["gyro"].as<bool>());
  EXPECT_EQ(data["stamp_jitter"]["poses"].as<double>(), 3.1e-3);
  EXPECT_EQ(data["stamp_jitter"]["accel"].as<double>(), 0.0);
  EXPECT_EQ(data["rejected"]["poses"]["outlier"].as<int>(), 3);
  EXPECT_EQ(data["rejected"]["gyro"]["duplicate_stamp"].as<int>(), 2);
  EXPECT_EQ(data["rejected"]["accel"]["not_finite"].as<int>(), 0);
  EXPECT_EQ(data["gaps"].as<int>(), 2);
  EXPECT_EQ(yaml["options"]["gravity_magnitude"].as<double>(), 9.80665);
}

TEST(ResultYaml, StatesTheEquations) {
  const std::string text = ToYaml(MakeResult(), {MakeInfo()}, CalibrationOptions());
  EXPECT_EQ(text.compare(0, std::string(kResultHeader).size(), kResultHeader), 0);
  for (const char* equation :
       {"x_marker = R x_imu + p", "t_pose = t_imu + time_shift", "t_imu = t_pose - time_shift",
        "t_pose = t_accel + time_shift - accel_delay"})
    EXPECT_TRUE(Contains(text, equation)) << equation;
}

TEST(ResultYaml, HoldsWherePoseSensorsAre) {
  const YAML::Node sensors = YAML::Load(SensorYaml(2))["pose_sensors"];
  Calibration result = ExampleResult(ImuModel::kCalibrated, 2);
  RecordingInfo info;
  AddSensors(&result, &info);
  ASSERT_EQ(sensors.size(), 2u);
  for (size_t k = 0; k < 2; ++k) {
    const PoseSensorCalibration& sensor = result.pose_sensors[k];
    EXPECT_EQ(Matrix(sensors[k]["transform"]["matrix"]), sensor.T_MS.Matrix());
    EXPECT_EQ(sensors[k]["transform"]["rotation_std"][2].as<double>(), 5e-4);
    ASSERT_EQ(sensors[k]["to_imus"].size(), 2u);
    for (size_t i = 0; i < 2; ++i) {  // x_I = T_IS x_S: both are the same point of the marker
      const YAML::Node to_imu = sensors[k]["to_imus"][i];
      EXPECT_EQ(to_imu["imu"].as<std::string>(), "imu" + std::to_string(i));
      const Eigen::Vector4d x_S(0.4, -1.2, 2.7, 1.0);
      const Eigen::Vector4d x_I = Matrix(to_imu["transform"]["matrix"]) * x_S;
      EXPECT_LT((result.imus[i].T_MI.Matrix() * x_I - sensor.T_MS.Matrix() * x_S).norm(), 1e-12);
      // No better than the sensor, whose rotation and that of the IMU add up about its axes.
      for (size_t a = 0; a < 3; ++a) {
        const double std_dev = to_imu["transform"]["rotation_std"][a].as<double>();
        EXPECT_GT(std_dev, sensor.Std()[3 + static_cast<Eigen::Index>(a)]);
        EXPECT_LT(std_dev, std::hypot(sensor.Std()[3 + static_cast<Eigen::Index>(a)], 3.1e-4));
      }
    }
    const YAML::Node session = sensors[k]["sessions"][0];
    EXPECT_EQ(session["pieces"].as<int>(), 2);
    EXPECT_EQ(session["data"]["rejected"]["outlier"].as<int>(), 12);
    EXPECT_EQ(sensors[k]["observability"][0]["status"].as<std::string>(), "ok");
  }
  EXPECT_TRUE(Contains(SensorYaml(), "x_marker = R x_sensor + p"));
  EXPECT_FALSE(Contains(ExampleYaml(), "pose_sensors") || Contains(ExampleYaml(), "x_sensor"));
}

TEST(ResultYaml, WithoutAnImuHasNoKeysOfIt) {
  const auto keys = [](const std::string& yaml) {
    Strings names;
    const std::function<void(const YAML::Node&)> add = [&](const YAML::Node& node) {
      for (const auto& entry : node) {
        if (node.IsMap()) names.push_back(entry.first.as<std::string>());
        if (node.IsMap() && names.back() != "options") add(entry.second);
        if (node.IsSequence() && !entry.IsScalar()) add(entry);
      }
    };
    add(YAML::Load(yaml));
    return names;
  };
  const Strings with = keys(SensorYaml(1)), without = keys(SensorYaml(0));
  for (const char* key :
       {"imu", "imu_topic", "inverse_transform", "gravity", "biases", "gyro_std", "accel_std",
        "gyro_rms", "pose_smoothing", "to_imus", "split_half", "gyro", "accel_delay", "clock"}) {
    EXPECT_EQ(std::count(without.begin(), without.end(), key), 0) << key;
    EXPECT_GT(std::count(with.begin(), with.end(), key), 0) << key;
  }
  for (const char* key : {"pose_sensors", "position_std", "pose_topic", "time_shift"})
    EXPECT_GT(std::count(without.begin(), without.end(), key), 0) << key;
}

TEST(YamlNumber, IsAFloatInEveryYaml) {
  EXPECT_EQ(YamlNumber(1.0), "1.0");
  EXPECT_EQ(YamlNumber(1e-5), "1.0e-05");
  EXPECT_EQ(YamlNumber(1e20), "1.0e+20");
  EXPECT_EQ(YamlNumber(0.1), "0.1");
  EXPECT_EQ(YamlNumber(-2.5), "-2.5");
  EXPECT_EQ(YamlNumber(std::nan("")), ".nan");
  EXPECT_EQ(YamlNumber(-1.0 / 0.0), "-.inf");
  for (const double value : {1.0 / 3.0, -1034771.50664123456, 5e-324, 1.7976931348623157e308})
    EXPECT_EQ(std::strtod(YamlNumber(value).c_str(), nullptr), value);
}

using ResultFile = TempDirTest;

TEST_F(ResultFile, IsReplacedInOneStep) {
  const std::string path = Write("result.yaml", "old");
  WriteFile(path, "new\n");
  EXPECT_EQ(ReadText(path), "new\n");
  EXPECT_EQ(std::distance(std::filesystem::directory_iterator(dir_), {}), 1);
}

TEST_F(ResultFile, DoesNotFollowALinkLaidInItsWay) {
  const std::string other = Write("other.txt", "not ours");
  std::filesystem::create_symlink(other, Path("result.yaml.tmp" + std::to_string(getpid())));
  WriteFile(Path("result.yaml"), "new\n");
  EXPECT_EQ(ReadText(other), "not ours");
  EXPECT_EQ(ReadText(Path("result.yaml")), "new\n");
  EXPECT_FALSE(std::filesystem::is_symlink(Path("result.yaml")));
}

TEST_F(ResultFile, HasThePermissionsOfAnyNewFile) {
  const mode_t before = umask(027);
  WriteFile(Path("result.yaml"), "new\n");
  umask(before);
  EXPECT_EQ(std::filesystem::status(Path("result.yaml")).permissions(),
            std::filesystem::perms{0640});
}

TEST_F(ResultFile, FailureNamesPathAndReason) {
  ExpectError<InputError>([&] { WriteFile(Path("no/such/dir.yaml"), "x"); },
                          {"no/such/dir.yaml", "No such file or directory"});
  std::filesystem::create_directory(Path("dir"));
  ExpectError<InputError>([&] { WriteFile(Path("dir"), "x"); }, {"dir", "directory"});
  EXPECT_EQ(std::distance(std::filesystem::directory_iterator(dir_), {}), 1);
}

}  // namespace
}  // namespace imu_pose_calib
