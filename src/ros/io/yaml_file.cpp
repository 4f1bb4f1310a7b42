#include "imu_pose_calib/ros/io/yaml_file.h"

#include <yaml-cpp/eventhandler.h>

#include <algorithm>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <fstream>
#include <numeric>
#include <sstream>

#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

constexpr int kMaxDepth = 20;
constexpr size_t kMaxSize = 10'000'000;  // bytes

[[noreturn]] void FailAt(const YAML::Mark& mark, const std::string& text) {
  Reject(mark.is_null() ? text : "line ", mark.line + 1, ": ", text);
}

/// Follows the parser and stops it when collections nest too deep.
class DepthLimit : public YAML::EventHandler {
 public:
  void OnDocumentStart(const YAML::Mark&) override {}
  void OnDocumentEnd() override {}
  void OnNull(const YAML::Mark&, YAML::anchor_t) override {}
  void OnAlias(const YAML::Mark&, YAML::anchor_t) override {}
  void OnScalar(const YAML::Mark&, const std::string&, YAML::anchor_t,
                const std::string&) override {}
  void OnSequenceStart(const YAML::Mark& mark, const std::string&, YAML::anchor_t,
                       YAML::EmitterStyle::value) override {
    Enter(mark);
  }
  void OnSequenceEnd() override { --depth_; }
  void OnMapStart(const YAML::Mark& mark, const std::string&, YAML::anchor_t,
                  YAML::EmitterStyle::value) override {
    Enter(mark);
  }
  void OnMapEnd() override { --depth_; }

 private:
  void Enter(const YAML::Mark& mark) {
    if (++depth_ > kMaxDepth)
      FailAt(mark, "nested deeper than " + std::to_string(kMaxDepth) + " levels");
  }

  int depth_ = 0;
};

/// Levenshtein distance.
size_t EditDistance(const std::string& a, const std::string& b) {
  std::vector<size_t> row(b.size() + 1);
  std::iota(row.begin(), row.end(), size_t{0});
  for (const char letter : a) {
    size_t diagonal = row[0]++;
    for (size_t j = 0; j < b.size(); ++j) {
      const size_t replaced = diagonal + (letter == b[j] ? 0 : 1);
      diagonal = row[j + 1];
      row[j + 1] = std::min({replaced, row[j] + 1, row[j + 1] + 1});
    }
  }
  return row.back();
}

}  // namespace

std::string ReadYamlFile(const std::string& path) {
  if (IsFolder(path)) Reject("is a directory, must be a file");
  std::ifstream file(path, std::ios::binary);
  if (!file) Reject("cannot be read: ", std::strerror(errno));
  std::string text(kMaxSize + 1, '\0');
  file.read(text.data(), static_cast<std::streamsize>(text.size()));
  text.resize(static_cast<size_t>(file.gcount()));
  if (text.size() > kMaxSize) Reject("is larger than 10 MB");
  return text;
}

YAML::Node ParseYaml(const std::string& text) {
  try {
    std::istringstream in(text);
    DepthLimit limit;
    YAML::Parser(in).HandleNextDocument(limit);
    return YAML::Load(text);
  } catch (const YAML::Exception& error) {
    FailAt(error.mark, error.msg);
  }
}

void ReadYaml(const std::string& what, const YAML::Node& node, double* value) {
  if (!node || !node.IsScalar() || !YAML::convert<double>::decode(node, *value) ||
      !std::isfinite(*value))
    Reject(what, " must hold finite numbers");
}

void ReadYaml(const std::string& what, const YAML::Node& node, size_t* value) {
  if (!node || !node.IsScalar() || !YAML::convert<size_t>::decode(node, *value))
    Reject(what, " must be a whole number");
}

void ReadYaml(const std::string& what, const YAML::Node& node, std::string* value) {
  if (!node || !node.IsScalar()) Reject(what, " must be a string");
  *value = node.Scalar();
}

void ReadYaml(const std::string& what, const YAML::Node& node, Eigen::Quaterniond* value) {
  ReadYaml(what, node, &value->coeffs());
  *value = UnitQuaternion(what, value->coeffs());
}

Eigen::Quaterniond UnitQuaternion(const std::string& what, const Eigen::Vector4d& xyzw) {
  if (std::abs(xyzw.norm() - 1.0) > 0.01)
    Reject(what, " must be a unit quaternion x, y, z, w; its norm is ", xyzw.norm());
  return Eigen::Quaterniond(xyzw).normalized();
}

Rigid3 ReadMatrix(const std::string& what, const YAML::Node& rows) {
  Eigen::Matrix4d T;
  ReadYaml(what, rows, &T);
  const Eigen::Matrix3d R = T.topLeftCorner<3, 3>();
  const bool is_rigid = (R * R.transpose()).isIdentity(1e-3) && R.determinant() > 0.0 &&
                        T.row(3).isApprox(Eigen::RowVector4d(0.0, 0.0, 0.0, 1.0));
  if (!is_rigid) Reject(what, " must be a rotation and a translation");
  return {Eigen::Quaterniond(R).normalized(), T.topRightCorner<3, 1>()};
}

std::string DidYouMean(const std::string& name, const std::vector<std::string>& names) {
  std::string nearest;
  size_t least = std::max<size_t>(1, name.size() / 3) + 1;
  for (const std::string& other : names) {
    const size_t place = name.size() < 3 ? std::string::npos : other.find(name);
    const size_t distance =
        place == std::string::npos ? EditDistance(name, other) : std::min<size_t>(place, 1);
    if (distance >= least) continue;
    least = distance;
    nearest = other;
  }
  return nearest.empty() ? "" : "; did you mean '" + nearest + "'?";
}

}  // namespace imu_pose_calib
