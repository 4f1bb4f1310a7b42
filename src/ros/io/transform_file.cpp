#include "imu_pose_calib/ros/io/transform_file.h"

#include <boost/algorithm/string/predicate.hpp>
#include <boost/algorithm/string/replace.hpp>
#include <cmath>
#include <filesystem>
#include <sstream>

#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/io/yaml_file.h"

namespace imu_pose_calib {
namespace {

Rigid3 FromRows(const YAML::Node& rows, const std::string& what) {
  Eigen::Matrix4d T;
  ReadYaml(what, rows, &T);
  const Eigen::Matrix3d R = T.topLeftCorner<3, 3>();
  const bool is_rigid = (R * R.transpose()).isIdentity(1e-3) && R.determinant() > 0.0 &&
                        T.row(3).isApprox(Eigen::RowVector4d(0.0, 0.0, 0.0, 1.0));
  if (!is_rigid) Reject(what, " must be a rotation and a translation");
  return {Eigen::Quaterniond(R).normalized(), T.topRightCorner<3, 1>()};
}

Rigid3 FromLists(const YAML::Node& node) {
  Rigid3 T;
  ReadYaml("rotation", node["rotation"], &T.q);
  ReadYaml("translation", node["translation"], &T.p);
  return T;
}

Rigid3 FromKeys(const YAML::Node& node) {
  const char* const keys[] = {"x", "y", "z", "qx", "qy", "qz", "qw"};
  Eigen::Matrix<double, 7, 1> values;
  for (Eigen::Index i = 0; i < 7; ++i) ReadYaml(keys[i], node[keys[i]], &values[i]);
  return {UnitQuaternion("qx, qy, qz, qw", values.tail<4>()), values.head<3>()};
}

Rigid3 ParseTransform(const std::string& yaml) {
  const YAML::Node root = ParseYaml(yaml);
  if (!root.IsMap()) Reject("must be a map");
  if (root["transform"] && root["transform"].IsMap()) return FromLists(root["transform"]);
  if (root["transformation"] && root["transformation"].IsMap())
    return FromKeys(root["transformation"]);
  if (root["matrix"]) return FromRows(root["matrix"], "matrix");
  if (root["translation"]) return FromLists(root);
  if (root["qw"]) return FromKeys(root);
  Reject(
      "must hold x y z qx qy qz qw, translation and rotation, or matrix, at the top or below "
      "transform or transformation");
}

std::vector<ChainCamera> ParseCameraChain(const std::string& yaml) {
  const YAML::Node root = ParseYaml(yaml);
  std::vector<ChainCamera> cameras;
  if (!root.IsMap()) Reject("must be a map");
  for (const auto& entry : root) {
    const std::string name = entry.first.IsScalar() ? entry.first.Scalar() : "";
    if (name.compare(0, 3, "cam") != 0 || !entry.second.IsMap()) continue;
    const YAML::Node camera = entry.second;
    if (camera["T_cam_imu"])
      cameras.push_back({name, FromRows(camera["T_cam_imu"], name + ": T_cam_imu")});
    else if (camera["T_imu_cam"])
      cameras.push_back({name, FromRows(camera["T_imu_cam"], name + ": T_imu_cam").Inverse()});
    else
      Reject(name,
             " has no T_cam_imu; give the camchain-imucam.yaml of the calibration with the imu");
  }
  if (cameras.empty()) Reject("holds no cam0");
  return cameras;
}

/// The words of a text, which blanks or commas separate.
YAML::Node Words(const std::string& text) {
  YAML::Node words(YAML::NodeType::Sequence);
  std::istringstream in(boost::replace_all_copy(text, ",", " "));
  for (std::string word; in >> word;) words.push_back(word);
  return words;
}

}  // namespace

Eigen::Quaterniond ParseQuaternion(const std::string& name, const std::string& text) {
  Eigen::Quaterniond q;
  ReadYaml(name + " '" + text + "'", Words(text), &q);
  return q;
}

Rigid3 ReadTransform(const std::string& name, const std::string& text) {
  std::error_code ignored;
  if (std::filesystem::exists(text, ignored) || boost::ends_with(text, ".yaml") ||
      boost::ends_with(text, ".json"))
    return LoadYaml(name, text, ParseTransform);
  Eigen::Matrix<double, 7, 1> values;
  ReadYaml(name + " '" + text + "'", Words(text), &values);
  return {UnitQuaternion(name + " '" + text + "': qx qy qz qw", values.tail<4>()),
          values.head<3>()};
}

Eigen::Vector3d RollPitchYaw(const Eigen::Quaterniond& q) {
  const Eigen::Matrix3d R = q.toRotationMatrix();
  const double roll = std::atan2(R(2, 1), R(2, 2));
  // With a pitch of a right angle any roll will do, if the others are those of what is left.
  const Eigen::Matrix3d yaw_pitch = R * Eigen::AngleAxisd(-roll, Eigen::Vector3d::UnitX());
  return {roll, std::atan2(-yaw_pitch(2, 0), yaw_pitch(2, 2)),
          std::atan2(-yaw_pitch(0, 1), yaw_pitch(1, 1))};
}

std::vector<ChainCamera> LoadCameraChain(const std::string& path) {
  return LoadYaml("camera chain", path, ParseCameraChain);
}

}  // namespace imu_pose_calib
