// What is exported to each program maps points and stamps as the result does.

#include <cereal/archives/json.hpp>
#include <cereal/types/string.hpp>
#include <cereal/types/vector.hpp>
#include <cmath>
#include <regex>

#include "export_parsers.h"
#include "imu_pose_calib/ros/exports/exports.h"
#include "stored_example.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

/// Text of the file with that ending.
std::string FileOf(const StoredResult& stored,
                   const std::string& name,
                   const std::string& ending,
                   const ExportOptions& options = {}) {
  for (const ExportFile& file : Export(stored, name, options))
    if (file.ending == ending) return file.text;
  ADD_FAILURE() << name << " has no " << ending;
  return "";
}

Eigen::Matrix4d T_MI(const StoredResult& stored, size_t imu = 0) {
  return stored.result.imus[imu].T_MI.Matrix();
}

double TimeShift(const StoredResult& stored, size_t imu = 0) {
  return stored.Clock(imu).time_shift;
}

/// Expects that a point is mapped to the same place.
void ExpectSame(const Eigen::Matrix4d& T_XY, const Eigen::Matrix4d& expected) {
  const Eigen::Vector4d point(0.3, -1.7, 2.9, 1.0);
  EXPECT_LT((T_XY * point - expected * point).norm(), 1e-9) << T_XY << "\n\n" << expected;
  EXPECT_LT((T_XY - expected).norm(), 1e-9);
}

/// The stamp of the pose that is taken at the IMU's stamp, from what a consumer adds to a pose's
/// stamp to have that of the IMU.
void ExpectStamp(double pose_to_imu, const StoredResult& stored) {
  const double t_imu = 12.5, t_pose = t_imu + TimeShift(stored);
  EXPECT_NEAR(t_pose + pose_to_imu, t_imu, 1e-12);
}

/// Densities times the root of the rates are the sigmas of the result.
void ExpectNoise(double gyro, double gyro_walk, double accel, double accel_walk, size_t imu = 0) {
  const double k = static_cast<double>(imu) + 1.0;
  EXPECT_NEAR(gyro * std::sqrt(200.0), 0.0021 * k, 1e-12);
  EXPECT_NEAR(accel * std::sqrt(250.0), 0.043 * k, 1e-12);
  EXPECT_EQ(gyro_walk, 3e-5);
  EXPECT_EQ(accel_walk, 7e-4);
}

void ExpectNoise(const YAML::Node& node, size_t imu = 0) {
  ExpectNoise(node["gyroscope_noise_density"].as<double>(),
              node["gyroscope_random_walk"].as<double>(),
              node["accelerometer_noise_density"].as<double>(),
              node["accelerometer_random_walk"].as<double>(),
              imu);
}

const Eigen::Vector3d kOmega_M(0.4, -1.3, 2.2), kForce_M(3.0, -8.0, 5.0);

/// What the sensors of an IMU say, by the model of the result, when the body turns with kOmega_M
/// and feels kForce_M, without bias.
struct Readings {
  Eigen::Vector3d gyro, accel;
};
Readings ExpectedReadings(const StoredResult& stored, size_t imu = 0) {
  const ImuCalibration& calibration = stored.result.imus[imu];
  const Eigen::Quaterniond q_IM = calibration.T_MI.q.conjugate();
  return {calibration.gyro_matrix * (q_IM * kOmega_M),
          calibration.accel_matrix * (q_IM * kForce_M)};
}

bool IsLower(const Eigen::Matrix3d& M) {
  return M(0, 1) == 0.0 && M(0, 2) == 0.0 && M(1, 2) == 0.0 && M.diagonal().minCoeff() > 0.0;
}

const ImuModel kModels[] = {ImuModel::kCalibrated, ImuModel::kScaleMisalignment};

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
      for (const char* part : {"x_marker = R x_imu + p",
                               "t_pose = t_imu + time_shift, time_shift = 0.0437 s",
                               "t_pose = t_accel + time_shift - accel_delay",
                               "subtract it from the stamps of accelerometer samples",
                               "weak: sigma of p_MI is 12 mm",
                               "from my.calibration.yaml by imu_pose_calib"})
        EXPECT_TRUE(Contains(file.text, part)) << part << " is missing in " << file.text;
      const bool all = Contains(file.text, "all 2 of the rig");
      EXPECT_NE(all, Contains(file.text, "the first of 2")) << file.text;
      EXPECT_EQ(file.ending.compare(0, name.size(), name), 0) << file.ending;
    }
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

// --- Visual-inertial programs: the marker plays their camera ---

// ConfigReader.py: T_cam_imu takes imu coordinates to cam; t_imu = t_cam + timeshift_cam_imu.
TEST(Kalibr, CameraChainMapsAsTheResult) {
  const StoredResult stored = Example();
  const YAML::Node cam =
      YAML::Load(FileOf(stored, "kalibr", "kalibr.camchain-imucam.yaml"))["cam0"];
  ExpectSame(RowList(cam["T_cam_imu"]), T_MI(stored));
  ExpectStamp(cam["timeshift_cam_imu"].as<double>(), stored);
  EXPECT_EQ(cam["rostopic"].as<std::string>(), "/vicon/rig");
}

// IccSensors.py: x_imuN = T_i_b x_imu0, t_imu0 = t_imuN + time_offset; with scale-misalignment
// measured = M C_ib f for the accelerometer, M C_gyro_i C_ib w for the gyroscope, M lower
// triangular.
TEST(Kalibr, ImusMapAsTheResult) {
  for (const ImuModel model : kModels) {
    const StoredResult stored = Example(model, 2);
    const YAML::Node yaml = YAML::Load(FileOf(stored, "kalibr", "kalibr.results-imu.yaml"));
    const Eigen::Matrix4d T_cam_imu = RowList(
        YAML::Load(FileOf(stored, "kalibr", "kalibr.camchain-imucam.yaml"))["cam0"]["T_cam_imu"]);
    for (size_t i = 0; i < 2; ++i) {
      const YAML::Node imu = yaml["imu" + std::to_string(i)];
      const Eigen::Matrix4d T_iM = RowList(imu["T_i_b"]) * T_cam_imu.inverse();
      // The origin is that of our IMU, whatever the axes.
      EXPECT_LT((T_iM.inverse() - T_MI(stored, i)).col(3).norm(), 1e-9);
      Eigen::Vector3d accel = T_iM.topLeftCorner<3, 3>() * kForce_M;
      Eigen::Vector3d gyro = T_iM.topLeftCorner<3, 3>() * kOmega_M;
      if (model == ImuModel::kScaleMisalignment) {
        EXPECT_EQ(imu["model"].as<std::string>(), "scale-misalignment");
        const Eigen::Matrix3d M_a = RowList(imu["accelerometers"]["M"]);
        const Eigen::Matrix3d M_g = RowList(imu["gyroscopes"]["M"]);
        EXPECT_TRUE(IsLower(M_a) && IsLower(M_g));
        accel = M_a * accel;
        gyro = M_g * RowList(imu["gyroscopes"]["C_gyro_i"]) * gyro;
        EXPECT_TRUE(RowList(imu["gyroscopes"]["A"]).isZero());
      } else {
        EXPECT_EQ(imu["model"].as<std::string>(), "calibrated");
        ExpectSame(T_iM, T_MI(stored, i).inverse());
      }
      EXPECT_LT((accel - ExpectedReadings(stored, i).accel).norm(), 1e-9);
      EXPECT_LT((gyro - ExpectedReadings(stored, i).gyro).norm(), 1e-9);
      const double t_imu0 = 7.0, t_imuN = t_imu0 + TimeShift(stored, 0) - TimeShift(stored, i);
      EXPECT_NEAR(t_imuN + imu["time_offset"].as<double>(), t_imu0, 1e-12);
      EXPECT_EQ(imu["rostopic"].as<std::string>(), "/imu" + std::to_string(i));
      EXPECT_EQ(imu["update_rate"].as<double>(), 200.0);
      ExpectNoise(imu, i);
    }
  }
}

TEST(Kalibr, InputHoldsTheNoiseOfOneImu) {
  const StoredResult stored = Example(ImuModel::kCalibrated, 2);
  for (size_t i = 0; i < 2; ++i) {
    const std::string name = "imu" + std::to_string(i);
    const YAML::Node imu = YAML::Load(FileOf(stored, "kalibr", "kalibr." + name + ".yaml"));
    EXPECT_EQ(imu.size(), 6u);
    EXPECT_EQ(imu["rostopic"].as<std::string>(), "/" + name);
    EXPECT_EQ(imu["update_rate"].as<double>(), 200.0);
    ExpectNoise(imu, i);
  }
}

// Propagator.cpp: f = R_IMUtoACC^T Ta^-1 (measured - b), w = R_IMUtoGYRO^T Tw^-1 (measured - b).
TEST(OpenVins, ImuChainMapsAsTheResult) {
  for (const ImuModel model : kModels) {
    const StoredResult stored = Example(model);
    const YAML::Node imu =
        OpenCvYaml(FileOf(stored, "openvins", "openvins.kalibr_imu_chain.yaml"))["imu0"];
    const auto matrix = [&](const char* key) { return Eigen::Matrix3d(RowList(imu[key])); };
    EXPECT_EQ(imu["model"].as<std::string>(), "kalibr");
    // Only the lower triangles of the inverses are taken.
    EXPECT_TRUE(IsLower(matrix("Tw")) && IsLower(matrix("Ta")));
    const Readings readings = ExpectedReadings(stored);
    const Eigen::Matrix3d R_MI = T_MI(stored).topLeftCorner<3, 3>();
    EXPECT_LT((R_MI * matrix("R_IMUtoACC").transpose() * matrix("Ta").inverse() * readings.accel -
               kForce_M)
                  .norm(),
              1e-9);
    EXPECT_LT((R_MI * matrix("R_IMUtoGYRO").transpose() * matrix("Tw").inverse() * readings.gyro -
               kOmega_M)
                  .norm(),
              1e-9);
    EXPECT_TRUE(matrix("Tg").isZero());
    EXPECT_EQ(imu["time_offset"].as<double>(), 0.0);
    EXPECT_EQ(imu["update_rate"].as<double>(), 200.0);
    EXPECT_TRUE(RowList(imu["T_i_b"]).isIdentity());
    ExpectNoise(imu);
    const YAML::Node cam =
        OpenCvYaml(FileOf(stored, "openvins", "openvins.kalibr_imucam_chain.yaml"))["cam0"];
    ExpectSame(RowList(cam["T_imu_cam"]), T_MI(stored).inverse());
    ExpectStamp(cam["timeshift_cam_imu"].as<double>(), stored);
  }
}

// integration_base.h: the variance of a step is (noise dt)^2 for samples and for biases.
TEST(Vins, MapsAsTheResult) {
  const StoredResult stored = Example();
  const YAML::Node yaml = OpenCvYaml(FileOf(stored, "vins", "vins.yaml"));
  ExpectSame(DataMatrix(yaml["body_T_cam0"], "d"), T_MI(stored).inverse());
  ExpectStamp(yaml["td"].as<double>(), stored);
  EXPECT_EQ(yaml["gyr_n"].as<double>(), 0.0021);
  EXPECT_EQ(yaml["acc_n"].as<double>(), 0.043);
  const double seconds = 10.0;  // after which a walk has the variance walk^2 seconds
  const auto variance = [&](const char* key, double rate) {
    return std::pow(yaml[key].as<double>() / rate, 2) * rate * seconds;
  };
  EXPECT_NEAR(variance("gyr_w", 200.0), 3e-5 * 3e-5 * seconds, 1e-14);
  EXPECT_NEAR(variance("acc_w", 250.0), 7e-4 * 7e-4 * seconds, 1e-14);
  EXPECT_NEAR(yaml["g_norm"].as<double>(), std::sqrt(1.0 + 4.0 + 9.5 * 9.5), 1e-12);
}

// Settings.cc reads the matrix by at<float>; Tracking.cc multiplies the densities by
// sqrt(Frequency).
TEST(OrbSlam3, MapsAsTheResult) {
  const StoredResult stored = Example();
  const std::string text = FileOf(stored, "orbslam3", "orbslam3.yaml");
  const YAML::Node yaml = OpenCvYaml(text);
  ExpectSame(DataMatrix(yaml["IMU.T_b_c1"], "f"), T_MI(stored).inverse());
  ExpectNoise(yaml["IMU.NoiseGyro"].as<double>(),
              yaml["IMU.GyroWalk"].as<double>(),
              yaml["IMU.NoiseAcc"].as<double>(),
              yaml["IMU.AccWalk"].as<double>());
  EXPECT_EQ(yaml["IMU.Frequency"].as<double>(), 200.0);
  EXPECT_TRUE(Contains(text, "There is no key for time_shift: add it to the stamps of the imu"));
}

// ImuFrontendParams.cpp refuses another T_BS of the IMU than the identity.
TEST(Kimera, MapsAsTheResult) {
  const StoredResult stored = Example();
  const YAML::Node imu = OpenCvYaml(FileOf(stored, "kimera", "kimera.ImuParams.yaml"));
  EXPECT_TRUE(DataMatrix(imu["T_BS"]).isIdentity());
  ExpectStamp(imu["imu_time_shift"].as<double>(), stored);
  EXPECT_EQ(imu["rate_hz"].as<int>(), 200);
  ExpectNoise(imu);
  EXPECT_NEAR(ToVector(imu["n_gravity"]).z(), -stored.result.sessions[0].g_W.norm(), 1e-12);
  for (const char* key : {"imu_preintegration_type",
                          "imu_bias_init_sigma",
                          "imu_integration_sigma",
                          "do_imu_rate_time_alignment",
                          "time_alignment_window_size_s",
                          "time_alignment_variance_threshold_scaling"})
    EXPECT_TRUE(imu[key]) << key;
  const YAML::Node camera = OpenCvYaml(FileOf(stored, "kimera", "kimera.LeftCameraParams.yaml"));
  ExpectSame(DataMatrix(camera["T_BS"]), T_MI(stored).inverse());
}

// --- basalt, read by the library that basalt reads with ---

struct BasaltPose {
  double px, py, pz, qx, qy, qz, qw;
  template <typename Archive>
  void serialize(Archive& ar) {  // NOLINT(readability-identifier-naming): cereal's name
    ar(CEREAL_NVP(px), CEREAL_NVP(py), CEREAL_NVP(pz));
    ar(CEREAL_NVP(qx), CEREAL_NVP(qy), CEREAL_NVP(qz), CEREAL_NVP(qw));
  }
  Eigen::Matrix4d Matrix() const { return ToMatrix({px, py, pz, qx, qy, qz, qw}); }
};

struct BasaltMocap {
  BasaltPose T_mocap_world, T_imu_marker;
  int64_t mocap_time_offset_ns, mocap_to_imu_offset_ns;
  template <typename Archive>
  void serialize(Archive& ar) {  // NOLINT(readability-identifier-naming): cereal's name
    ar(CEREAL_NVP(T_mocap_world), CEREAL_NVP(T_imu_marker));
    ar(CEREAL_NVP(mocap_time_offset_ns), CEREAL_NVP(mocap_to_imu_offset_ns));
  }
};

struct BasaltCalibration {
  std::vector<BasaltPose> T_imu_cam;
  std::vector<std::string> intrinsics, resolution, vignette;
  std::vector<double> calib_accel_bias, calib_gyro_bias;
  double imu_update_rate;
  std::vector<double> accel_noise_std, gyro_noise_std, accel_bias_std, gyro_bias_std;
  int64_t cam_time_offset_ns;
  template <typename Archive>
  void serialize(Archive& ar) {  // NOLINT(readability-identifier-naming): cereal's name
    ar(CEREAL_NVP(T_imu_cam), CEREAL_NVP(intrinsics), CEREAL_NVP(resolution));
    ar(CEREAL_NVP(calib_accel_bias), CEREAL_NVP(calib_gyro_bias), CEREAL_NVP(imu_update_rate));
    ar(CEREAL_NVP(accel_noise_std), CEREAL_NVP(gyro_noise_std));
    ar(CEREAL_NVP(accel_bias_std), CEREAL_NVP(gyro_bias_std));
    ar(CEREAL_NVP(cam_time_offset_ns), CEREAL_NVP(vignette));
  }
};

template <typename T>
T FromCereal(const std::string& text) {
  std::istringstream in(text);
  cereal::JSONInputArchive archive(in);
  T value;
  archive(value);
  return value;
}

TEST(Basalt, MocapCalibrationMapsAsTheResult) {
  StoredResult stored = Example();
  const auto read = [&] {
    return FromCereal<BasaltMocap>(FileOf(stored, "basalt", "basalt.mocap_calibration.json"));
  };
  const BasaltMocap mocap = read();
  ExpectSame(mocap.T_imu_marker.Matrix(), T_MI(stored).inverse());
  EXPECT_TRUE(mocap.T_mocap_world.Matrix().isIdentity());
  // t_imu = t_mocap + both offsets, in whole nanoseconds
  EXPECT_EQ(mocap.mocap_time_offset_ns + mocap.mocap_to_imu_offset_ns, -43'700'000);
  stored.result.sessions[0].imus[0].time_shift = -1600000000.25;
  EXPECT_EQ(read().mocap_to_imu_offset_ns, 1'600'000'000'250'000'000);
}

// calib_bias.hpp: calibrated = measured + S measured - b; S of the accelerometer is lower
// triangular, both by columns.
TEST(Basalt, CalibrationMapsReadingsAsTheResult) {
  for (const ImuModel model : kModels) {
    const StoredResult stored = Example(model);
    const auto calibration =
        FromCereal<BasaltCalibration>(FileOf(stored, "basalt", "basalt.calibration.json"));
    const auto mocap =
        FromCereal<BasaltMocap>(FileOf(stored, "basalt", "basalt.mocap_calibration.json"));
    const std::vector<double>&a = calibration.calib_accel_bias, &g = calibration.calib_gyro_bias;
    ASSERT_EQ(a.size(), 9u);
    ASSERT_EQ(g.size(), 12u);
    Eigen::Matrix3d S_a, S_g;
    S_a << a[3], 0.0, 0.0, a[4], a[6], 0.0, a[5], a[7], a[8];
    S_g << g[3], g[6], g[9], g[4], g[7], g[10], g[5], g[8], g[11];
    const Readings readings = ExpectedReadings(stored);
    const Eigen::Vector3d accel = readings.accel + stored.Clock(0).accel_bias;
    const Eigen::Vector3d gyro = readings.gyro + stored.Clock(0).gyro_bias;
    const Eigen::Matrix3d R_MI = mocap.T_imu_marker.Matrix().inverse().topLeftCorner<3, 3>();
    EXPECT_LT((R_MI * (accel + S_a * accel - Eigen::Vector3d(a[0], a[1], a[2])) - kForce_M).norm(),
              1e-9);
    EXPECT_LT((R_MI * (gyro + S_g * gyro - Eigen::Vector3d(g[0], g[1], g[2])) - kOmega_M).norm(),
              1e-9);
    EXPECT_LT((mocap.T_imu_marker.Matrix().inverse() - T_MI(stored)).col(3).norm(), 1e-9);
    for (size_t i = 0; i < 3; ++i)
      ExpectNoise(calibration.gyro_noise_std.at(i),
                  calibration.gyro_bias_std.at(i),
                  calibration.accel_noise_std.at(i),
                  calibration.accel_bias_std.at(i));
    EXPECT_EQ(calibration.imu_update_rate, 200.0);
    EXPECT_TRUE(calibration.T_imu_cam.empty());
  }
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
  const boost::property_tree::ptree tree = Xml(FileOf(stored, "vicon2gt", "vicon2gt.launch"));
  std::map<std::string, double> params;
  std::map<std::string, std::vector<double>> lists;
  for (const auto& [name, node] : tree.get_child("launch")) {
    if (name == "param")
      params[node.get<std::string>("<xmlattr>.name")] = node.get<double>("<xmlattr>.value");
    if (name == "rosparam")
      lists[node.get<std::string>("<xmlattr>.param")] =
          YAML::Load(node.get_value<std::string>()).as<std::vector<double>>();
  }
  const std::vector<double>& p = lists.at("p_BinI");
  ExpectSame(ToMatrix(RowMajor(lists.at("R_BtoI"), 3), Eigen::Vector3d(p.at(0), p.at(1), p.at(2))),
             T_MI(stored).inverse());
  ExpectStamp(params.at("toff_imu_to_vicon"), stored);
  ExpectNoise(params.at("gyroscope_noise_density"),
              params.at("gyroscope_random_walk"),
              params.at("accelerometer_noise_density"),
              params.at("accelerometer_random_walk"));
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

// evo: poses times the transform from the right; t_offset is added to their stamps.
TEST(Evo, MapsAsTheResult) {
  const StoredResult stored = Example();
  const std::string text = FileOf(stored, "evo", "evo.json");
  const boost::property_tree::ptree json = Json(text);
  std::vector<double> v;
  for (const char* key : {"x", "y", "z", "qx", "qy", "qz", "qw"})
    v.push_back(json.get<double>(key));
  ExpectSame(ToMatrix(v), T_MI(stored));
  std::smatch offset;
  ASSERT_TRUE(std::regex_search(text, offset, std::regex("--t_offset (\\S+)\"")));
  ExpectStamp(std::stod(offset[1]), stored);
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
  ExpectNoise(yaml["imuGyrNoise"].as<double>(),
              yaml["imuGyrBiasN"].as<double>(),
              yaml["imuAccNoise"].as<double>(),
              yaml["imuAccBiasN"].as<double>());
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
              t_imu + TimeShift(stored),
              1e-12);
  EXPECT_NEAR(mapping["gyr_cov"].as<double>(), 0.0021 * 0.0021, 1e-15);
  EXPECT_NEAR(mapping["acc_cov"].as<double>(), 0.043 * 0.043, 1e-15);
  const double dt_g = 1.0 / 200.0, dt_a = 1.0 / 250.0, second = 1.0;
  EXPECT_NEAR(
      mapping["b_gyr_cov"].as<double>() * dt_g * dt_g * (second / dt_g), 3e-5 * 3e-5, 1e-15);
  EXPECT_NEAR(
      mapping["b_acc_cov"].as<double>() * dt_a * dt_a * (second / dt_a), 7e-4 * 7e-4, 1e-15);
}

/// Lines of vehicle, component, name, value and type between tabs.
std::map<std::string, double> Px4Params(const std::string& text) {
  std::map<std::string, double> params;
  std::istringstream lines(text);
  for (std::string line; std::getline(lines, line);) {
    if (line.empty() || line[0] == '#') continue;
    std::smatch match;
    EXPECT_TRUE(std::regex_match(line, match, std::regex("1\t1\t(\\w+)\t(\\S+)\t9"))) << line;
    params[match[1]] = std::stod(match[2]);
  }
  return params;
}

TEST(Px4, MapsAsTheResult) {
  StoredResult stored = Example();
  ExportOptions options;  // imu axes forward, left, up
  options.q_body_imu = Eigen::Quaterniond(0.0, 1.0, 0.0, 0.0);
  const auto params = Px4Params(FileOf(stored, "px4", "px4.params", options));
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

// --- Frames ---

void ExpectLinks(const std::vector<Link>& links, const StoredResult& stored) {
  ASSERT_EQ(links.size(), stored.result.imus.size());
  for (size_t i = 0; i < links.size(); ++i) {
    EXPECT_EQ(links[i].parent, "rig/marker");
    EXPECT_EQ(links[i].child, "imu_" + std::to_string(i) + "_link");
    ExpectSame(links[i].T, T_MI(stored, i));
  }
}

TEST(Frames, MapAsTheResult) {
  for (const size_t imus : {1, 2}) {
    const StoredResult stored = Example(ImuModel::kCalibrated, imus);
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
}

// --- Files ---

using ExportFiles = TempDirTest;

TEST_F(ExportFiles, StandNextToTheResult) {
  StoredResult stored = Example();
  stored.path = Path("my.calibration.yaml");
  const std::vector<std::string> paths = WriteExports(stored, {"evo", "urdf"});
  EXPECT_EQ(
      paths,
      std::vector<std::string>({Path("my.calibration.evo.json"), Path("my.calibration.urdf")}));
  EXPECT_EQ(ReadText(paths[0]), FileOf(stored, "evo", "evo.json"));
  std::filesystem::create_directory(Path("out"));
  EXPECT_EQ(WriteExports(stored, {"tf"}, Path("out")),
            std::vector<std::string>({Path("out/my.calibration.tf.launch")}));
  ExpectError<InputError>([&] { WriteExports(stored, {"tf"}, Path("none")); },
                          {"none/my.calibration.tf.launch", "No such file"});
}

TEST_F(ExportFiles, AreNotWrittenWhenOneCannotBeMade) {
  StoredResult stored = Example();
  stored.path = Path("r.yaml");
  stored.result.sessions[0].imus[0].noise.gyro = 0.0;
  ExpectError<InputError>([&] { WriteExports(stored, {"evo", "kalibr"}); }, {"gyroscope"});
  EXPECT_TRUE(std::filesystem::is_empty(dir_));
}

TEST_F(ExportFiles, OldOnesAreRemovedAndNoOthers) {
  StoredResult stored = Example();
  stored.path = Path("r.yaml");
  const std::vector<std::string> old = WriteExports(stored, {"evo", "urdf", "kalibr", "tf"});
  const std::string foreign = Write("r.evo.txt", "mine"),
                    other = Write("rr.urdf", "by imu_pose_calib");
  RemoveOldExports(stored.path, {"evo", "urdf", "kalibr"});
  for (const std::string& path : old)
    EXPECT_EQ(std::filesystem::exists(path), path == Path("r.tf.launch")) << path;
  EXPECT_TRUE(std::filesystem::exists(foreign));
  EXPECT_TRUE(std::filesystem::exists(other));
}

}  // namespace
}  // namespace imu_pose_calib
