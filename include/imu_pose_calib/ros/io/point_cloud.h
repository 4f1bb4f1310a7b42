#pragma once

#include <sensor_msgs/PointCloud2.h>

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <string>
#include <vector>

namespace imu_pose_calib {

/// One point as its sensor S sees it.
struct CloudPoint {
  Eigen::Vector3f p_S;        ///< [m] not finite: the sensor saw nothing
  float intensity = 0.0f;     ///< 0 when the cloud has none
  int64_t time_after_ns = 0;  ///< after the stamp of the cloud
};

/// What the points of a cloud say of their own times.
struct PointTime {
  std::string field;     ///< empty: nothing, each is of the stamp of its cloud
  std::string unit;      ///< its name
  double unit_s = 0.0;   ///< [s]
  bool is_since = true;  ///< after the stamp of the cloud; else after the epoch of that stamp
};

/// How the points of a topic tell their times, by its first clouds. `choice`: "auto" finds the unit
/// by which the times of a cloud fill the time between two clouds; "s", "ms", "us" or "ns" are the
/// unit; "none": not to be used. Throws InputError when it cannot be told.
PointTime FindPointTime(const std::vector<sensor_msgs::PointCloud2>& clouds,
                        const std::string& choice);

/// All points of a cloud. Throws InputError naming field, value and bound when the message
/// contradicts itself, lacks x, y or z, or has times more than a second from its stamp.
std::vector<CloudPoint> ReadCloud(const sensor_msgs::PointCloud2& cloud, const PointTime& time);

bool HasIntensity(const sensor_msgs::PointCloud2& cloud);

/// A point of a map: x, y, z [m] in W, and intensity.
using MapPoint = std::array<float, 4>;

/// As a binary file of the Point Cloud Library, version 0.7.
std::string ToPcd(const std::vector<MapPoint>& points, bool has_intensity);

/// The same as a message without a stamp.
sensor_msgs::PointCloud2 ToMessage(const std::vector<MapPoint>& points, const std::string& frame);

}  // namespace imu_pose_calib
