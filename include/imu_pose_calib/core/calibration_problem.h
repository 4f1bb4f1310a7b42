#pragma once

#include <ceres/problem.h>

#include <vector>

#include "imu_pose_calib/core/calibrator.h"
#include "imu_pose_calib/core/conditioning.h"
#include "imu_pose_calib/core/estimate.h"
#include "imu_pose_calib/core/options.h"
#include "imu_pose_calib/core/pose_trajectory.h"

namespace imu_pose_calib {

/// What the residuals say after a solve.
struct ResidualStatistics {
  NoiseStd noise;  ///< robust spread per axis, less what the trajectory's own variance explains
  NoiseStd rms;    ///< per axis, of all samples used
};

/// Marginal uncertainty of (p_MI [m] in M, rotation [rad] about the imu axes, time_shift [s],
/// accel_delay [s]); a fixed accel_delay has variance 0.
using Matrix8d = Eigen::Matrix<double, 8, 8>;
struct CalibrationCovariance {
  Matrix8d model;   ///< H^-1: right when residuals are independent
  Matrix8d robust;  ///< H^-1 (sum_w g_w g_w^T) H^-1 over time blocks: right when they are not
  /// Information on p_MI [1/m^2] that the trajectory's own errors feign: they move the lever arm's
  /// coefficients as a motion would.
  double feigned_lever_arm_information;
};

/// What comes out of a solve beside the estimate.
struct Solution {
  ResidualStatistics statistics;
  CalibrationCovariance covariance;
};

/// Noise per sample to start from. Poses: as the GP's likelihood says. IMU: from the options'
/// densities, sigma = density sqrt(rate).
NoiseStd InitialNoise(const CalibrationOptions& options,
                      const PoseTrajectory& trajectory,
                      const ConditionedData& data);

/// Tolerance of the passes of a solve after which noise or weights still change.
constexpr double kRoughTolerance = 1e-3;

/// Expected squared norm of the error of ([alpha]x + [omega]x [omega]x) e for a unit vector e, when
/// alpha and omega have the given variances per axis: what a lever arm makes of their errors.
inline double LeverArmCoefficientVariance(double alpha_variance,
                                          double omega_variance,
                                          double omega2) {
  return 2.0 * alpha_variance + 4.0 * omega_variance * omega2;
}

/// What the two solves, against a fixed trajectory and jointly with it, have in common. All
/// residual blocks are 3-vectors in sigma.
class CalibrationProblem {
 public:
  /// Throws DataError when Ceres does not converge to a relative change of the cost below
  /// `function_tolerance`.
  void Solve(double function_tolerance);
  ResidualStatistics Statistics();
  CalibrationCovariance Covariance();

 protected:
  /// One residual block of a sensor.
  struct Term {
    ceres::ResidualBlockId id;
    size_t sample;                     ///< index in the data
    double t;                          ///< [s] IMU clock
    double sigma;                      ///< residual * sigma has the sensor's unit
    double trajectory_variance = 0.0;  ///< share of sigma^2
  };

  /// Refers to everything it is given; Solve() moves `estimate`.
  CalibrationProblem(const CalibrationOptions& options,
                     const PoseTrajectory& trajectory,
                     const ConditionedData& data,
                     const NoiseStd& noise,
                     Estimate* estimate);

  /// Parameter blocks of both sensors with their manifolds.
  void AddRotation();
  void AddGravityAndDelay();
  void AddBiasWalk(double walk, BiasKnots* knots);
  /// The sample can be compared: t_M [s, pose clock] is inside of a segment and not at its very
  /// end.
  bool IsOnTrajectory(double t_M) const;

  const CalibrationOptions& options_;
  const PoseTrajectory& trajectory_;
  const ConditionedData& data_;
  const NoiseStd noise_;
  Estimate* const estimate_;

  ceres::Problem problem_;
  std::vector<Term> position_terms_, rotation_terms_, gyro_terms_, accel_terms_, walk_terms_;
  std::vector<double*> trajectory_blocks_;  ///< parameters of the trajectory, if it is estimated
  double feigned_information_ = 0.0;
};

}  // namespace imu_pose_calib
