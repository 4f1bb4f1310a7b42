#include "imu_pose_calib/ros/clouds/simulated_lidar.h"

#include <rosbag/bag.h>
#include <sensor_msgs/point_cloud2_iterator.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/ros/clouds/point_cloud.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/yaml_text.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kRings = 16, kColumns = 360;
constexpr double kLowest = -M_PI / 8, kHighest = M_PI / 8;  // [rad] elevation of the rings
constexpr int64_t kTurnNs = 100'000'000;
constexpr double kRangeStd = 0.01;  // [m]

struct Box {
  Eigen::Vector3d lower, upper;  ///< [m] in W
};

/// The room, whose walls are seen from inside, and what stands in it.
const std::vector<Box> kBoxes = {{{-3.0, -2.5, -1.6}, {3.4, 2.9, 1.5}},
                                 {{1.6, -2.5, -1.6}, {2.6, -1.5, 1.5}},
                                 {{-3.0, 1.4, -1.6}, {-1.2, 2.9, -0.6}},
                                 {{2.2, 1.0, -0.5}, {3.4, 2.0, 0.3}},
                                 {{-2.4, -2.2, 0.6}, {-1.6, -1.2, 1.5}}};

/// Where a ray enters a box and where it leaves it; nothing is between when it misses.
struct Span {
  double enter = -std::numeric_limits<double>::infinity();
  double leave = std::numeric_limits<double>::infinity();
};

Span Through(const Box& box, const Eigen::Vector3d& origin, const Eigen::Vector3d& direction) {
  Span span;
  for (int i = 0; i < 3; ++i) {
    if (direction[i] == 0.0) {
      if (origin[i] < box.lower[i] || origin[i] > box.upper[i]) return {1.0, 0.0};
      continue;
    }
    const double a = (box.lower[i] - origin[i]) / direction[i];
    const double b = (box.upper[i] - origin[i]) / direction[i];
    span.enter = std::max(span.enter, std::min(a, b));
    span.leave = std::min(span.leave, std::max(a, b));
  }
  return span;
}

}  // namespace

SimulatedRoom::Hit SimulatedRoom::Cast(const Eigen::Vector3d& origin_W,
                                       const Eigen::Vector3d& direction_W) {
  Hit hit{Through(kBoxes[0], origin_W, direction_W).leave, 0};
  for (size_t k = 1; k < kBoxes.size(); ++k) {
    const Span span = Through(kBoxes[k], origin_W, direction_W);
    if (span.enter > 0.0 && span.enter < span.leave && span.enter < hit.range)
      hit = {span.enter, static_cast<int>(k)};
  }
  return hit;
}

Rigid3 SimulatedLidar::T_IL() {
  return {Eigen::Quaterniond(0.5, 0.5, -0.5, -0.5) * Exp(Eigen::Vector3d(0.05, -0.08, 0.6)),
          {0.04, -0.11, 0.07}};
}

size_t SimulatedLidar::Count() const {
  return static_cast<size_t>(options_.duration_s / (1e-9 * static_cast<double>(kTurnNs)));
}

int64_t SimulatedLidar::Stamp(size_t k) const {
  return options_.start_ns - std::llround(1e9 * options_.time_shift_s) +
         static_cast<int64_t>(k) * kTurnNs;
}

Rigid3 SimulatedLidar::PoseAt(int64_t stamp_ns) const {
  const double s = 1e-9 * static_cast<double>(stamp_ns - Stamp(0));
  // Like the IMU's samples: the time shift holds at mid-recording.
  const double t = s + options_.clock_drift * (s - 0.5 * options_.duration_s);
  const TrueState body = trajectory_.At(t);
  return Rigid3{Eigen::Quaterniond(body.R_WM), body.p_WM} * options_.T_MI * T_IL();
}

sensor_msgs::PointCloud2 SimulatedLidar::Cloud(size_t k) const {
  sensor_msgs::PointCloud2 cloud =
      NewCloud("lidar", {"x", "y", "z", "intensity", "t"}, kRings * kColumns);
  cloud.header.stamp = FromNanoseconds(Stamp(k));
  sensor_msgs::PointCloud2Iterator<float> x(cloud, "x"), intensity(cloud, "intensity");
  sensor_msgs::PointCloud2Iterator<uint32_t> t(cloud, "t");

  std::mt19937 random(options_.seed + 7919u * static_cast<uint32_t>(k));
  std::normal_distribution<double> noise(0.0, kRangeStd);
  for (size_t column = 0; column < kColumns; ++column) {
    const int64_t after_ns = kTurnNs * static_cast<int64_t>(column) / int64_t{kColumns};
    const Rigid3 T_WL = PoseAt(Stamp(k) + after_ns);
    const double azimuth = 2.0 * M_PI * static_cast<double>(column) / kColumns;
    for (size_t i = 0; i < kRings; ++i, ++x, ++intensity, ++t) {
      const double up =
          kLowest + (kHighest - kLowest) * static_cast<double>(i) / double{kRings - 1};
      const Eigen::Vector3d ray_L(std::cos(up) * std::cos(azimuth),
                                  std::cos(up) * std::sin(azimuth), std::sin(up));
      const SimulatedRoom::Hit hit = SimulatedRoom::Cast(T_WL.p, T_WL.q * ray_L);
      const Eigen::Vector3f p_L = ((hit.range + noise(random)) * ray_L).cast<float>();
      for (int j = 0; j < 3; ++j) x[static_cast<size_t>(j)] = p_L[j];
      *intensity = static_cast<float>(20 + 40 * hit.surface);
      *t = static_cast<uint32_t>(after_ns);
    }
  }
  return cloud;
}

void AppendLidar(const std::string& path, const SimulatorOptions& options) {
  const SimulatedLidar lidar(options);
  // As those of the IMU: clocks that are days apart are recorded as if they had started together.
  constexpr double kDay = 86400.0;  // [s]
  const int64_t offset =
      std::abs(options.time_shift_s) > kDay ? std::llround(1e9 * options.time_shift_s) : 0;
  try {
    rosbag::Bag bag(path, rosbag::bagmode::Append);
    for (size_t k = 0; k < lidar.Count(); ++k)
      bag.write("/points", FromNanoseconds(lidar.Stamp(k) + offset), lidar.Cloud(k));
  } catch (const rosbag::BagException& error) {
    throw InputError("cannot write bag '" + path + "': " + error.what());
  }
}

std::string LidarYaml() {
  const Rigid3 T_IL = SimulatedLidar::T_IL();
  const auto list = [](const Eigen::VectorXd& values) {
    std::string text;
    for (Eigen::Index i = 0; i < values.size(); ++i)
      text += (i == 0 ? "[" : ", ") + YamlNumber(values[i]);
    return text + "]";
  };
  return "# T_imu_lidar: x_imu = R x_lidar + p\nrotation: " + list(T_IL.q.coeffs()) +
         "\ntranslation: " + list(T_IL.p) + "\n";
}

}  // namespace imu_pose_calib
