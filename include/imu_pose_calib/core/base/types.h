#pragma once

/// Frames, clocks and units of the whole package, stated once.
///
///   W  fixed frame of the pose source        M  marker: the body whose pose is recorded
///   I  IMU                                 S  further source of poses on the body (pose sensor)
///   V  fixed frame of the poses of S, which may drift against W
///
/// `R_XY` turns Y coordinates into X coordinates, `p_XY` is the origin of Y in X coordinates:
///   x_X = R_XY x_Y + p_XY.
/// A single suffix names the frame of the coordinates (`omega_M`, `g_W`).
/// The result is T_MI (x_M = R_MI x_I + p_MI) and `time_shift` [s]: t_pose = t_imu + time_shift.
/// Everything is SI: m, s, rad, rad/s, m/s^2.

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <cstdint>
#include <stdexcept>
#include <vector>

namespace imu_pose_calib {

using Vector6d = Eigen::Matrix<double, 6, 1>;
using Vector9d = Eigen::Matrix<double, 9, 1>;
using Matrix6d = Eigen::Matrix<double, 6, 6>;

/// Rigid transform T_XY: x_X = q x_Y + p.
struct Rigid3 {
  Eigen::Quaterniond q = Eigen::Quaterniond::Identity();
  Eigen::Vector3d p = Eigen::Vector3d::Zero();

  Rigid3 Inverse() const { return {q.conjugate(), -(q.conjugate() * p)}; }
  Eigen::Matrix4d Matrix() const { return (Eigen::Translation3d(p) * q).matrix(); }
};

/// T_XZ = T_XY T_YZ.
inline Rigid3 operator*(const Rigid3& T_XY, const Rigid3& T_YZ) {
  return {T_XY.q * T_YZ.q, T_XY.q * T_YZ.p + T_XY.p};
}
/// `from` at u = 0, `to` at u = 1, and at the same speed between them.
inline Rigid3 Interpolate(const Rigid3& from, const Rigid3& to, double u) {
  return {from.q.slerp(u, to.q), (1.0 - u) * from.p + u * to.p};
}

/// Sigma of a pose, per axis.
struct PoseStd {
  double position = 0.0;  ///< [m]
  double rotation = 0.0;  ///< [rad]
};

/// One pose of the marker, stamped by the pose clock.
struct PoseSample {
  int64_t t_ns = 0;  ///< pose clock
  Eigen::Quaterniond q_WM = Eigen::Quaterniond::Identity();
  Eigen::Vector3d p_WM = Eigen::Vector3d::Zero();  ///< [m]
  PoseStd stated_std;                              ///< as its source says; 0: it does not
};

/// Sigma of the samples of an IMU, per axis.
struct ImuStd {
  double gyro = 0.0;   ///< [rad/s]
  double accel = 0.0;  ///< [m/s^2]
};

/// One gyroscope [rad/s] or accelerometer [m/s^2] sample in I, stamped by the IMU clock.
struct ImuSample {
  int64_t t_ns = 0;  ///< IMU clock
  Eigen::Vector3d value = Eigen::Vector3d::Zero();
};

/// What a recording holds of one IMU, in the order in which it arrived; both empty: nothing.
struct ImuData {
  std::vector<ImuSample> gyro;
  std::vector<ImuSample> accel;

  bool IsEmpty() const { return gyro.empty() && accel.empty(); }
};

/// One recording of a rig, which is a marker and the IMUs and pose sensors on its body, in the
/// order in which it arrived. Integer stamps keep clocks that are days apart at full precision. The
/// places in `imus` and `pose_sensors` are those of the rig: the same in all its sessions, empty
/// where a session lacks one.
struct SessionData {
  std::vector<PoseSample> poses;
  std::vector<ImuData> imus = std::vector<ImuData>(1);
  /// T_VS of each pose sensor, in the members q_WM and p_WM, stamped by its own clock.
  std::vector<std::vector<PoseSample>> pose_sensors;
};

/// The input or an option is unusable as given: the text names field, value and bound.
class InputError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// The input was read, but no calibration can come from it: the text names the number, the bound
/// and what to do.
class DataError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// The data can be calibrated, but only with another option, which the text names.
class OptionNeeded : public DataError {
 public:
  using DataError::DataError;
};

}  // namespace imu_pose_calib
