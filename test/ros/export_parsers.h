#pragma once

// Reads what is exported as its consumer documents it: none of this uses the code that writes.

#include <gtest/gtest.h>
#include <yaml-cpp/yaml.h>

#include <Eigen/Geometry>
#include <cereal/access.hpp>  // which the next needs
#include <cereal/external/rapidxml/rapidxml.hpp>
#include <map>
#include <sstream>
#include <string>
#include <vector>

namespace imu_pose_calib {

/// The YAML of a file that OpenCV's FileStorage can read: its first line says so.
inline YAML::Node OpenCvYaml(const std::string& text) {
  const std::string directive = "%YAML:1.0\n";
  EXPECT_EQ(text.compare(0, directive.size(), directive), 0) << text.substr(0, 80);
  return YAML::Load(text.substr(directive.size()));
}

/// A list of rows, as Kalibr and OpenVINS write matrices.
inline Eigen::MatrixXd RowList(const YAML::Node& node) {
  Eigen::MatrixXd matrix(node.size(), node[0].size());
  for (Eigen::Index i = 0; i < matrix.rows(); ++i)
    for (Eigen::Index j = 0; j < matrix.cols(); ++j) matrix(i, j) = node[i][j].as<double>();
  return matrix;
}

/// Elements row by row in one list.
inline Eigen::MatrixXd RowMajor(const std::vector<double>& data, Eigen::Index rows) {
  const auto cols = static_cast<Eigen::Index>(data.size()) / rows;
  Eigen::MatrixXd matrix(rows, cols);
  for (Eigen::Index i = 0; i < rows; ++i)
    for (Eigen::Index j = 0; j < cols; ++j) matrix(i, j) = data[static_cast<size_t>(i * cols + j)];
  return matrix;
}

/// A map of rows, cols and data; `dt` ("d", "f") only with the tag of OpenCV.
inline Eigen::Matrix4d DataMatrix(const YAML::Node& node, const std::string& dt = "") {
  EXPECT_EQ(node["rows"].as<int>(), 4);
  EXPECT_EQ(node["cols"].as<int>(), 4);
  EXPECT_EQ(node.Tag(), dt.empty() ? "?" : "tag:yaml.org,2002:opencv-matrix");
  EXPECT_EQ(node["dt"] ? node["dt"].as<std::string>() : "", dt);
  return RowMajor(node["data"].as<std::vector<double>>(), 4);
}

inline Eigen::Vector3d ToVector(const YAML::Node& node) {
  const auto v = node.as<std::vector<double>>();
  EXPECT_EQ(v.size(), 3u);
  return {v.at(0), v.at(1), v.at(2)};
}

inline Eigen::Matrix4d ToMatrix(const Eigen::Matrix3d& R, const Eigen::Vector3d& p) {
  Eigen::Matrix4d T = Eigen::Matrix4d::Identity();
  T.topLeftCorner<3, 3>() = R;
  T.topRightCorner<3, 1>() = p;
  return T;
}

/// From x, y, z and qx, qy, qz, qw.
inline Eigen::Matrix4d ToMatrix(const std::vector<double>& v) {
  EXPECT_EQ(v.size(), 7u);
  const Eigen::Quaterniond q(v.at(6), v.at(3), v.at(4), v.at(5));
  EXPECT_NEAR(q.norm(), 1.0, 1e-12);
  return ToMatrix(q.toRotationMatrix(), {v[0], v[1], v[2]});
}

inline std::vector<double> Doubles(const std::string& text) {
  std::istringstream in(text);
  std::vector<double> values;
  for (double value; in >> value;) values.push_back(value);
  return values;
}

inline std::vector<std::string> Words(const std::string& text) {
  std::istringstream in(text);
  std::vector<std::string> words;
  for (std::string word; in >> word;) words.push_back(word);
  return words;
}

/// An element of XML.
struct Element {
  std::string name, text;
  std::map<std::string, std::string> attributes;
  std::vector<Element> children;

  std::string operator[](const char* attribute) const { return attributes.at(attribute); }
  /// The only child of that name.
  const Element& Child(const std::string& child) const {
    const Element* found = nullptr;
    for (const Element& element : children) {
      if (element.name != child) continue;
      EXPECT_EQ(found, nullptr) << child;
      found = &element;
    }
    if (!found) throw std::runtime_error("no element " + child + " in " + name);
    return *found;
  }
};

inline Element ToElement(const cereal::rapidxml::xml_node<>& node) {
  Element element = {node.name(), node.value(), {}, {}};
  for (const auto* a = node.first_attribute(); a; a = a->next_attribute())
    element.attributes[a->name()] = a->value();
  for (const auto* child = node.first_node(); child; child = child->next_sibling())
    if (child->type() == cereal::rapidxml::node_element)
      element.children.push_back(ToElement(*child));
  return element;
}

/// The root of an XML text, which must be called `name`. Throws when it is not well-formed.
inline Element Xml(std::string text, const std::string& name) {
  cereal::rapidxml::xml_document<> document;
  document.parse<cereal::rapidxml::parse_validate_closing_tags>(text.data());
  EXPECT_EQ(document.first_node()->name(), name);
  EXPECT_EQ(document.first_node()->next_sibling(), nullptr);
  return ToElement(*document.first_node());
}

/// A transform between two frames, x_parent = T x_child.
struct Link {
  std::string parent, child;
  Eigen::Matrix4d T;
};

/// The fixed joints of a robot description: R = Rz(y) Ry(p) Rx(r) of `rpy`.
inline std::vector<Link> UrdfLinks(const std::string& text) {
  std::vector<Link> links;
  for (const Element& joint : Xml(text, "robot").children) {
    if (joint.name != "joint") continue;
    EXPECT_EQ(joint["type"], "fixed");
    const auto xyz = Doubles(joint.Child("origin")["xyz"]);
    const auto rpy = Doubles(joint.Child("origin")["rpy"]);
    const Eigen::Quaterniond q = Eigen::AngleAxisd(rpy.at(2), Eigen::Vector3d::UnitZ()) *
                                 Eigen::AngleAxisd(rpy.at(1), Eigen::Vector3d::UnitY()) *
                                 Eigen::AngleAxisd(rpy.at(0), Eigen::Vector3d::UnitX());
    links.push_back({joint.Child("parent")["link"], joint.Child("child")["link"],
                     ToMatrix(q.toRotationMatrix(), {xyz.at(0), xyz.at(1), xyz.at(2)})});
  }
  return links;
}

/// The static_transform_publishers of a launch file of ROS 1: x y z qx qy qz qw parent child.
inline std::vector<Link> LaunchLinks(const std::string& text) {
  std::vector<Link> links;
  for (const Element& node : Xml(text, "launch").children) {
    if (node.name != "node") continue;
    EXPECT_EQ(node["pkg"], "tf2_ros");
    EXPECT_EQ(node["type"], "static_transform_publisher");
    const std::string arguments = node["args"];
    const std::vector<std::string> words = Words(arguments);
    EXPECT_EQ(words.size(), 9u) << arguments;
    links.push_back({words.at(7), words.at(8), ToMatrix(Doubles(arguments))});
  }
  return links;
}

/// Those of ROS 2: --x and so on, each with its value.
inline std::vector<Link> Ros2Links(const std::string& text) {
  std::vector<Link> links;
  for (const Element& node : Xml(text, "launch").children) {
    if (node.name != "node") continue;
    EXPECT_EQ(node["exec"], "static_transform_publisher");
    const std::vector<std::string> words = Words(node["args"]);
    std::map<std::string, std::string> options;
    for (size_t i = 0; i + 1 < words.size(); i += 2) options[words[i]] = words[i + 1];
    EXPECT_EQ(options.size(), 9u);
    std::vector<double> v;
    for (const char* key : {"--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw"})
      v.push_back(std::stod(options.at(key)));
    links.push_back({options.at("--frame-id"), options.at("--child-frame-id"), ToMatrix(v)});
  }
  return links;
}

}  // namespace imu_pose_calib
