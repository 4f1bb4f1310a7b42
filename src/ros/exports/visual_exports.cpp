// Visual-inertial programs: the pose sensor plays their camera.

#include <cmath>

#include "imu_pose_calib/ros/exports/export_text.h"
#include "imu_pose_calib/ros/exports/exporters.h"
#include "imu_pose_calib/ros/io/yaml_text.h"

namespace imu_pose_calib {
namespace {

/// The head of a file for OpenCV's reader of YAML, which wants that in the first line.
std::string OpenCvHead(const StoredResult& stored, const std::string& what, const Lines& more) {
  return "%YAML:1.0\n" + YamlComment(Head(stored, what, false, more));
}

std::string ImuName(size_t imu) { return "imu" + std::to_string(imu); }

/// Says how the axes of a model are turned whose accelerometer matrix is triangular.
Lines AxesRemark(const AccelAxes& axes) {
  if (axes.angle_rad == 0.0) return {};
  return {std::string("axes:      ") + kTurnedAxes + ", since its matrix is lower",
          "           triangular: turned by " + Short(axes.angle_rad * 180.0 / M_PI) +
              " deg from the imu axes of the result"};
}

Lines operator+(Lines a, const Lines& b) {
  a.insert(a.end(), b.begin(), b.end());
  return a;
}

// --- Kalibr ---

ExportFile KalibrCamera(const StoredResult& stored) {
  const AccelAxes axes = ToAccelAxes(stored.result.imus[0]);
  const Lines more =
      Lines{"The pose sensor plays cam0:",
            "T_cam_imu: x_cam = T_cam_imu x_imu, so cam = marker and T_cam_imu = T_marker_imu" +
                std::string(axes.angle_rad == 0.0 ? "" : " but for the axes below"),
            "timeshift_cam_imu: t_imu = t_cam + timeshift_cam_imu, so -time_shift",
            "It is no camera: camera_model, intrinsics, distortion and resolution are left out."} +
      AxesRemark(axes);
  return {"kalibr.camchain-imucam.yaml",
          YamlComment(Head(stored, "Kalibr camchain-imucam", false, more)) + "cam0:\n" +
              "  T_cam_imu:\n" + Rows(axes.T_MA.Matrix(), "  ") +
              "  rostopic: " + Quoted(stored.infos.front().pose_topic) + "\n" +
              "  timeshift_cam_imu: " + YamlNumber(-stored.Clock(0).time_shift) + "\n"};
}

/// t_imu0 - t_imuN of one instant, in a session that has both. 0 when there is none.
double OffsetToFirst(const StoredResult& stored, size_t imu) {
  for (const SessionCalibration& session : stored.result.sessions)
    if (session.imus[0].is_present && session.imus[imu].is_present)
      return session.imus[imu].time_shift - session.imus[0].time_shift;
  return 0.0;
}

std::string KalibrImu(const StoredResult& stored, size_t imu, const Rigid3& T_MA_first) {
  const AccelAxes axes = ToAccelAxes(stored.result.imus[imu]);
  const NoiseDensity noise = Noise(stored, imu);
  const bool has_matrices = stored.result.imu_model == ImuModel::kScaleMisalignment;
  std::string text = ImuName(imu) + ":\n  T_i_b:\n" +
                     Rows((axes.T_MA.Inverse() * T_MA_first).Matrix(), "  ") +
                     NoiseKeys(noise, "  ");
  if (has_matrices)
    text += "  accelerometers:\n    M:\n" + Rows(axes.accel, "    ") + "  gyroscopes:\n    A:\n" +
            Rows(Eigen::Matrix3d::Zero(), "    ") + "    C_gyro_i:\n" + Rows(axes.R_GA, "    ") +
            "    M:\n" + Rows(axes.gyro, "    ");
  return text + "  model: " + (has_matrices ? "scale-misalignment" : "calibrated") +
         "\n  rostopic: " + Quoted(stored.Info(imu).GyroSource()) +
         "\n  time_offset: " + YamlNumber(imu == 0 ? 0.0 : OffsetToFirst(stored, imu)) +
         "\n  update_rate: " + YamlNumber(noise.rate_hz) + "\n";
}

ExportFile KalibrImus(const StoredResult& stored) {
  const AccelAxes first = ToAccelAxes(stored.result.imus[0]);
  const Lines more =
      Lines{"T_i_b: x_imuN = T_i_b x_imu0", "time_offset: t_imu0 = t_imuN + time_offset",
            "accelerometer: measured = accelerometers.M f + b",
            "gyroscope: measured = gyroscopes.M C_gyro_i w + A f + b; A is not estimated",
            kNoiseRemark} +
      AxesRemark(first);
  std::string text = YamlComment(Head(stored, "Kalibr imu result", true, more));
  for (size_t i = 0; i < stored.result.imus.size(); ++i) text += KalibrImu(stored, i, first.T_MA);
  return {"kalibr.results-imu.yaml", text};
}

/// Input of kalibr_calibrate_imu_camera --imu.
ExportFile KalibrInput(const StoredResult& stored, size_t imu) {
  const NoiseDensity noise = Noise(stored, imu);
  const Lines more = {"Input of Kalibr, of " + ImuName(imu) + " alone", kNoiseRemark};
  return {"kalibr." + ImuName(imu) + ".yaml",
          YamlComment(Head(stored, "Kalibr imu.yaml", true, more)) + NoiseKeys(noise, "") +
              "rostopic: " + Quoted(stored.Info(imu).GyroSource()) +
              "\nupdate_rate: " + YamlNumber(noise.rate_hz) + "\n"};
}

// --- basalt ---

std::string JsonPose(const Rigid3& T) {
  const Vector7d numbers = PoseNumbers(T);
  std::string text;
  for (Eigen::Index i = 0; i < numbers.size(); ++i)
    text += (i == 0 ? "{" : ", ") + Quoted((i < 3 ? "p" : "") + std::string(kPoseKeys[i])) + ": " +
            YamlNumber(numbers[i]);
  return text + "}";
}

/// cereal takes the first member for the value, so comments come last.
std::string CerealJson(const std::string& value, const Lines& comment) {
  return "{\n  \"value0\": " + value + ",\n  \"comment\": " + JsonList(comment) + "\n}\n";
}

ExportFile BasaltMocap(const StoredResult& stored) {
  const AccelAxes axes = ToAccelAxes(stored.result.imus[0]);
  const Lines more =
      Lines{"T_imu_marker: x_imu = T_imu_marker x_marker, the inverse of T_marker_imu",
            "t_imu = t_mocap + mocap_to_imu_offset_ns + mocap_time_offset_ns, so both: -time_shift",
            "T_mocap_world: the world is that of the poses"} +
      AxesRemark(axes);
  const std::string value =
      "{\n    \"T_mocap_world\": " + JsonPose(Rigid3()) +
      ",\n    \"T_imu_marker\": " + JsonPose(axes.T_MA.Inverse()) +
      ",\n    \"mocap_time_offset_ns\": 0,\n    \"mocap_to_imu_offset_ns\": " +
      std::to_string(Nanoseconds(-stored.Clock(0).time_shift)) + "\n  }";
  return {"basalt.mocap_calibration.json",
          CerealJson(value, Head(stored, "basalt mocap_calibration.json", false, more))};
}

ExportFile BasaltImu(const StoredResult& stored) {
  const AccelAxes axes = ToAccelAxes(stored.result.imus[0]);
  const ImuSession& session = stored.Clock(0);
  const NoiseDensity noise = Noise(stored, 0);
  // calibrated = (1 + S) measured - b, so 1 + S = M^-1
  const Eigen::Matrix3d accel = axes.accel.inverse();
  const Eigen::Matrix3d gyro = (axes.gyro * axes.R_GA).inverse();
  const Eigen::Matrix3d S_a = accel - Eigen::Matrix3d::Identity();
  const Eigen::Matrix3d S_g = gyro - Eigen::Matrix3d::Identity();
  Eigen::Matrix<double, 9, 1> accel_bias;
  accel_bias << accel * session.accel_bias, S_a.col(0), S_a(1, 1), S_a(2, 1), S_a(2, 2);
  Eigen::Matrix<double, 12, 1> gyro_bias;
  gyro_bias << gyro * session.gyro_bias, S_g.col(0), S_g.col(1), S_g.col(2);
  const auto line = [](const char* key, const std::string& text) {
    return "    " + Quoted(key) + ": " + text + ",\n";
  };
  const auto same = [](double value) { return List(Eigen::Vector3d::Constant(value)); };
  const std::string value =
      "{\n" + line("T_imu_cam", "[]") + line("intrinsics", "[]") + line("resolution", "[]") +
      line("calib_accel_bias", List(accel_bias)) + line("calib_gyro_bias", List(gyro_bias)) +
      line("imu_update_rate", YamlNumber(noise.rate_hz)) +
      line("accel_noise_std", same(noise.accel)) + line("gyro_noise_std", same(noise.gyro)) +
      line("accel_bias_std", same(noise.accel_walk)) +
      line("gyro_bias_std", same(noise.gyro_walk)) + line("cam_time_offset_ns", "0") +
      "    \"vignette\": []\n  }";
  const Lines more =
      Lines{"The imu's part of calibration.json; the cameras are yours to add.",
            "calib_accel_bias: b(3), S(6); calib_gyro_bias: b(3), S(9); S by columns",
            "calibrated = measured + S measured - b; *_std are densities", kNoiseRemark} +
      AxesRemark(axes);
  return {"basalt.calibration.json",
          CerealJson(value, Head(stored, "basalt calibration.json", false, more))};
}

/// A map with rows, columns and elements of a 4 x 4 matrix. `type`: of its elements, for OpenCV.
std::string OpenCvMatrix(const std::string& key, const Rigid3& T, const std::string& type) {
  const std::string tag = type.empty() ? "" : " !!opencv-matrix";
  return key + ":" + tag + "\n  rows: 4\n  cols: 4\n" +
         (type.empty() ? "" : "  dt: " + type + "\n") + "  data: " + Block(T.Matrix(), "    ") +
         "\n";
}

}  // namespace

std::vector<ExportFile> ExportKalibr(const StoredResult& stored, const ExportOptions&) {
  std::vector<ExportFile> files = {KalibrCamera(stored), KalibrImus(stored)};
  for (size_t i = 0; i < stored.result.imus.size(); ++i) files.push_back(KalibrInput(stored, i));
  return files;
}

std::vector<ExportFile> ExportOpenVins(const StoredResult& stored, const ExportOptions&) {
  const ImuCalibration& imu = stored.result.imus[0];
  const LowerTimesRotation accel = SplitLower(imu.accel_matrix);
  const LowerTimesRotation gyro = SplitLower(imu.gyro_matrix);
  const NoiseDensity noise = Noise(stored, 0);
  const Lines of_imu = {
      "accelerometer: measured = Ta R_IMUtoACC f + b",
      "gyroscope: measured = Tw R_IMUtoGYRO w + Tg f + b; Tg is not estimated",
      "gravity_mag of estimator_config.yaml: " + YamlNumber(stored.result.sessions[0].g_W.norm()),
      kNoiseRemark};
  const Eigen::Matrix4d identity = Eigen::Matrix4d::Identity();
  const std::string chain = "imu0:\n  T_i_b:\n" + Rows(identity, "    ") + NoiseKeys(noise, "  ") +
                            "  rostopic: " + Quoted(stored.Info(0).GyroSource()) +
                            "\n  time_offset: 0.0\n  update_rate: " + YamlNumber(noise.rate_hz) +
                            "\n  model: \"kalibr\"\n  Tw:\n" + Rows(gyro.L, "    ") +
                            "  R_IMUtoGYRO:\n" + Rows(gyro.Q, "    ") + "  Ta:\n" +
                            Rows(accel.L, "    ") + "  R_IMUtoACC:\n" + Rows(accel.Q, "    ") +
                            "  Tg:\n" + Rows(Eigen::Matrix3d::Zero(), "    ");
  const Lines of_camera = {
      "The pose sensor plays cam0:",
      "T_imu_cam: x_imu = T_imu_cam x_cam, so cam = marker and T_imu_cam = T_marker_imu^-1",
      "timeshift_cam_imu: t_imu = t_cam + timeshift_cam_imu, so -time_shift",
      "It is no camera: camera_model, intrinsics, distortion and resolution are left out."};
  return {
      {"openvins.kalibr_imu_chain.yaml", OpenCvHead(stored, "OpenVINS imu chain", of_imu) + chain},
      {"openvins.kalibr_imucam_chain.yaml",
       OpenCvHead(stored, "OpenVINS camera chain", of_camera) + "cam0:\n  T_imu_cam:\n" +
           Rows(imu.T_MI.Inverse().Matrix(), "    ") +
           "  rostopic: " + Quoted(stored.infos.front().pose_topic) +
           "\n  timeshift_cam_imu: " + YamlNumber(-stored.Clock(0).time_shift) + "\n"}};
}

std::vector<ExportFile> ExportVins(const StoredResult& stored, const ExportOptions&) {
  const NoiseDensity noise = Noise(stored, 0);
  const ImuSession& session = stored.Clock(0);
  const Lines more = {
      "The pose sensor plays cam0:",
      "body_T_cam0: x_imu = body_T_cam0 x_cam, so cam = marker and the inverse of T_marker_imu",
      "td: t_imu = t_cam + td, so -time_shift",
      "acc_n, gyr_n: sigma per sample; acc_w, gyr_w: walk * sqrt(rate), which is what the",
      "preintegration multiplies by dt [m/s^2, rad/s, m/s^3, rad/s^2]",
      kNoiseRemark};
  const std::string text =
      OpenCvMatrix("body_T_cam0", stored.result.imus[0].T_MI.Inverse(), "d") +
      "td: " + YamlNumber(-session.time_shift) + "\nacc_n: " + YamlNumber(session.noise.accel) +
      "\ngyr_n: " + YamlNumber(session.noise.gyro) +
      "\nacc_w: " + YamlNumber(noise.accel_walk * std::sqrt(session.accel.rate_hz)) +
      "\ngyr_w: " + YamlNumber(noise.gyro_walk * std::sqrt(session.gyro.rate_hz)) +
      "\ng_norm: " + YamlNumber(stored.result.sessions[0].g_W.norm()) + "\n";
  return {{"vins.yaml", OpenCvHead(stored, "VINS-Fusion, part of its config", more) + text}};
}

std::vector<ExportFile> ExportOrbSlam3(const StoredResult& stored, const ExportOptions&) {
  const NoiseDensity noise = Noise(stored, 0);
  const Lines more = {
      "The pose sensor plays camera 1:",
      "IMU.T_b_c1: x_imu = IMU.T_b_c1 x_cam, so cam = marker and the inverse of T_marker_imu",
      "There is no key for time_shift: add it to the stamps of the imu beforehand.", kNoiseRemark};
  const std::string text = OpenCvMatrix("IMU.T_b_c1", stored.result.imus[0].T_MI.Inverse(), "f") +
                           "IMU.NoiseGyro: " + YamlNumber(noise.gyro) +
                           "  # [rad/s/sqrt(Hz)]\nIMU.NoiseAcc: " + YamlNumber(noise.accel) +
                           "  # [m/s^2/sqrt(Hz)]\nIMU.GyroWalk: " + YamlNumber(noise.gyro_walk) +
                           "  # [rad/s^2/sqrt(Hz)]\nIMU.AccWalk: " + YamlNumber(noise.accel_walk) +
                           "  # [m/s^3/sqrt(Hz)]\nIMU.Frequency: " + YamlNumber(noise.rate_hz) +
                           "\n";
  return {{"orbslam3.yaml", OpenCvHead(stored, "ORB-SLAM3, part of its settings", more) + text}};
}

std::vector<ExportFile> ExportKimera(const StoredResult& stored, const ExportOptions&) {
  const NoiseDensity noise = Noise(stored, 0);
  const Lines of_imu = {
      "T_BS: the imu is the body, as Kimera demands",
      "imu_time_shift: t_imu = t_cam + imu_time_shift, so -time_shift, with the pose sensor as cam",
      "imu_preintegration_type, do_imu_rate_time_alignment and so on are Kimera's own; the values",
      "here are those of its example for EuRoC, without its estimate of the time shift.",
      kNoiseRemark};
  const std::string imu =
      "imu_preintegration_type: 1\n" + OpenCvMatrix("T_BS", Rigid3(), "") +
      "rate_hz: " + std::to_string(std::lround(noise.rate_hz)) + "\nimu_bias_init_sigma: 1.0e-3\n" +
      NoiseKeys(noise, "") +
      "do_imu_rate_time_alignment: 0\ntime_alignment_window_size_s: 10.0\n"
      "time_alignment_variance_threshold_scaling: 30.0\nimu_integration_sigma: 1.0e-8\n"
      "imu_time_shift: " +
      YamlNumber(-stored.Clock(0).time_shift) +
      "\nn_gravity: " + List(Eigen::Vector3d(0.0, 0.0, -stored.result.sessions[0].g_W.norm())) +
      "\n";
  const Lines of_camera = {
      "The pose sensor plays the left camera, body B = imu:",
      "T_BS: x_B = T_BS x_S, so S = marker and the inverse of T_marker_imu",
      "It is no camera: resolution, camera_model, intrinsics and distortion are left out."};
  return {{"kimera.ImuParams.yaml", OpenCvHead(stored, "Kimera-VIO ImuParams", of_imu) + imu},
          {"kimera.LeftCameraParams.yaml",
           OpenCvHead(stored, "Kimera-VIO LeftCameraParams", of_camera) +
               "camera_id: \"pose_sensor\"\n" +
               OpenCvMatrix("T_BS", stored.result.imus[0].T_MI.Inverse(), "")}};
}

std::vector<ExportFile> ExportBasalt(const StoredResult& stored, const ExportOptions&) {
  return {BasaltMocap(stored), BasaltImu(stored)};
}

}  // namespace imu_pose_calib
