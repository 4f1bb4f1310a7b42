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
  if (root["matrix"]) return ReadMatrix("matrix", root["matrix"]);
  if (root["translation"]) return FromLists(root);
  if (root["qw"]) return FromKeys(root);
  Reject(
      "must hold x y z qx qy qz qw, translation and rotation, or matrix, at the top or below "
      "transform or transformation");
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

}  // namespace imu_pose_calib
