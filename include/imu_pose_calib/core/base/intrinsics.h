#pragma once

#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// Scale and misalignment of the IMU's sensors, doc/math.md Eq. (19): measured = K true + bias,
/// both in I. All zeros is a calibrated sensor.

/// K_g from its lower triangle less the identity, (xx, yx, yy, zx, zy, zz): the gyroscope's x axis
/// is that of I and its y axis lies in the xy plane, so a rotation is left to R_MI alone.
inline Eigen::Matrix3d GyroMatrix(const Vector6d& m) {
  Eigen::Matrix3d M;
  M << 1.0 + m[0], 0.0, 0.0,  //
      m[1], 1.0 + m[2], 0.0,  //
      m[3], m[4], 1.0 + m[5];
  return M;
}

/// K_a from its elements less the identity, row by row.
inline Eigen::Matrix3d AccelMatrix(const Vector9d& m) {
  return Eigen::Matrix3d::Identity() + Eigen::Map<const Eigen::Matrix3d>(m.data()).transpose();
}

/// Places [m] in I of the accelerometer's axes, column i of axis i (size effect). I's origin has
/// the x of the middle of y and z, which is where turning accelerates along x, and so on.
inline Eigen::Matrix3d AccelPositions(const Vector6d& m) {
  Eigen::Matrix3d P;
  P << m[0], m[3], -m[3], -m[4], m[1], m[4], m[5], -m[5], m[2];
  return P;
}

}  // namespace imu_pose_calib
