#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <functional>
#include <vector>

#include "imu_pose_calib/simulation/simulator_options.h"

namespace imu_pose_calib {

/// Exact kinematics of the marker at one instant.
struct TrueState {
  Eigen::Matrix3d R_WM;
  Eigen::Vector3d p_WM;     ///< [m]
  Eigen::Vector3d v_W;      ///< [m/s]
  Eigen::Vector3d a_W;      ///< [m/s^2]
  Eigen::Vector3d omega_M;  ///< [rad/s]
  Eigen::Vector3d alpha_M;  ///< [rad/s^2]
};

/// Closed-form trajectory: a smooth motion, and what shakes the body on top of it.
class TrueTrajectory {
 public:
  explicit TrueTrajectory(const SimulatorOptions& options);
  /// State `t` [s] after the first pose.
  TrueState At(double t) const;

 private:
  /// Vector over time [s]: its value (0), first (1) or second (2) derivative.
  using Curve = std::function<Eigen::Vector3d(double t, int derivative)>;
  /// On top of a motion: M turns by Exp(turn) about a point of the body, then moves by `shift`.
  struct Shake {
    Curve shift_W, turn_M;
    Eigen::Vector3d pivot_M;
  };
  void AddShakes(const SimulatorOptions& options);

  Curve position_, rotation_;
  Eigen::Quaterniond q_WB_ = Eigen::Quaterniond::Identity();  ///< mean attitude
  Eigen::Vector3d spin_ = Eigen::Vector3d::Zero();            ///< [rad/s] steady turn
  std::vector<Shake> shakes_;
};

}  // namespace imu_pose_calib
