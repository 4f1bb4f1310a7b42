#include "imu_pose_calib/ros/io/transform_file.h"

#include <algorithm>
#include <boost/algorithm/string/predicate.hpp>
#include <cmath>
#include <filesystem>
#include <sstream>

#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/io/text_table.h"
#include "imu_pose_calib/ros/io/yaml_file.h"

namespace imu_pose_calib {
namespace {

double Number(const YAML::Node& node, const std::string& what) {
  double value = 0.0;
  if (!node || !node.IsScalar() || !YAML::convert<double>::decode(node, value) ||
      !std::isfinite(value))
    Reject(what, " must be a finite number");
  return value;
}

Eigen::VectorXd Numbers(const YAML::Node& list, Eigen::Index count, const std::string& what) {
  if (!list || !list.IsSequence() || static_cast<Eigen::Index>(list.size()) != count)
    Reject(what, " must be a list of ", count, " numbers");
  Eigen::VectorXd values(count);
  for (Eigen::Index i = 0; i < count; ++i)
    values[i] = Number(list[static_cast<size_t>(i)], "each element of " + what);
  return values;
}

/// From x, y, z, w.
Eigen::Quaterniond ToQuaternion(const Eigen::Vector4d& xyzw, const std::string& what) {
  if (std::abs(xyzw.norm() - 1.0) > 0.01)
    Reject(what, " must be a unit quaternion x, y, z, w; its norm is ", xyzw.norm());
  return Eigen::Quaterniond(xyzw).normalized();
}

Rigid3 FromRows(const YAML::Node& rows, const std::string& what) {
  if (!rows.IsSequence() || rows.size() != 4) Reject(what, " must have four rows");
  Eigen::Matrix4d T;
  for (Eigen::Index i = 0; i < 4; ++i)
    T.row(i) = Numbers(rows[static_cast<size_t>(i)], 4, "each row of " + what);
  const Eigen::Matrix3d R = T.topLeftCorner<3, 3>();
  const bool is_rigid = (R * R.transpose()).isIdentity(1e-3) && R.determinant() > 0.0 &&
                        T.row(3).isApprox(Eigen::RowVector4d(0.0, 0.0, 0.0, 1.0));
  if (!is_rigid) Reject(what, " must be a rotation and a translation");
  return {Eigen::Quaterniond(R).normalized(), T.topRightCorner<3, 1>()};
}

Rigid3 FromLists(const YAML::Node& node) {
  return {ToQuaternion(Numbers(node["rotation"], 4, "rotation"), "rotation"),
          Numbers(node["translation"], 3, "translation")};
}

Rigid3 FromKeys(const YAML::Node& node) {
  const char* const keys[] = {"x", "y", "z", "qx", "qy", "qz", "qw"};
  Eigen::Matrix<double, 7, 1> values;
  for (Eigen::Index i = 0; i < 7; ++i) values[i] = Number(node[keys[i]], keys[i]);
  return {ToQuaternion(values.tail<4>(), "qx, qy, qz, qw"), values.head<3>()};
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

/// "a b c": exactly `count` finite numbers, separated by blanks or commas.
Eigen::VectorXd ParseNumbers(const std::string& name, const std::string& text, Eigen::Index count) {
  std::string spaced = text;
  std::replace(spaced.begin(), spaced.end(), ',', ' ');
  std::istringstream words(spaced);
  std::vector<double> values;
  for (std::string word; words >> word;) {
    const std::optional<double> value = ParseNumber(word);
    if (!value || !std::isfinite(*value))
      Reject(name, " '", text, "': '", word, "' is not a finite number");
    values.push_back(*value);
  }
  if (static_cast<Eigen::Index>(values.size()) != count)
    Reject(name, " '", text, "' must be ", count, " numbers, not ", values.size());
  return Eigen::Map<const Eigen::VectorXd>(values.data(), count);
}

}  // namespace

Eigen::Quaterniond ParseQuaternion(const std::string& name, const std::string& text) {
  return ToQuaternion(ParseNumbers(name, text, 4), name + " '" + text + "'");
}

Rigid3 ReadTransform(const std::string& name, const std::string& text) {
  std::error_code ignored;
  if (std::filesystem::exists(text, ignored) || boost::ends_with(text, ".yaml") ||
      boost::ends_with(text, ".json"))
    return LoadYaml(name, text, ParseTransform);
  const Eigen::VectorXd values = ParseNumbers(name, text, 7);
  return {ToQuaternion(values.tail<4>(), name + " '" + text + "': qx qy qz qw"), values.head<3>()};
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
