// Where the markers of a live calibration are in the view that comes with the package.

#include <gtest/gtest.h>
#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <cmath>
#include <sstream>

#include "imu_pose_calib/ros/live/markers.h"
#include "test_util.h"

namespace imu_pose_calib {
namespace {

using visualization_msgs::Marker;

/// The camera of rviz/calibration.rviz on a screen of 1280x800.
class View {
 public:
  View() {
    const YAML::Node rviz = YAML::LoadFile(IMU_POSE_CALIB_SOURCE_DIR "/rviz/calibration.rviz");
    const YAML::Node view = rviz["Visualization Manager"]["Views"]["Current"];
    const double pitch = view["Pitch"].as<double>(), yaw = view["Yaw"].as<double>();
    const YAML::Node focus = view["Focal Point"];
    backward_ = {std::cos(yaw) * std::cos(pitch), std::sin(yaw) * std::cos(pitch), std::sin(pitch)};
    right_ = Eigen::Vector3d::UnitZ().cross(backward_).normalized();
    up_ = backward_.cross(right_);
    position_ =
        Eigen::Vector3d(focus["X"].as<double>(), focus["Y"].as<double>(), focus["Z"].as<double>()) +
        view["Distance"].as<double>() * backward_;
    height_ = rviz["Window Geometry"]["Height"].as<double>();
    width_ = rviz["Window Geometry"]["Width"].as<double>();
  }

  double height() const { return height_; }
  double width() const { return width_; }

  /// Larger than 1: outside. The menu and the borders are not part of the image.
  double Outside(const Eigen::Vector3d& point) const {
    const double half = std::tan(22.5 / 180.0 * M_PI);  // OGRE's field of view
    const double aspect = (width_ - 32.0) / (height_ - 62.0);
    const Eigen::Vector3d d = point - position_;
    const double depth = -d.dot(backward_);
    if (depth <= 0.0) return 1e3;
    return std::max(std::abs(d.dot(up_)), std::abs(d.dot(right_)) / aspect) / depth / half;
  }
  /// The same of the corners of a text, whose letters are about half as wide as high.
  double Outside(const Marker& text) const {
    std::istringstream lines(text.text);
    double width = 0.0, height = 0.0;
    for (std::string line; std::getline(lines, line);) {
      width = std::max(width, 0.5 * text.scale.z * static_cast<double>(line.size()));
      height += text.scale.z;
    }
    const auto& p = text.pose.position;
    double outside = 0.0;
    for (const double x : {-0.5, 0.5})
      for (const double y : {-0.5, 0.5})
        outside = std::max(outside, Outside(Eigen::Vector3d(p.x, p.y, p.z) + x * width * right_ +
                                            y * height * up_));
    return outside;
  }

 private:
  Eigen::Vector3d position_, backward_, right_, up_;
  double height_, width_;
};

/// What is drawn for motion within 0.4 m of `center`.
visualization_msgs::MarkerArray DrawMotionAround(const Eigen::Vector3d& center) {
  LiveCalibration live((LiveOptions()));
  for (const double d : {-0.4, 0.0, 0.4})
    live.AddPose({1 + static_cast<int64_t>(1e9 * (1.0 + d)),
                  Eigen::Quaterniond::Identity(),
                  center + Eigen::Vector3d::Constant(d),
                  {}},
                 1.0 + d);
  Calibration result;
  result.status = Status::kOk;
  live.BeginSolve();
  live.EndSolve(result);
  CalibrationStatus status;
  status.phase = CalibrationStatus::CONVERGED;
  status.message = "sigma 0.176 mm, 0.0381 deg, 0.106 ms; call save to keep it and then some more";
  return Draw(live, status, "world");
}

TEST(Markers, WindowFitsOnASmallScreen) {
  EXPECT_LE(View().width(), 1280.0);
  EXPECT_LE(View().height(), 800.0 - 40.0) << "with its title";
}

/// Wherever the motion can be seen, the verdict can be, too.
TEST(Markers, VerdictIsInTheView) {
  const View view;
  for (const double x : {-0.8, 0.0, 0.8})
    for (const double y : {-0.5, 0.5, 1.5})
      for (const double z : {0.0, 0.5, 1.0, 1.5, 2.0}) {
        const Eigen::Vector3d center(x, y, z);
        if (view.Outside(center) > 0.8) continue;
        int texts = 0;
        for (const Marker& marker : DrawMotionAround(center).markers) {
          if (marker.ns != "verdict") continue;
          EXPECT_LT(view.Outside(marker), 1.0)
              << "'" << marker.text << "' for motion around " << center.transpose();
          ++texts;
        }
        EXPECT_EQ(texts, 3);
      }
}

/// rviz ends where one is not.
TEST(Markers, PosesAreRotations) {
  for (const Marker& marker : DrawMotionAround({0.0, 0.5, 1.0}).markers) {
    if (marker.action != Marker::ADD) continue;
    const auto& q = marker.pose.orientation;
    EXPECT_NEAR(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z, 1.0, 1e-9)
        << marker.ns << " " << marker.id;
  }
}

/// Nor does it hide the motion.
TEST(Markers, PanelIsAboveOrBelowTheMotion) {
  for (const double z : {0.0, 1.0, 1.2, 2.0})
    for (const Marker& marker : DrawMotionAround({0.0, 0.5, z}).markers) {
      if (marker.ns != "bars" || marker.type != Marker::CUBE) continue;
      EXPECT_GT(std::abs(marker.pose.position.z - z), 0.4 + 0.5 * marker.scale.z) << z;
    }
}

}  // namespace
}  // namespace imu_pose_calib
