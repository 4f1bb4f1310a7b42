#include "imu_pose_calib/ros/simulated/lidar.h"

#include <rosbag/bag.h>
#include <sensor_msgs/point_cloud2_iterator.h>

#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kRings = 16, kColumns = 360;
constexpr double kLowest = -M_PI / 8, kHighest = M_PI / 8;  // [rad] elevation of the rings
constexpr double kRangeStd = 0.01;                          // [m]

/// The room, whose walls are seen from inside, and what stands in it: corners [m] in W.
using Box = std::pair<Eigen::Array3d, Eigen::Array3d>;
const std::vector<Box> kBoxes = {{{-3.0, -2.5, -1.6}, {3.4, 2.9, 1.5}},
                                 {{1.6, -2.5, -1.6}, {2.6, -1.5, 1.5}},
                                 {{-3.0, 1.4, -1.6}, {-1.2, 2.9, -0.6}},
                                 {{2.2, 1.0, -0.5}, {3.4, 2.0, 0.3}},
                                 {{-2.4, -2.2, 0.6}, {-1.6, -1.2, 1.5}}};

}  // namespace

RayHit CastRay(const Eigen::Vector3d& origin_W, const Eigen::Vector3d& direction_W) {
  RayHit hit{std::numeric_limits<double>::infinity(), 0};
  for (size_t k = 0; k < kBoxes.size(); ++k) {
    // Infinite along axes that the ray is perpendicular to.
    const Eigen::Array3d a = (kBoxes[k].first - origin_W.array()) / direction_W.array();
    const Eigen::Array3d b = (kBoxes[k].second - origin_W.array()) / direction_W.array();
    const double enter = a.min(b).maxCoeff(), leave = a.max(b).minCoeff();
    if (k == 0)
      hit.range = leave;
    else if (enter > 0.0 && enter < leave && enter < hit.range)
      hit = {enter, static_cast<int>(k)};
  }
  return hit;
}

Rigid3 SimulatedLidar::T_IL() {
  return {Eigen::Quaterniond(0.5, 0.5, -0.5, -0.5) * Exp(Eigen::Vector3d(0.05, -0.08, 0.6)),
          {0.04, -0.11, 0.07}};
}

Rigid3 SimulatedLidar::PoseAt(int64_t stamp_ns) const {
  const TrueState body = trajectory_.At(options_.PoseTime(Seconds(stamp_ns - Stamp(0))));
  return Rigid3{Eigen::Quaterniond(body.R_WM), body.p_WM} * options_.T_MI * T_IL();
}

sensor_msgs::PointCloud2 SimulatedLidar::Cloud(size_t k) const {
  using sensor_msgs::PointField;
  sensor_msgs::PointCloud2 cloud;
  cloud.header = MakeHeader(FromNanoseconds(Stamp(k)), "lidar");
  cloud.is_dense = 1u;
  sensor_msgs::PointCloud2Modifier modifier(cloud);
  modifier.setPointCloud2Fields(5, "x", 1, PointField::FLOAT32, "y", 1, PointField::FLOAT32, "z", 1,
                                PointField::FLOAT32, "intensity", 1, PointField::FLOAT32, "t", 1,
                                PointField::UINT32);
  modifier.resize(kRings * kColumns);
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
      const RayHit hit = CastRay(T_WL.p, T_WL.q * ray_L);
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
  const int64_t offset = RecordOffset(lidar.Stamp(0), options.start_ns);
  try {
    rosbag::Bag bag(path, rosbag::bagmode::Append);
    for (size_t k = 0; k < lidar.Count(); ++k)
      bag.write("/points", FromNanoseconds(lidar.Stamp(k) + offset), lidar.Cloud(k));
  } catch (const rosbag::BagException& error) {
    Reject("cannot write bag '", path, "': ", error.what());
  }
}

std::string LidarYaml() {
  const Rigid3 T_IL = SimulatedLidar::T_IL();
  return "# T_imu_lidar: x_imu = R x_lidar + p\nrotation: " + YamlNumbers(T_IL.q.coeffs()) +
         "\ntranslation: " + YamlNumbers(T_IL.p) + "\n";
}

}  // namespace imu_pose_calib
