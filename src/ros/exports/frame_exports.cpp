// Static transforms: URDF, tf of ROS 1 and of ROS 2.

#include <cmath>

#include "imu_pose_calib/ros/exports/export_text.h"
#include "imu_pose_calib/ros/io/result_yaml.h"

namespace imu_pose_calib {
namespace {

/// R = Rz(yaw) Ry(pitch) Rx(roll), as (roll, pitch, yaw) [rad].
Eigen::Vector3d RollPitchYaw(const Eigen::Quaterniond& q) {
  const Eigen::Matrix3d R = q.toRotationMatrix();
  const double roll = std::atan2(R(2, 1), R(2, 2));
  // With a pitch of a right angle any roll will do, if the others are those of what is left.
  const Eigen::Matrix3d yaw_pitch = R * Eigen::AngleAxisd(-roll, Eigen::Vector3d::UnitX());
  return {roll,
          std::atan2(-yaw_pitch(2, 0), yaw_pitch(2, 2)),
          std::atan2(-yaw_pitch(0, 1), yaw_pitch(1, 1))};
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
std::string PublishersText(const Lines& head,
                           const std::vector<StaticTransform>& transforms,
                           const std::string& executable,
                           Arguments arguments) {
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
  return {{"ros2.launch.xml",
           PublishersText(
               Head(stored, "ROS 2 tf", true, more), ImuTransforms(stored), "exec", arguments)}};
}

}  // namespace imu_pose_calib
