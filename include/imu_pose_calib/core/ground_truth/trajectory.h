#pragma once

/// Room core/ground_truth: where the IMU was.
/// In: a Solution. Out: pose, velocity, rates and biases of an IMU at any time with sigmas; gaps of
/// the poses are bridged by the IMU. Changes no estimate.

#include <map>
#include <memory>
#include <optional>
#include <vector>

#include "imu_pose_calib/core/calibration/solution.h"

namespace imu_pose_calib {

/// Covariance of parameters that act at one instant, from the normal equations of a joint solve;
/// what is held is without error.
class TrajectoryCovariance {
 public:
  /// Throws InputError when there is none.
  explicit TrajectoryCovariance(const std::shared_ptr<const Solution>& solution);

  /// Columns of the parameters, one for each degree of freedom; -1 for what is held.
  using Columns = std::vector<int>;
  /// The kSplineOrder control points of d from `first` on, then those of phi.
  Columns ControlPoints(size_t session, size_t first) const;
  /// What is calibrated, `size` degrees of freedom. q_MI turns on the left by twice the step.
  Columns Calibrated(ParameterKind kind, size_t imu, int size) const;
  /// time_shift and clock_drift, and the knots of the clock's walk around t [s, IMU clock]: 4.
  Columns Clock(size_t session, size_t imu, double t) const;
  Columns Gravity(size_t session) const;
  /// The bias knots `knot` and `knot` + 1 of one sensor.
  Columns BiasKnotPair(size_t session, size_t imu, bool is_accel, size_t knot) const;

  /// Covariance of parameters that share a residual, and at the ends of runs of all that act there:
  /// control points, the bias knots around them and what is calibrated. Of others it has zeros.
  Eigen::MatrixXd At(const Columns& columns) const;
  /// Covariance of what has that derivative by the parameters of all parts, in order.
  Eigen::MatrixXd Of(const Eigen::MatrixXd& J, const std::vector<Columns>& parts) const;

 private:
  Columns Kept(int first, int count) const;

  std::shared_ptr<const Solution> solution_;
  std::map<const void*, int> first_;  ///< columns, by where the first value is in the solution
};

/// Motion of a body B at one instant: of the marker or of an IMU.
template <typename T>
struct BodyStateOf {
  Eigen::Quaternion<T> q_WB;
  Eigen::Matrix<T, 3, 1> p_WB;     ///< [m]
  Eigen::Matrix<T, 3, 1> omega_B;  ///< [rad/s]
  Eigen::Matrix<T, 3, 1> v_W;      ///< [m/s]
  Eigen::Matrix<T, 3, 1> alpha_B;  ///< [rad/s^2]
  Eigen::Matrix<T, 3, 1> a_W;      ///< [m/s^2]
};
using BodyState = BodyStateOf<double>;

/// Covariance of the rotation [rad, about the axes of B: R_WB Exp(dtheta)] and of the other members
/// of BodyState, in their order, 3 each.
using BodyCovariance = Eigen::Matrix<double, 18, 18>;

/// Biases of an IMU at one instant, in I: measured = M true + bias.
struct ImuBiases {
  Eigen::Vector3d gyro = Eigen::Vector3d::Zero();   ///< [rad/s]
  Eigen::Vector3d accel = Eigen::Vector3d::Zero();  ///< [m/s^2]
};

/// The trajectory of one session as solved: with method `joint` by all sensors together, with `gp`
/// that of S1. Not for several threads at a time.
class SessionTrajectory {
 public:
  SessionTrajectory(const std::shared_ptr<const Solution>& solution, size_t session)
      : solution_(solution), session_(session) {}

  /// Stamp [ns, pose clock] at which t = 0.
  int64_t epoch_ns() const { return solution_->pose_epochs_ns[session_]; }

  /// Derivative of BodyState, in the order of BodyCovariance, by the coordinates of the control
  /// points of d and phi that act at t, p_MB, and the rotation of R_MB on the left by twice a step.
  using StateJacobian = Eigen::Matrix<double, 18, 6 * kSplineOrder + 6>;
  /// Motion of a frame on the body at t [s], and its derivative unless `J` is null; nothing where
  /// poses or IMUs have a gap.
  std::optional<BodyState> Body(const Rigid3& T_MB, double t, StateJacobian* J = nullptr) const;
  std::optional<BodyState> Marker(double t) const { return Body({}, t); }
  std::optional<BodyState> Imu(size_t imu, double t, StateJacobian* J = nullptr) const;
  /// Where the clock of the IMU shows the time that goes with t; the session must have that IMU.
  ImuBiases Biases(size_t imu, double t) const;

  /// By the model's noise, calibration included; nothing where there is no motion, and with method
  /// `gp`. `T_MB`: of a frame whose place is known.
  std::optional<BodyCovariance> MarkerCovariance(double t, const Rigid3& T_MB = {}) const;
  /// `is_on_its_clock`: where the clock of the IMU shows the time that goes with t, and errors of
  /// the clock count too, except in accelerations.
  std::optional<BodyCovariance> ImuCovariance(size_t imu, double t,
                                              bool is_on_its_clock = false) const;
  /// Variance of the instant t that goes with a time on the clock of the IMU [s^2]; 0 with `gp`.
  double ClockVariance(size_t imu, double t) const;
  /// Of gyroscope and accelerometer, 3 each, also where the motion has a gap.
  std::optional<Matrix6d> BiasCovariance(size_t imu, double t) const;
  /// Null with method `gp`. Throws InputError when the solution has none.
  const TrajectoryCovariance* covariance() const;

 private:
  std::shared_ptr<const Solution> solution_;
  size_t session_;
  mutable std::optional<TrajectoryCovariance> covariance_;
};

}  // namespace imu_pose_calib
