#pragma once

#include <memory>
#include <optional>

#include "imu_pose_calib/core/solution.h"

namespace imu_pose_calib {

/// Motion of a body B at one instant: of the marker or of an IMU.
struct BodyState {
  Eigen::Quaterniond q_WB;
  Eigen::Vector3d p_WB;     ///< [m]
  Eigen::Vector3d omega_B;  ///< [rad/s]
  Eigen::Vector3d v_W;      ///< [m/s]
  Eigen::Vector3d alpha_B;  ///< [rad/s^2]
  Eigen::Vector3d a_W;      ///< [m/s^2]
};

/// Covariance of the rotation [rad, about the axes of B: R_WB Exp(dtheta)] and of the other members
/// of BodyState, in their order, 3 each.
using BodyCovariance = Eigen::Matrix<double, 18, 18>;

/// The trajectory of one session as solved: with method `joint` by all sensors together, with `gp`
/// that of S1.
class SessionTrajectory {
 public:
  SessionTrajectory(const std::shared_ptr<const Solution>& solution, size_t session);

  /// Stamp [ns, pose clock] at which t = 0.
  int64_t epoch_ns() const;

  /// Motion at t [s]; nothing where poses or IMUs have a gap.
  std::optional<BodyState> Marker(double t) const;
  std::optional<BodyState> Imu(size_t imu, double t) const;

  /// By the model's noise, calibration included; nothing where there is no motion, and with method
  /// `gp`. The first call takes about as long as a pass of the solve.
  std::optional<BodyCovariance> MarkerCovariance(double t) const;
  std::optional<BodyCovariance> ImuCovariance(size_t imu, double t) const;

 private:
  class Uncertainty;
  std::optional<BodyState> Evaluate(const Rigid3& T_MB,
                                    double t,
                                    Eigen::Matrix<double, 18, 30>* J) const;
  std::optional<BodyCovariance> Covariance(const Rigid3& T_MB, int imu, double t) const;

  std::shared_ptr<const Solution> solution_;
  size_t session_;
  mutable std::shared_ptr<const Uncertainty> uncertainty_;
};

}  // namespace imu_pose_calib
