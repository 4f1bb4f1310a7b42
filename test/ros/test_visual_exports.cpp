// What is exported to visual-inertial programs maps points, stamps and readings as the result does.

#include <cereal/archives/json.hpp>
#include <cereal/types/string.hpp>
#include <cereal/types/vector.hpp>
#include <cmath>

#include "export_checks.h"

namespace imu_pose_calib {
namespace {

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
  ExpectNoise(yaml["IMU.NoiseGyro"].as<double>(), yaml["IMU.GyroWalk"].as<double>(),
              yaml["IMU.NoiseAcc"].as<double>(), yaml["IMU.AccWalk"].as<double>());
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
  for (const char* key : {"imu_preintegration_type", "imu_bias_init_sigma", "imu_integration_sigma",
                          "do_imu_rate_time_alignment", "time_alignment_window_size_s",
                          "time_alignment_variance_threshold_scaling"})
    EXPECT_TRUE(imu[key]) << key;
  const YAML::Node camera = OpenCvYaml(FileOf(stored, "kimera", "kimera.LeftCameraParams.yaml"));
  ExpectSame(DataMatrix(camera["T_BS"]), T_MI(stored).inverse());
}

// A pose sensor on the rig plays the camera instead of the marker.
TEST(PoseSensors, PlayTheCamera) {
  for (const size_t k : {0, 1}) {
    const StoredResult stored = SensorExample(2);
    const auto text = [&](const std::string& name, const std::string& ending) {
      const std::string file =
          FileOf(stored, name, name + "." + ending, k == 0 ? ExportChoice() : ExportChoice{{}, k});
      EXPECT_TRUE(Contains(file, k == 0 ? "'camera_link', ok" : "'lidar_link', weak")) << file;
      EXPECT_TRUE(Contains(file, std::to_string(k) + " of 2, counted from 0")) << file;
      EXPECT_FALSE(Contains(file, "T_marker_imu^-1") || Contains(file, "no camera")) << file;
      return file;
    };
    const YAML::Node kalibr = YAML::Load(text("kalibr", "camchain-imucam.yaml"))["cam0"];
    ExpectSame(RowList(kalibr["T_cam_imu"]), T_SI(stored, k));
    ExpectSensorStamp(kalibr["timeshift_cam_imu"].as<double>(), stored, k);
    EXPECT_EQ(kalibr["rostopic"].as<std::string>(), k == 0 ? "/camera/pose" : "/lidar/pose");
    const YAML::Node openvins = OpenCvYaml(text("openvins", "kalibr_imucam_chain.yaml"))["cam0"];
    ExpectSame(RowList(openvins["T_imu_cam"]), T_SI(stored, k).inverse());
    ExpectSensorStamp(openvins["timeshift_cam_imu"].as<double>(), stored, k);
    const YAML::Node vins = OpenCvYaml(text("vins", "yaml"));
    ExpectSame(DataMatrix(vins["body_T_cam0"], "d"), T_SI(stored, k).inverse());
    ExpectSensorStamp(vins["td"].as<double>(), stored, k);
    const std::string orbslam3 = text("orbslam3", "yaml");
    ExpectSame(DataMatrix(OpenCvYaml(orbslam3)["IMU.T_b_c1"], "f"), T_SI(stored, k).inverse());
    const std::string subtract = "There is no key for the clocks: subtract ";
    ExpectSensorStamp(std::stod(orbslam3.substr(orbslam3.find(subtract) + subtract.size())), stored,
                      k);
    const YAML::Node camera = OpenCvYaml(text("kimera", "LeftCameraParams.yaml"));
    ExpectSame(DataMatrix(camera["T_BS"]), T_SI(stored, k).inverse());
    ExpectSensorStamp(OpenCvYaml(text("kimera", "ImuParams.yaml"))["imu_time_shift"].as<double>(),
                      stored, k);
  }
}

TEST(PoseSensors, AreInTheAxesOfTheAccelerometerAsTheImuOfKalibr) {
  const StoredResult stored = SensorExample(1, ImuModel::kScaleMisalignment);
  const Eigen::Matrix4d T_cam_imu = RowList(
      YAML::Load(FileOf(stored, "kalibr", "kalibr.camchain-imucam.yaml"))["cam0"]["T_cam_imu"]);
  const YAML::Node imu =
      YAML::Load(FileOf(stored, "kalibr", "kalibr.results-imu.yaml"))["imu0"]["accelerometers"];
  const Eigen::Matrix4d T_MS = stored.result.pose_sensors[0].T_MS.Matrix();
  const Eigen::Matrix3d R_AM = (T_MS * T_cam_imu).inverse().topLeftCorner<3, 3>();
  EXPECT_LT((RowList(imu["M"]) * R_AM * kForce_M - ExpectedReadings(stored).accel).norm(), 1e-9);
}

// --- JSON, read by the library that basalt reads with ---

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

// evo: poses times the transform from the right; t_offset is added to their stamps.
TEST(Evo, MapsAsTheResult) {
  const StoredResult stored = Example();
  std::istringstream in(FileOf(stored, "evo", "evo.json"));
  cereal::JSONInputArchive archive(in);
  double x, y, z, qx, qy, qz, qw;
  std::vector<std::string> comment;
  archive(CEREAL_NVP(x), CEREAL_NVP(y), CEREAL_NVP(z));
  archive(CEREAL_NVP(qx), CEREAL_NVP(qy), CEREAL_NVP(qz), CEREAL_NVP(qw), CEREAL_NVP(comment));
  ExpectSame(ToMatrix({x, y, z, qx, qy, qz, qw}), T_MI(stored));
  size_t offsets = 0;
  for (const std::string& line : comment) {
    const size_t offset = line.find("--t_offset ");
    if (offset == std::string::npos) continue;
    ExpectStamp(std::stod(line.substr(offset + 11)), stored);
    ++offsets;
  }
  EXPECT_EQ(offsets, 1u);
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
      ExpectNoise(calibration.gyro_noise_std.at(i), calibration.gyro_bias_std.at(i),
                  calibration.accel_noise_std.at(i), calibration.accel_bias_std.at(i));
    EXPECT_EQ(calibration.imu_update_rate, 200.0);
    EXPECT_TRUE(calibration.T_imu_cam.empty());
  }
}

}  // namespace
}  // namespace imu_pose_calib
