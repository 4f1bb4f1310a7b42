#pragma once

#include <Eigen/Core>
#include <string>

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// Lines of a stamp and numbers with one separator between them.
class TextTable {
 public:
  /// `header`: with the end of its line; `digits`: significant ones of a number, of which 17 tell
  /// every double from its neighbours.
  TextTable(const std::string& header, char separator, int digits = 17)
      : text_(header), separator_(separator), digits_(digits) {}

  /// A line of a stamp and of numbers and vectors.
  template <typename... Parts>
  void AddRow(const std::string& stamp, const Parts&... parts) {
    text_ += stamp;
    (Append(parts), ...);
    text_ += '\n';
  }
  const std::string& text() const { return text_; }

 private:
  void Append(double value);
  template <typename Derived>
  void Append(const Eigen::MatrixBase<Derived>& vector) {
    for (Eigen::Index i = 0; i < vector.size(); ++i) Append(vector[i]);
  }

  std::string text_;
  char separator_;
  int digits_;
};

/// Of the samples of an IMU in an ASL dataset.
extern const char kAslImuHeader[];

// Both write stamps and values so that ReadText() gets back the very same data, and throw
// InputError when a file cannot be written or when one file is to hold gyroscope and accelerometer
// samples of different stamps.

/// ASL dataset (EuRoC) of poses and IMU: folder/mocap0/data.csv and folder/imu0/data.csv; pose
/// sensors in pose_sensor0 and so on.
void WriteAslFolder(const std::string& folder, const SessionData& data);

/// Tables without any folder: prefix.poses.txt (TUM) and prefix.imu.csv, or for a split IMU
/// prefix.gyro.csv and prefix.accel.csv; pose sensors prefix.pose_sensor.txt, .pose_sensor1.txt and
/// so on.
void WriteTables(const std::string& prefix, const SessionData& data, bool split_imu);

}  // namespace imu_pose_calib
