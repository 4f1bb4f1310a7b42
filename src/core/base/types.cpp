#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

Rigid3 Rigid3::Inverse() const { return {q.conjugate(), -(q.conjugate() * p)}; }

Eigen::Matrix4d Rigid3::Matrix() const {
  Eigen::Matrix4d T = Eigen::Matrix4d::Identity();
  T.topLeftCorner<3, 3>() = q.toRotationMatrix();
  T.topRightCorner<3, 1>() = p;
  return T;
}

Rigid3 operator*(const Rigid3& T_XY, const Rigid3& T_YZ) {
  return {T_XY.q * T_YZ.q, T_XY.q * T_YZ.p + T_XY.p};
}

Rigid3 Interpolate(const Rigid3& from, const Rigid3& to, double u) {
  return {from.q.slerp(u, to.q), (1.0 - u) * from.p + u * to.p};
}

}  // namespace imu_pose_calib
