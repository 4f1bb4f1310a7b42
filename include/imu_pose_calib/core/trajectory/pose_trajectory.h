#pragma once

/// Room core/trajectory: a continuous trajectory through the poses alone (S1).
/// In: ConditionedData. Out: PoseTrajectory, a Gaussian process of position and rotation of each
/// segment with its derivatives and variance; outliers leave the data and are counted.
/// Knows nothing of IMUs.

#include <ceres/jet.h>

#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/core/trajectory/gaussian_process.h"

namespace imu_pose_calib {

/// How the marker turns at one instant.
template <typename T>
struct MarkerRotation {
  Eigen::Quaternion<T> q_WM;
  Eigen::Matrix<T, 3, 1> omega_M;  ///< [rad/s]
  Eigen::Matrix<T, 3, 1> alpha_M;  ///< [rad/s^2]
};

/// Motion of the marker at one instant.
template <typename T>
struct MarkerState : MarkerRotation<T> {
  Eigen::Matrix<T, 3, 1> p_WM;  ///< [m]
  Eigen::Matrix<T, 3, 1> v_W;   ///< [m/s]
  Eigen::Matrix<T, 3, 1> a_W;   ///< [m/s^2]
};

/// f_M [m/s^2] at p_MI of doc/math.md Eq. (2), in M: what an accelerometer there feels.
template <typename T>
Eigen::Matrix<T, 3, 1> SpecificForce(const MarkerState<T>& state, const Eigen::Matrix<T, 3, 1>& g_W,
                                     const Eigen::Matrix<T, 3, 1>& p_MI) {
  return state.q_WM.conjugate() * (state.a_W - g_W) + state.alpha_M.cross(p_MI) +
         state.omega_M.cross(state.omega_M.cross(p_MI));
}

/// Posterior variance per axis of the marker's motion at one instant.
struct MarkerVariance {
  double position;  ///< [m^2]
  double rotation;  ///< [rad^2]
  double omega;     ///< [(rad/s)^2]
  double alpha;     ///< [(rad/s^2)^2]
  double accel;     ///< [(m/s^2)^2]
};

/// Continuous trajectory of the marker: one GP over the position, one over the quaternion's four
/// components, whose posterior mean is projected on the unit sphere (doc/math.md, "Trajectory").
/// The quaternion needs no chart, so any number of turns is fine.
class PoseTrajectory {
 public:
  /// Hyperparameters in [m] and, for rotation, in [rad]. There are variances only `with_variance`.
  /// Segments that overlap meet in the middle.
  PoseTrajectory(const std::vector<TimedPose>& poses, const std::vector<IndexRange>& segments,
                 const GpHyperparameters& position, const GpHyperparameters& rotation,
                 int threads = 1, bool with_variance = true);

  const GpHyperparameters& position_hyperparameters() const { return position_; }
  const GpHyperparameters& rotation_hyperparameters() const { return rotation_; }

  /// True when t [s] lies between two poses without a gap.
  bool Contains(double t) const { return Find(t) != nullptr; }
  /// The same of all instants from `begin` to `end` [s].
  bool Covers(double begin, double end) const;

  double End() const { return segments_.back().end; }  ///< last instant [s]

  /// Posterior mean of the motion at t [s] and, unless null, its time derivative (of q_WM: of its
  /// coefficients). False when t is not contained.
  bool Evaluate(double t, MarkerState<double>* state, MarkerState<double>* rate = nullptr) const;

  /// Evaluate() without the positions, at half the cost.
  bool EvaluateRotation(double t, MarkerRotation<double>* rotation) const;

  /// Evaluate() with the exact derivative by t: Jets in, Jets out.
  template <typename Scalar, int N>
  bool Evaluate(const ceres::Jet<Scalar, N>& t, MarkerState<ceres::Jet<Scalar, N>>* state) const;

  /// Posterior variance of the motion at t [s]; t must be contained.
  MarkerVariance Variance(double t) const;

  /// Smoothed T_WM at t [s]; t must be contained.
  Rigid3 PoseAt(double t) const { return {RotationAt(t), PositionAt(t)}; }
  /// Either part of it, at half the cost.
  Eigen::Vector3d PositionAt(double t) const;
  Eigen::Quaterniond RotationAt(double t) const;

 private:
  struct Segment {
    double begin, end;  ///< [s]
    GaussianProcess position, quaternion;
  };
  const Segment* Find(double t) const;

  GpHyperparameters position_, rotation_;
  Eigen::Vector3d origin_W_ = Eigen::Vector3d::Zero();  ///< mean position, prior mean of the GP
  std::vector<Segment> segments_;
};

/// Stage S1: hyperparameters from the marginal likelihood where the options leave them open,
/// trajectory, and removal of gross outliers by their leave-one-out residuals: outliers leave
/// data->poses and are counted.
PoseTrajectory FitTrajectory(const CalibrationOptions& options, ConditionedData* data);

// --- Implementation ---

template <typename Scalar, int N>
bool PoseTrajectory::Evaluate(const ceres::Jet<Scalar, N>& t,
                              MarkerState<ceres::Jet<Scalar, N>>* state) const {
  MarkerState<double> value, rate;
  if (!Evaluate(t.a, &value, &rate)) return false;
  const auto chain = [&t](const auto& x, const auto& dx_dt, auto* out) {
    for (int i = 0; i < static_cast<int>(x.size()); ++i) {
      (*out)[i].a = x[i];
      (*out)[i].v = dx_dt[i] * t.v;
    }
  };
  chain(value.q_WM.coeffs(), rate.q_WM.coeffs(), &state->q_WM.coeffs());
  chain(value.omega_M, rate.omega_M, &state->omega_M);
  chain(value.alpha_M, rate.alpha_M, &state->alpha_M);
  chain(value.p_WM, rate.p_WM, &state->p_WM);
  chain(value.v_W, rate.v_W, &state->v_W);
  chain(value.a_W, rate.a_W, &state->a_W);
  return true;
}

}  // namespace imu_pose_calib
