#pragma once

#include <Eigen/Core>
#include <array>
#include <boost/functional/hash.hpp>
#include <cstdint>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <unordered_map>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/ros/io/point_cloud.h"
#include "imu_pose_calib/ros/offline/offline.h"

namespace imu_pose_calib {

/// T_WS, the pose of a sensor S, at a stamp of its clouds; nothing where it is not known.
using SensorPoseAt = std::function<std::optional<Rigid3>(int64_t stamp_ns)>;

/// Where a sensor S sits on the body, and whose clock stamps it.
struct SensorMount {
  std::optional<Rigid3> T_IS, T_MS;  ///< exactly one of them
  /// T_MI of who has no calibration; default: the nearest right angles, and no lever arm.
  std::optional<Rigid3> guessed_T_MI;
  bool is_on_imu_clock = true;  ///< else that of the poses
};

/// The poses of a sensor, and what they are made with.
struct SensorPoses {
  std::string name;
  SensorPoseAt pose;
};

/// What the first IMU and the poses of the first session tell of the sensor: first without a
/// calibration, then without one part of it at a time, and last with all of it. The data must still
/// be in `offline`.
std::vector<SensorPoses> PosesWithAndWithout(const SensorMount& sensor,
                                             const OfflineResult& offline);

/// The rotation nearest to `q` that turns axes into axes: what anybody sees who looks at a sensor.
Eigen::Quaterniond ToRightAngles(const Eigen::Quaterniond& q);

/// How a sensor moved during a cloud: its pose every millisecond, linear between.
class CloudMotion {
 public:
  explicit CloudMotion(SensorPoseAt pose) : pose_(std::move(pose)) {}

  /// What S sees at p_S at a stamp of the cloud, in W; nothing where its pose is not known on both
  /// sides.
  std::optional<Eigen::Vector3d> Place(int64_t stamp_ns, const Eigen::Vector3f& p_S);

 private:
  SensorPoseAt pose_;
  std::map<int64_t, std::optional<Rigid3>> poses_;
};

/// A cube of space, by its place on each axis.
using Cube = std::array<int64_t, 3>;

/// The mean of the points in each cube, so that memory grows with what was seen, not with time.
class VoxelMap {
 public:
  /// `size` [m] of a cube; `most`: of them, see Add().
  explicit VoxelMap(double size, size_t most = 10'000'000) : size_(size), most_(most) {}

  /// Throws InputError when there are more cubes than memory is meant for.
  void Add(const Eigen::Vector3d& p_W, float intensity);

  size_t size() const { return cubes_.size(); }
  std::vector<MapPoint> Points() const;

 private:
  using Sum = Eigen::Matrix<double, 5, 1>;  ///< of points as in MapPoint, and their number

  double size_;
  size_t most_;
  std::unordered_map<Cube, Sum, boost::hash<Cube>> cubes_;
};

/// How sharp a map is, by the points around some of its points.
struct Sharpness {
  /// Mean map entropy: mean of ln |2 pi e C| / 2 with C [m^2] the covariance of the points around.
  double entropy = 0.0;
  /// [m] rms distance of the points around to the plane through them, median.
  double thickness = 0.0;
  size_t places = 0;  ///< points that were looked around at
};

/// Sharpness of several maps of the same points, in the same order, at the same of them; those that
/// are not finite in one map are not used in any. `radius` [m]: what is around.
std::vector<Sharpness> CompareSharpness(const std::vector<std::vector<Eigen::Vector3f>>& maps,
                                        double radius);

}  // namespace imu_pose_calib
