// Ground truth, lidar, autopilot, static transforms.

#include <cmath>

#include "imu_pose_calib/ros/exports/export_text.h"
#include "imu_pose_calib/ros/exports/exporters.h"
#include "imu_pose_calib/ros/io/yaml_text.h"

namespace imu_pose_calib {
namespace {

/// A sensor.yaml of EuRoC.
std::string SensorYaml(const StoredResult& stored, const Lines& more, bool all_imus,
                       const std::string& type, const Rigid3& T_BS) {
  return "%YAML:1.0\n" + YamlComment(Head(stored, "EuRoC sensor.yaml", all_imus, more)) +
         "sensor_type: " + type + "\ncomment: \"imu_pose_calib\"\nT_BS:\n  cols: 4\n  rows: 4\n" +
         "  data: " + Block(T_BS.Matrix(), "    ") + "\n";
}

std::string RosParam(const char* name, const Eigen::MatrixXd& values) {
  return std::string("  <rosparam param=\"") + name + "\">" + List(values) + "</rosparam>\n";
}

std::string DoubleParam(const char* name, double value) {
  return std::string("  <param name=\"") + name + "\" type=\"double\" value=\"" +
         YamlNumber(value) + "\"/>\n";
}

/// R = Rz(yaw) Ry(pitch) Rx(roll), as (roll, pitch, yaw) [rad].
Eigen::Vector3d RollPitchYaw(const Eigen::Quaterniond& q) {
  const Eigen::Matrix3d R = q.toRotationMatrix();
  const double roll = std::atan2(R(2, 1), R(2, 2));
  // With a pitch of a right angle any roll will do, if the others are those of what is left.
  const Eigen::Matrix3d yaw_pitch = R * Eigen::AngleAxisd(-roll, Eigen::Vector3d::UnitX());
  return {roll, std::atan2(-yaw_pitch(2, 0), yaw_pitch(2, 2)),
          std::atan2(-yaw_pitch(0, 1), yaw_pitch(1, 1))};
}

/// The shortest rotation that turns z to `up`, (0, 0, -1) by half a turn about x. Eigen's
/// FromTwoVectors() takes as long to compile as the rest of this file.
Eigen::Quaterniond RotationFromVertical(const Eigen::Vector3d& up) {
  const Eigen::Vector3d z = up.normalized();
  const double s = std::sqrt(2.0 * (1.0 + z.z()));
  if (s < 1e-8) return Eigen::Quaterniond(0.0, 1.0, 0.0, 0.0);
  return Eigen::Quaterniond(0.5 * s, -z.y() * (1.0 / s), z.x() * (1.0 / s), 0.0);
}

/// "1.0 2.0 3.0"
std::string Spaced(const Eigen::VectorXd& values) {
  std::string text;
  for (Eigen::Index i = 0; i < values.size(); ++i)
    text += (i == 0 ? "" : " ") + YamlNumber(values[i]);
  return text;
}

/// Nodes that publish the transforms. `executable`: the key that names what they run; `arguments`
/// gives those of a transform.
template <typename Arguments>
std::string PublishersText(const Lines& head, const std::vector<StaticTransform>& transforms,
                           const std::string& executable, Arguments arguments) {
  std::string text = XmlComment(head) + "<launch>\n";
  for (size_t i = 0; i < transforms.size(); ++i)
    text += "  <node pkg=\"tf2_ros\" " + executable +
            "=\"static_transform_publisher\" name=\"calibrated_tf" + std::to_string(i) +
            "\"\n        args=\"" + arguments(transforms[i]) + "\"/>\n";
  return text + "</launch>\n";
}

Lines FrameRemarks(const char* what) {
  return {what, "There is no key for time_shift: add it to the stamps of the imu."};
}

}  // namespace

std::vector<ExportFile> ExportEuroc(const StoredResult& stored, const ExportOptions&) {
  const Rigid3& T_MI = stored.result.imus[0].T_MI;
  const Lines of_poses = {
      "To be mav0/vicon0/sensor.yaml or mav0/mocap0/sensor.yaml. Body B = imu0, S = marker:",
      "T_BS: x_B = T_BS x_S, the inverse of T_marker_imu",
      "There is no key for time_shift: add it to the stamps of the imu."};
  std::vector<ExportFile> files = {
      {"euroc.vicon0.sensor.yaml", SensorYaml(stored, of_poses, false, "pose", T_MI.Inverse())}};
  for (size_t i = 0; i < stored.result.imus.size(); ++i) {
    const NoiseDensity noise = Noise(stored, i);
    const std::string name = "imu" + std::to_string(i);
    const Lines of_imu = {"To be mav0/" + name + "/sensor.yaml. Body B = imu0, S = " + name + ":",
                          "T_BS: x_B = T_BS x_S", kNoiseRemark};
    files.push_back({"euroc." + name + ".sensor.yaml",
                     SensorYaml(stored, of_imu, true, "imu",
                                i == 0 ? Rigid3() : T_MI.Inverse() * stored.result.imus[i].T_MI) +
                         "rate_hz: " + std::to_string(std::lround(noise.rate_hz)) + "\n" +
                         NoiseKeys(noise, "")});
  }
  return files;
}

std::vector<ExportFile> ExportVicon2Gt(const StoredResult& stored, const ExportOptions&) {
  const Rigid3 T_IM = stored.result.imus[0].T_MI.Inverse();
  const NoiseDensity noise = Noise(stored, 0);
  const PoseStd& poses = stored.result.sessions[0].noise;
  Vector6d sigmas;
  sigmas << Eigen::Vector3d::Constant(poses.rotation), Eigen::Vector3d::Constant(poses.position);
  const Lines more = {
      "Parameters of the node estimate_vicon2gt; B = marker:",
      "R_BtoI, p_BinI: x_imu = R_BtoI x_marker + p_BinI, the inverse of T_marker_imu;",
      "R_BtoI row by row",
      "toff_imu_to_vicon: t_imu = t_vicon + toff_imu_to_vicon, so -time_shift",
      "vicon_sigmas: [rad] about and [m] along the axes, per pose",
      kNoiseRemark};
  return {{"vicon2gt.launch",
           XmlComment(Head(stored, "vicon2gt launch parameters", false, more)) + "<launch>\n" +
               RosParam("R_BtoI", T_IM.q.toRotationMatrix()) + RosParam("p_BinI", T_IM.p) +
               DoubleParam("toff_imu_to_vicon", -stored.Clock(0).time_shift) +
               DoubleParam("gravity_magnitude", stored.result.sessions[0].g_W.norm()) +
               RosParam("vicon_sigmas", sigmas) +
               DoubleParam("gyroscope_noise_density", noise.gyro) +
               DoubleParam("gyroscope_random_walk", noise.gyro_walk) +
               DoubleParam("accelerometer_noise_density", noise.accel) +
               DoubleParam("accelerometer_random_walk", noise.accel_walk) + "</launch>\n"}};
}

std::vector<ExportFile> ExportMocap2Gt(const StoredResult& stored, const ExportOptions&) {
  const Rigid3& T_MI = stored.result.imus[0].T_MI;
  const SessionCalibration& session = stored.result.sessions[0];
  const NoiseDensity noise = Noise(stored, 0);
  const Eigen::Quaterniond q_WG = RotationFromVertical(-session.g_W);
  const auto keys = [&](const std::string& ending) {
    return "p_MI" + ending + ": " + List(T_MI.p) + "\nq_MI" + ending + ": " +
           List(T_MI.q.coeffs()) + "\nq_WG" + ending + ": " + List(q_WG.coeffs()) + "\ntoff_MI" +
           ending + ": " + YamlNumber(-stored.Clock(0).time_shift) + "\n";
  };
  const Lines meaning = {"p_MI, q_MI: x_marker = q_MI x_imu + p_MI, T_marker_imu itself",
                         "toff_MI: t_imu = t_marker + toff_MI, so -time_shift",
                         "q_WG: x_world = q_WG x_G, z of G is up; quaternions x, y, z, w"};
  Lines of_config = meaning;
  of_config.emplace_back("imu_noise: accelerometer density, walk, gyroscope density, walk");
  of_config.emplace_back(kNoiseRemark);
  Eigen::Vector4d imu_noise(noise.accel, noise.accel_walk, noise.gyro, noise.gyro_walk);
  return {
      {"mocap2gt.calib.yaml",
       YamlComment(Head(stored, "mocap2gt calibration", false, meaning)) + keys("")},
      {"mocap2gt.estimator_config.yaml",
       YamlComment(Head(stored, "mocap2gt, part of its config", false, of_config)) + keys("_init") +
           "gravity_magnitude: " + YamlNumber(session.g_W.norm()) +
           "\nmocap_trans_noise: " + List(Eigen::Vector3d::Constant(session.noise.position)) +
           "  # [m]\nmocap_rot_noise: " + List(Eigen::Vector3d::Constant(session.noise.rotation)) +
           "  # [rad]\nimu_noise: " + List(imu_noise) + "\nimu_freq: " + YamlNumber(noise.rate_hz) +
           "  # [Hz]\n"}};
}

std::vector<ExportFile> ExportLioSam(const StoredResult& stored, const ExportOptions&) {
  const Rigid3& T_MI = stored.result.imus[0].T_MI;
  const NoiseDensity noise = Noise(stored, 0);
  const Lines more = {
      "The pose sensor plays the lidar:",
      "extrinsicRot: v_lidar = extrinsicRot v_imu; extrinsicTrans: the imu in lidar axes [m];",
      "so lidar = marker, and the two are T_marker_imu",
      "extrinsicRPY: of the imu's own orientation; here as if that were of the same axes",
      "There is no key for time_shift: add it to the stamps of the imu beforehand.",
      kNoiseRemark};
  const std::string R = Block(T_MI.q.toRotationMatrix(), "    ");
  return {{"liosam.yaml",
           YamlComment(Head(stored, "LIO-SAM, part of its params.yaml", false, more)) +
               "lio_sam:\n  extrinsicTrans: " + List(T_MI.p) + "\n  extrinsicRot: " + R +
               "\n  extrinsicRPY: " + R + "\n  imuAccNoise: " + YamlNumber(noise.accel) +
               "\n  imuGyrNoise: " + YamlNumber(noise.gyro) + "\n  imuAccBiasN: " +
               YamlNumber(noise.accel_walk) + "\n  imuGyrBiasN: " + YamlNumber(noise.gyro_walk) +
               "\n  imuGravity: " + YamlNumber(stored.result.sessions[0].g_W.norm()) + "\n"}};
}

std::vector<ExportFile> ExportFastLio(const StoredResult& stored, const ExportOptions&) {
  const Rigid3 T_IM = stored.result.imus[0].T_MI.Inverse();
  const ImuSession& session = stored.Clock(0);
  const NoiseDensity noise = Noise(stored, 0);
  const auto square = [](double value) { return YamlNumber(value * value); };
  const Lines more = {
      "The pose sensor plays the lidar:",
      "extrinsic_R, extrinsic_T: x_imu = extrinsic_R x_lidar + extrinsic_T, so lidar = marker",
      "and the inverse of T_marker_imu",
      "time_offset_lidar_to_imu: t_imu - time_offset_lidar_to_imu = t_lidar, so -time_shift",
      "acc_cov, gyr_cov: variance per sample; b_acc_cov, b_gyr_cov: walk^2 * rate, since its",
      "filter multiplies all of them by dt^2. Its examples have larger ones.",
      kNoiseRemark};
  return {{"fastlio.yaml",
           YamlComment(Head(stored, "FAST-LIO2, part of its config", false, more)) +
               "common:\n  time_offset_lidar_to_imu: " + YamlNumber(-session.time_shift) +
               "\nmapping:\n  acc_cov: " + square(session.noise.accel) +
               "\n  gyr_cov: " + square(session.noise.gyro) +
               "\n  b_acc_cov: " + square(noise.accel_walk * std::sqrt(session.accel.rate_hz)) +
               "\n  b_gyr_cov: " + square(noise.gyro_walk * std::sqrt(session.gyro.rate_hz)) +
               "\n  extrinsic_T: " + List(T_IM.p) +
               "\n  extrinsic_R: " + Block(T_IM.q.toRotationMatrix(), "    ") + "\n"}};
}

std::vector<ExportFile> ExportPx4(const StoredResult& stored, const ExportOptions& options) {
  const Rigid3 T_IM = stored.result.imus[0].T_MI.Inverse();
  const Eigen::Quaterniond& q_BI = options.q_body_imu;
  const Eigen::Vector3d p_BM = q_BI * T_IM.p;
  const Eigen::Quaterniond q_BM = q_BI * T_IM.q;
  const double delay_ms = 1e3 * stored.Clock(0).time_shift;
  const bool fits = delay_ms >= 0.0 && delay_ms <= 300.0;
  Lines more = {"EKF2_EV_POS_*: the marker in body axes forward, right, down [m], from the imu",
                "v_body = q v_imu with q = " + List(q_BI.coeffs()) + " (x, y, z, w)" +
                    (q_BI.isApprox(Eigen::Quaterniond::Identity())
                         ? ": the imu's axes are taken for the body's;"
                         : ""),
                "if they are others, as mavros' forward, left, up: export_calibration --body-imu",
                "The poses sent must be of the body: q_body_marker = " + List(q_BM.coeffs()),
                "EKF2_EV_DELAY [ms]: time of a pose = its stamp - delay, so time_shift,",
                "if both clocks are the autopilot's"};
  if (!fits)
    more.push_back("EKF2_EV_DELAY must be 0 to 300 and is left out: time_shift is " +
                   Short(delay_ms) + " ms");
  more.emplace_back("columns: vehicle, component, name, value, type (9: float)");
  std::string text = YamlComment(Head(stored, "PX4 parameters", false, more));
  const auto add = [&text](const std::string& name, double value) {
    text += "1\t1\t" + name + "\t" + YamlNumber(value) + "\t9\n";
  };
  if (fits) add("EKF2_EV_DELAY", delay_ms);
  for (int i = 0; i < 3; ++i) add(std::string("EKF2_EV_POS_") + "XYZ"[i], p_BM[i]);
  return {{"px4.params", text}};
}

std::vector<ExportFile> ExportEvo(const StoredResult& stored, const ExportOptions&) {
  const Vector7d numbers = PoseNumbers(stored.result.imus[0].T_MI);
  std::string text = "{\n";
  for (Eigen::Index i = 0; i < numbers.size(); ++i)
    text += "  " + Quoted(kPoseKeys[i]) + ": " + YamlNumber(numbers[i]) + ",\n";
  const std::string offset = YamlNumber(-stored.Clock(0).time_shift);
  const Lines more = {"Poses of the marker become poses of the imu, on the imu's clock:",
                      "evo_traj tum markers.txt --transform_right THIS_FILE --t_offset " + offset,
                      "transform_right: T_marker_imu",
                      "t_offset: -time_shift, t_imu = t_pose + t_offset"};
  text += "  \"comment\": " + JsonList(Head(stored, "evo transform", false, more)) + "\n}\n";
  return {{"evo.json", text}};
}

std::string UrdfText(const Lines& head, const std::vector<StaticTransform>& transforms) {
  std::string text = "<?xml version=\"1.0\"?>\n" + XmlComment(head) +
                     "<robot name=\"calibrated_rig\">\n  <link name=\"" +
                     XmlText(transforms.front().parent) + "\"/>\n";
  for (const StaticTransform& transform : transforms) {
    const std::string parent = XmlText(transform.parent), child = XmlText(transform.child);
    text += "  <link name=\"" + child + "\"/>\n  <joint name=\"" + parent + "_to_" + child +
            "\" type=\"fixed\">\n    <parent link=\"" + parent + "\"/>\n    <child link=\"" +
            child + "\"/>\n    <origin xyz=\"" + Spaced(transform.T.p) + "\" rpy=\"" +
            Spaced(RollPitchYaw(transform.T.q)) + "\"/>\n  </joint>\n";
  }
  return text + "</robot>\n";
}

std::string LaunchText(const Lines& head, const std::vector<StaticTransform>& transforms) {
  return PublishersText(head, transforms, "type", [](const StaticTransform& transform) {
    return Spaced(PoseNumbers(transform.T)) + " " + XmlText(transform.parent) + " " +
           XmlText(transform.child);
  });
}

std::vector<StaticTransform> ImuTransforms(const StoredResult& stored) {
  std::vector<StaticTransform> transforms;
  for (size_t i = 0; i < stored.result.imus.size(); ++i)
    transforms.push_back(
        {stored.infos.front().marker_frame, stored.Info(i).imu_frame, stored.result.imus[i].T_MI});
  return transforms;
}

std::vector<ExportFile> ExportUrdf(const StoredResult& stored, const ExportOptions&) {
  const Lines more = FrameRemarks(
      "origin: x_parent = R x_child + xyz, R = Rz(y) Ry(p) Rx(r) with rpy = r p y: T_marker_imu");
  return {{"urdf", UrdfText(Head(stored, "URDF", true, more), ImuTransforms(stored))}};
}

std::vector<ExportFile> ExportTf(const StoredResult& stored, const ExportOptions&) {
  const Lines more =
      FrameRemarks("args: x y z qx qy qz qw parent child, x_parent = T x_child: T_marker_imu");
  return {{"tf.launch", LaunchText(Head(stored, "ROS 1 tf", true, more), ImuTransforms(stored))}};
}

std::vector<ExportFile> ExportRos2(const StoredResult& stored, const ExportOptions&) {
  const Lines more =
      FrameRemarks("args: x_frame = T x_child_frame: T_marker_imu. ros2 launch THIS_FILE");
  const auto arguments = [](const StaticTransform& transform) {
    const Vector7d numbers = PoseNumbers(transform.T);
    std::string text;
    for (Eigen::Index i = 0; i < numbers.size(); ++i)
      text += std::string("--") + kPoseKeys[i] + " " + YamlNumber(numbers[i]) + " ";
    return text + "--frame-id " + XmlText(transform.parent) + " --child-frame-id " +
           XmlText(transform.child);
  };
  return {{"ros2.launch.xml", PublishersText(Head(stored, "ROS 2 tf", true, more),
                                             ImuTransforms(stored), "exec", arguments)}};
}

}  // namespace imu_pose_calib
