#pragma once

#include <sensor_msgs/PointCloud2.h>

#include <string>

#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {

/// What a ray meets first in a closed room with boxes in it, all along the axes of W.
struct RayHit {
  double range;  ///< [m]
  int surface;   ///< 0: the room, 1...: the boxes
};
/// From inside of the room, along a unit vector.
RayHit CastRay(const Eigen::Vector3d& origin_W, const Eigen::Vector3d& direction_W);

/// A lidar L on the body of a simulated recording in that room: 16 rings of 360 points, ten turns a
/// second, on the IMU's clock.
class SimulatedLidar {
 public:
  explicit SimulatedLidar(const SimulatorOptions& options)
      : options_(options), trajectory_(options) {}

  static Rigid3 T_IL();

  /// Clouds.
  size_t Count() const { return static_cast<size_t>(options_.duration_s / (1e-9 * kTurnNs)); }
  /// Of the first points of cloud k, IMU clock.
  int64_t Stamp(size_t k) const { return options_.ImuStart() + static_cast<int64_t>(k) * kTurnNs; }
  /// T_WL at a stamp of the IMU's clock.
  Rigid3 PoseAt(int64_t stamp_ns) const;
  /// Cloud k: x, y, z, intensity, and t [ns] after the stamp, each point of its own instant.
  sensor_msgs::PointCloud2 Cloud(size_t k) const;

 private:
  static constexpr int64_t kTurnNs = 100'000'000;

  SimulatorOptions options_;
  TrueTrajectory trajectory_;
};

/// Adds its clouds to a bag of WriteBag() as /points (frame lidar).
/// Throws InputError when the file cannot be written.
void AppendLidar(const std::string& path, const SimulatorOptions& options);

/// T_imu_lidar as YAML that ReadTransform() reads.
std::string LidarYaml();

}  // namespace imu_pose_calib
