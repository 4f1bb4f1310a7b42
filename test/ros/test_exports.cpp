// What is exported maps points and stamps as the result does; names and files of exports.
// Visual-inertial programs and JSON: test_visual_exports.cpp.

#include <boost/algorithm/string/replace.hpp>
#include <cmath>
#include <fstream>
#include <map>
#include <regex>

#include "export_checks.h"
#include "imu_pose_calib/ros/exports/exports.h"

namespace imu_pose_calib {
namespace {

// --- Lists of names ---

TEST(Exports, ListsMayHaveCommasBlanksAndAll) {
  using Names = std::vector<std::string>;
  EXPECT_EQ(ParseExports("kalibr,evo tf"), Names({"kalibr", "evo", "tf"}));
  EXPECT_EQ(ParseExports(" evo, evo "), Names({"evo"}));
  EXPECT_EQ(ParseExports(""), Names());
  EXPECT_EQ(ParseExports("evo,all"), ExportNames());
  EXPECT_EQ(ExportNames().size(), 16u);
  ExpectError<InputError>([] { ParseExports("kalibr,kalib"); },
                          {"'kalib'", "kalibr, openvins, vins, orbslam3, kimera, euroc, basalt"});
}

TEST(Exports, EveryFileStatesEquationsClocksAndVerdict) {
  const StoredResult stored = Example(ImuModel::kScaleMisalignment, 2);
  for (const std::string& name : ExportNames())
    for (const ExportFile& file : Export(stored, name)) {
      for (const char* part :
           {"x_marker = R x_imu + p", "t_pose = t_imu + time_shift, time_shift = 0.0437 s",
            "t_pose = t_accel + time_shift - accel_delay",
            "subtract it from the stamps of accelerometer samples", "weak: sigma of p_MI is 12 mm",
            "from my.calibration.yaml by imu_pose_calib"})
        EXPECT_TRUE(Contains(file.text, part)) << part << " is missing in " << file.text;
      const bool all = Contains(file.text, "all 2 of the rig");
      EXPECT_NE(all, Contains(file.text, "the first of 2")) << file.text;
      EXPECT_EQ(file.ending.compare(0, name.size(), name), 0) << file.ending;
    }
}

TEST(Exports, HaveEveryTemplate) {
  std::ptrdiff_t files = 2;  // head and axes, parts of the comments
  for (const std::string& name : ExportNames())
    files += static_cast<std::ptrdiff_t>(Export(Example(), name).size());
  const std::filesystem::directory_iterator templates(IMU_POSE_CALIB_SOURCE_DIR "/exports"), end;
  EXPECT_EQ(files, std::distance(templates, end));
}

/// Whether a line of `text` is one of a template, with anything for the names in braces.
bool HasLine(const std::string& text, std::string line) {
  line = std::regex_replace(line, std::regex(R"([.*+?()\[\]^$|\\])"), R"(\$&)");
  line = std::regex_replace(line, std::regex(R"(\{[^"{}]+\})"), "[^\n]*");
  line = std::regex_replace(line, std::regex("[{}]"), R"(\$&)");
  return std::regex_search(text, std::regex(line));
}

/// A line whose name nothing has a value for would be missing in every file.
TEST(Exports, HaveEveryLineOfTheirTemplates) {
  StoredResult near = SensorExample(2, ImuModel::kScaleMisalignment), far = near;
  far.result.sessions[0].imus[0].time_shift = -1000.0;
  far.result.sessions.push_back(far.result.sessions[0]);
  for (PoseSensorCalibration& sensor : far.result.pose_sensors)
    sensor.sessions.push_back(sensor.sessions[0]);
  std::map<std::string, std::string> texts;  // by the name of the template
  for (const StoredResult& stored : {near, far})
    for (const std::string& name : ExportNames())
      for (const ExportFile& file : Export(stored, name)) {
        texts[boost::replace_first_copy(file.ending, "imu0", "imuN")] += file.text;
        texts["head"] += file.text;
        texts["axes"] += file.text;
      }
  for (const auto& entry :
       std::filesystem::directory_iterator(IMU_POSE_CALIB_SOURCE_DIR "/exports")) {
    std::ifstream file(entry.path());
    for (std::string line; std::getline(file, line);)
      EXPECT_TRUE(line == "{each imu}" || line == "{end}" ||
                  HasLine(texts.at(entry.path().filename()), line.substr(line[0] == '#' ? 2 : 0)))
          << entry.path() << ": " << line;
  }
}

TEST(Exports, SayNothingOfWhatThereIsNot) {
  StoredResult stored = Example();
  stored.result.sessions[0].imus[0].clock_drift = 0.0;
  for (const std::string& name : ExportNames())
    for (const ExportFile& file : Export(stored, name))
      for (const char* part : {"imus: ", "axes: ", "session 1 of", "it grows by", "1 s, which",
                               "accelerometers:", "is left out:", "run_id"})
        EXPECT_FALSE(Contains(file.text, part)) << part << " is in " << file.text;
}

TEST(Exports, NeedNoiseAndRates) {
  StoredResult stored = Example();
  stored.result.sessions[0].imus[0].accel.rate_hz = 0.0;
  ExpectError<InputError>([&] { Export(stored, "kalibr"); }, {"accelerometer", "0.043", "0.0 Hz"});
}

TEST(Exports, ClocksFarApartAreRemarkedOn) {
  StoredResult stored = Example();
  EXPECT_FALSE(Contains(FileOf(stored, "evo", "evo.json"), "differ by more than 1 s"));
  stored.result.sessions[0].imus[0].time_shift = -1034771.5;
  EXPECT_TRUE(Contains(FileOf(stored, "evo", "evo.json"), "differ by more than 1 s"));
}

// --- Ground truth ---

TEST(Euroc, SensorsMapAsTheResult) {
  const StoredResult stored = Example(ImuModel::kCalibrated, 2);
  const YAML::Node vicon = OpenCvYaml(FileOf(stored, "euroc", "euroc.vicon0.sensor.yaml"));
  ExpectSame(DataMatrix(vicon["T_BS"]), T_MI(stored).inverse());
  for (size_t i = 0; i < 2; ++i) {
    const YAML::Node imu =
        OpenCvYaml(FileOf(stored, "euroc", "euroc.imu" + std::to_string(i) + ".sensor.yaml"));
    ExpectSame(DataMatrix(imu["T_BS"]), T_MI(stored).inverse() * T_MI(stored, i));
    EXPECT_EQ(imu["sensor_type"].as<std::string>(), "imu");
    EXPECT_EQ(imu["rate_hz"].as<int>(), 200);
    ExpectNoise(imu, i);
  }
}

// MeasBased_ViconPoseTimeoffsetFactor.cpp: a state at t_imu meets the Vicon pose of t_imu - toff.
TEST(Vicon2Gt, MapsAsTheResult) {
  const StoredResult stored = Example();
  std::map<std::string, double> params;
  std::map<std::string, std::vector<double>> lists;
  for (const Element& node :
       Xml(FileOf(stored, "vicon2gt", "vicon2gt.launch"), "launch").children) {
    if (node.name == "param") params[node["name"]] = std::stod(node["value"]);
    if (node.name == "rosparam")
      lists[node["param"]] = YAML::Load(node.text).as<std::vector<double>>();
  }
  const std::vector<double>& p = lists.at("p_BinI");
  ExpectSame(ToMatrix(RowMajor(lists.at("R_BtoI"), 3), Eigen::Vector3d(p.at(0), p.at(1), p.at(2))),
             T_MI(stored).inverse());
  ExpectStamp(params.at("toff_imu_to_vicon"), stored);
  ExpectNoise(params.at("gyroscope_noise_density"), params.at("gyroscope_random_walk"),
              params.at("accelerometer_noise_density"), params.at("accelerometer_random_walk"));
  EXPECT_EQ(lists.at("vicon_sigmas"),
            (std::vector<double>{0.0034, 0.0034, 0.0034, 0.0012, 0.0012, 0.0012}));
  EXPECT_NEAR(params.at("gravity_magnitude"), stored.result.sessions[0].g_W.norm(), 1e-12);
}

// estimator_config.yaml: T_MI is from I to M, imu time = mocap time + toff_MI, q_WG from G to W.
TEST(Mocap2Gt, MapsAsTheResult) {
  const StoredResult stored = Example();
  const YAML::Node calib = YAML::Load(FileOf(stored, "mocap2gt", "mocap2gt.calib.yaml"));
  const YAML::Node config =
      YAML::Load(FileOf(stored, "mocap2gt", "mocap2gt.estimator_config.yaml"));
  for (const std::string ending : {"", "_init"}) {
    const YAML::Node& node = ending.empty() ? calib : config;
    const auto list = [&](const std::string& key) {
      return node[key + ending].as<std::vector<double>>();
    };
    std::vector<double> pose = list("p_MI");
    for (const double value : list("q_MI")) pose.push_back(value);
    ExpectSame(ToMatrix(pose), T_MI(stored));
    ExpectStamp(node["toff_MI" + ending].as<double>(), stored);
    const std::vector<double> q = list("q_WG");
    const Eigen::Vector3d down =
        Eigen::Quaterniond(q[3], q[0], q[1], q[2]) * -Eigen::Vector3d::UnitZ();
    EXPECT_LT((down - stored.result.sessions[0].g_W.normalized()).norm(), 1e-9);
  }
  const auto noise = config["imu_noise"].as<std::vector<double>>();
  ExpectNoise(noise.at(2), noise.at(3), noise.at(0), noise.at(1));
  EXPECT_EQ(ToVector(config["mocap_trans_noise"]), Eigen::Vector3d::Constant(0.0012));
  EXPECT_EQ(ToVector(config["mocap_rot_noise"]), Eigen::Vector3d::Constant(0.0034));
}

// --- Lidar and autopilot ---

// utility.h: v_lidar = extRot v_imu; extrinsicTrans is where the IMU is in lidar axes.
TEST(LioSam, MapsAsTheResult) {
  const StoredResult stored = Example();
  const YAML::Node yaml = YAML::Load(FileOf(stored, "liosam", "liosam.yaml"))["lio_sam"];
  for (const char* key : {"extrinsicRot", "extrinsicRPY"})
    ExpectSame(ToMatrix(RowMajor(yaml[key].as<std::vector<double>>(), 3),
                        ToVector(yaml["extrinsicTrans"])),
               T_MI(stored));
  ExpectNoise(yaml["imuGyrNoise"].as<double>(), yaml["imuGyrBiasN"].as<double>(),
              yaml["imuAccNoise"].as<double>(), yaml["imuAccBiasN"].as<double>());
  EXPECT_NEAR(yaml["imuGravity"].as<double>(), stored.result.sessions[0].g_W.norm(), 1e-12);
}

// laserMapping.cpp: stamp of the IMU - offset is on the lidar's clock. esekfom.hpp: the variance of
// a step is cov dt^2.
TEST(FastLio, MapsAsTheResult) {
  const StoredResult stored = Example();
  const YAML::Node yaml = YAML::Load(FileOf(stored, "fastlio", "fastlio.yaml"));
  const YAML::Node mapping = yaml["mapping"];
  ExpectSame(ToMatrix(RowMajor(mapping["extrinsic_R"].as<std::vector<double>>(), 3),
                      ToVector(mapping["extrinsic_T"])),
             T_MI(stored).inverse());
  const double t_imu = 12.5;
  EXPECT_NEAR(t_imu - yaml["common"]["time_offset_lidar_to_imu"].as<double>(),
              t_imu + TimeShift(stored), 1e-12);
  EXPECT_NEAR(mapping["gyr_cov"].as<double>(), 0.0021 * 0.0021, 1e-15);
  EXPECT_NEAR(mapping["acc_cov"].as<double>(), 0.043 * 0.043, 1e-15);
  const double dt_g = 1.0 / 200.0, dt_a = 1.0 / 250.0, second = 1.0;
  EXPECT_NEAR(mapping["b_gyr_cov"].as<double>() * dt_g * dt_g * (second / dt_g), 3e-5 * 3e-5,
              1e-15);
  EXPECT_NEAR(mapping["b_acc_cov"].as<double>() * dt_a * dt_a * (second / dt_a), 7e-4 * 7e-4,
              1e-15);
}

/// Lines of vehicle, component, name, value and type between tabs.
std::map<std::string, double> Px4Params(const std::string& text) {
  std::map<std::string, double> params;
  std::istringstream lines(text);
  for (std::string line; std::getline(lines, line);) {
    if (line.empty() || line[0] == '#') continue;
    const std::vector<std::string> words = Words(line);
    EXPECT_EQ(words.size(), 5u) << line;
    EXPECT_EQ(line, "1\t1\t" + words.at(2) + "\t" + words.at(3) + "\t9");
    params[words.at(2)] = std::stod(words.at(3));
  }
  return params;
}

TEST(Px4, MapsAsTheResult) {
  StoredResult stored = Example();
  const Eigen::Quaterniond q_body_imu(0.0, 1.0, 0.0, 0.0);  // imu axes forward, left, up
  const auto params = Px4Params(FileOf(stored, "px4", "px4.params", {q_body_imu}));
  const Eigen::Vector4d p_IM = T_MI(stored).inverse().col(3);
  EXPECT_NEAR(params.at("EKF2_EV_POS_X"), p_IM.x(), 1e-12);
  EXPECT_NEAR(params.at("EKF2_EV_POS_Y"), -p_IM.y(), 1e-12);
  EXPECT_NEAR(params.at("EKF2_EV_POS_Z"), -p_IM.z(), 1e-12);
  // The pose of t_pose is taken at t_pose - delay on the IMU's clock.
  const double t_imu = 12.5;
  EXPECT_NEAR(t_imu + TimeShift(stored) - 1e-3 * params.at("EKF2_EV_DELAY"), t_imu, 1e-12);
  EXPECT_NEAR(Px4Params(FileOf(stored, "px4", "px4.params")).at("EKF2_EV_POS_Y"), p_IM.y(), 1e-12);
  for (const double unfit : {-0.001, 0.301}) {
    stored.result.sessions[0].imus[0].time_shift = unfit;
    const std::string text = FileOf(stored, "px4", "px4.params");
    EXPECT_EQ(Px4Params(text).count("EKF2_EV_DELAY"), 0u);
    EXPECT_TRUE(Contains(text, "EKF2_EV_DELAY must be 0 to 300 and is left out")) << text;
  }
}

TEST(PoseSensors, PlayTheLidar) {
  const StoredResult stored = SensorExample();
  const ExportChoice lidar = {{}, 1};
  const YAML::Node liosam = YAML::Load(FileOf(stored, "liosam", "liosam.yaml", lidar))["lio_sam"];
  for (const char* key : {"extrinsicRot", "extrinsicRPY"})
    ExpectSame(ToMatrix(RowMajor(liosam[key].as<std::vector<double>>(), 3),
                        ToVector(liosam["extrinsicTrans"])),
               T_SI(stored, 1));
  const YAML::Node fastlio = YAML::Load(FileOf(stored, "fastlio", "fastlio.yaml", lidar));
  ExpectSame(ToMatrix(RowMajor(fastlio["mapping"]["extrinsic_R"].as<std::vector<double>>(), 3),
                      ToVector(fastlio["mapping"]["extrinsic_T"])),
             T_SI(stored, 1).inverse());
  // t_imu - offset is on the lidar's clock.
  ExpectSensorStamp(fastlio["common"]["time_offset_lidar_to_imu"].as<double>(), stored, 1);
}

/// The marker plays when no sensor is usable; one without a session in common has no time shift.
TEST(PoseSensors, ThatCannotPlay) {
  StoredResult stored = SensorExample();
  stored.result.pose_sensors[0].status = Status::kDegenerate;
  EXPECT_TRUE(Contains(FileOf(stored, "vins", "vins.yaml"), "'lidar_link'"));
  ExpectError<InputError>(
      [&] {
        Export(stored, "vins", {{}, 0});
      },
      {"pose sensor 0 is degenerate, must be ok or weak"});
  ExpectError<InputError>(
      [&] {
        Export(stored, "vins", {{}, 2});
      },
      {"pose sensor 2 is not in the result, which has 2, from 0"});
  ExpectError<InputError>([&] { Export(Example(), "vins", {{}, 0}); }, {"which has 0, from 0"});
  stored.result.pose_sensors[1].sessions[0].is_present = false;
  const YAML::Node vins = OpenCvYaml(FileOf(stored, "vins", "vins.yaml"));
  EXPECT_FALSE(vins["td"]);
  ExpectSame(DataMatrix(vins["body_T_cam0"], "d"), T_SI(stored, 1).inverse());
  stored.result.pose_sensors[1].status = Status::kDegenerate;
  EXPECT_EQ(FileOf(stored, "vins", "vins.yaml"), FileOf(Example(), "vins", "vins.yaml"));
}

// --- Frames ---

void ExpectLinks(const std::vector<Link>& links, const StoredResult& stored) {
  const size_t imus = stored.result.imus.size();
  ASSERT_EQ(links.size(), imus + stored.result.pose_sensors.size());
  for (size_t i = 0; i < links.size(); ++i) {
    EXPECT_EQ(links[i].parent, "rig/marker");
    if (i >= imus) {
      EXPECT_EQ(links[i].child, i == imus ? "camera_link" : "lidar_link");
      ExpectSame(links[i].T, stored.result.pose_sensors[i - imus].T_MS.Matrix());
      continue;
    }
    EXPECT_EQ(links[i].child, "imu_" + std::to_string(i) + "_link");
    ExpectSame(links[i].T, T_MI(stored, i));
  }
}

TEST(Frames, MapAsTheResult) {
  for (const StoredResult& stored :
       {Example(), Example(ImuModel::kCalibrated, 2), SensorExample(2), SensorExample(0)}) {
    ExpectLinks(UrdfLinks(FileOf(stored, "urdf", "urdf")), stored);
    ExpectLinks(LaunchLinks(FileOf(stored, "tf", "tf.launch")), stored);
    ExpectLinks(Ros2Links(FileOf(stored, "ros2", "ros2.launch.xml")), stored);
  }
}

TEST(Frames, UrdfBearsPitchOfARightAngle) {
  StoredResult stored = Example();
  for (const double pitch : {M_PI / 2, -M_PI / 2, M_PI / 2 - 1e-7}) {
    stored.result.imus[0].T_MI.q = Eigen::AngleAxisd(0.3, Eigen::Vector3d::UnitZ()) *
                                   Eigen::AngleAxisd(pitch, Eigen::Vector3d::UnitY()) *
                                   Eigen::AngleAxisd(-1.2, Eigen::Vector3d::UnitX());
    ExpectLinks(UrdfLinks(FileOf(stored, "urdf", "urdf")), stored);
  }
}

TEST(Frames, NamesAreEscapedInXml) {
  StoredResult stored = Example();
  stored.infos[0].marker_frame = "a<b>&\"c\"--d";
  const std::vector<Link> links = UrdfLinks(FileOf(stored, "urdf", "urdf"));
  ASSERT_EQ(links.size(), 1u);
  EXPECT_EQ(links[0].parent, "a<b>&\"c\"--d");
  const std::string arguments = " 'a<b>&\"c\"--d' imu_0_link";  // of a shell
  const Element tf = Xml(FileOf(stored, "tf", "tf.launch"), "launch").Child("node");
  EXPECT_TRUE(Contains(tf["args"], arguments)) << tf["args"];
  const Element ros2 = Xml(FileOf(stored, "ros2", "ros2.launch.xml"), "launch").Child("node");
  EXPECT_TRUE(Contains(ros2["args"], "--frame-id 'a<b>&\"c\"--d' --child")) << ros2["args"];
}

// --- Files ---

using ExportFiles = TempDirTest;

TEST_F(ExportFiles, StandNextToTheResult) {
  StoredResult stored = Example();
  stored.path = Path("my.calibration.yaml");
  OutputFiles outputs;
  const std::vector<std::string> paths = WriteExports(stored, {"evo", "urdf"}, &outputs);
  EXPECT_FALSE(std::filesystem::exists(paths[0]));
  outputs.Commit();
  EXPECT_EQ(paths, std::vector<std::string>(
                       {Path("my.calibration.evo.json"), Path("my.calibration.urdf")}));
  EXPECT_EQ(ReadText(paths[0]), FileOf(stored, "evo", "evo.json"));
  EXPECT_EQ(ExportPaths(stored.path, {"evo", "urdf"}, 1), paths);
  EXPECT_EQ(WriteExports(stored, {"tf"}, &outputs, Path("a/b")),  // made
            std::vector<std::string>({Path("a/b/my.calibration.tf.launch")}));
  ExpectError<InputError>([&] { WriteExports(stored, {"tf"}, &outputs, paths[0] + "/c"); },
                          {"my.calibration.evo.json/c", "Not a directory"});
}

TEST_F(ExportFiles, AreKnownBeforeTheyAreWritten) {
  for (const size_t imus : {0, 1, 2}) {
    StoredResult stored = SensorExample(imus);
    stored.path = Path("r.yaml");
    OutputFiles outputs;
    EXPECT_EQ(ExportPaths(stored.path, ExportNames(), imus),
              WriteExports(stored, ExportNames(), &outputs));
  }
}

TEST_F(ExportFiles, WithoutAnImuAreThoseOfFrames) {
  StoredResult stored = SensorExample(0);
  stored.path = Path("r.yaml");
  OutputFiles outputs;
  EXPECT_EQ(WriteExports(stored, ExportNames(), &outputs).size(), 3u);
  EXPECT_EQ(ExportNote(stored, ExportNames()), "");
  for (const char* name : {"kalibr", "evo", "vicon2gt"})
    ExpectError<InputError>([&] { WriteExports(stored, {name}, &outputs); },
                            {"export '" + std::string(name) + "' needs an IMU", "has none"});
  const std::string text = FileOf(stored, "urdf", "urdf");
  EXPECT_TRUE(Contains(text, "all 2 of the rig, x_marker = R x_sensor + p")) << text;
  EXPECT_FALSE(Contains(text, "imu = ") || Contains(text, "stamps of")) << text;
}

TEST_F(ExportFiles, AreNotWrittenWhenOneCannotBeMade) {
  StoredResult stored = Example();
  stored.path = Path("r.yaml");
  stored.result.sessions[0].imus[0].noise.gyro = 0.0;
  ExpectError<InputError>(
      [&] {
        OutputFiles outputs;
        WriteExports(stored, {"evo", "kalibr"}, &outputs);
      },
      {"gyroscope"});
  EXPECT_TRUE(std::filesystem::is_empty(dir_));
}

}  // namespace
}  // namespace imu_pose_calib
