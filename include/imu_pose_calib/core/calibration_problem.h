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

/// Place of the calibration parameters in CalibrationCovariance.
enum CalibrationIndex {
  kTranslation = 0,      ///< p_MI [m] in M
  kRotation = 3,         ///< [rad] about the imu axes, R_MI Exp(dtheta)
  kTimeShift = 6,        ///< [s]
  kAccelDelay = 7,       ///< [s]
  kClockDrift = 8,       ///< [s/s]
  kPoseSmoothing = 9,    ///< [s^2]
  kGyroIntrinsics = 10,  ///< 6, of GyroMatrix()
  kAccelIntrinsics = 16  ///< 9, of AccelMatrix()
};
constexpr int kCalibrationSize = 25;
using CalibrationVector = Eigen::Matrix<double, kCalibrationSize, 1>;
using CalibrationMatrix = Eigen::Matrix<double, kCalibrationSize, kCalibrationSize>;

/// Marginal uncertainty of the calibration; parameters that are not estimated have variance 0.
struct CalibrationCovariance {
  CalibrationMatrix model;   ///< H^-1: right when residuals are independent
  CalibrationMatrix robust;  ///< sandwich over time blocks: right when they are not
  /// The Gauss-Newton step that remains.
  CalibrationVector step = CalibrationVector::Zero();
  /// Information on p_MI [1/m^2] that the trajectory's own errors feign: they move the lever arm's
  /// coefficients as a motion would.
  double feigned_lever_arm_information = 0.0;

  /// What the second half of the log says less what the first half says, and the largest of these
  /// differences in sigma.
  CalibrationVector halves_difference = CalibrationVector::Zero();
  double halves_sigmas = 0.0;

  /// Clock drift and intrinsics, when they are not estimated: where they would move if they were,
  /// and the sigma of that; else 0.
  CalibrationVector hint = CalibrationVector::Zero();
  CalibrationVector hint_std = CalibrationVector::Zero();
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

/// What the two solves, against a fixed trajectory and jointly with it, have in common. Residual
/// blocks of sensors have three rows in sigma for each of their samples.
class CalibrationProblem {
 public:
  virtual ~CalibrationProblem() = default;

  /// Throws DataError when Ceres does not converge to a relative change of the cost below
  /// `function_tolerance`.
  void Solve(double function_tolerance);
  ResidualStatistics Statistics();
  CalibrationCovariance Covariance();

 protected:
  struct Sample {
    size_t index;                      ///< in the data
    double t;                          ///< [s] IMU clock
    double sigma;                      ///< residual * sigma has the sensor's unit
    double trajectory_variance = 0.0;  ///< share of sigma^2
    double scale = 1.0;                ///< noise relative to the usual sample's
  };
  /// Residual blocks of a sensor. Their rows, one after the other, are those of `samples`.
  struct Sensor {
    std::vector<ceres::ResidualBlockId> blocks;
    std::vector<double> block_t;  ///< [s] IMU clock, of each block's first sample
    std::vector<Sample> samples;
    /// Of each sample, in the sensor's unit and over its scale, as of the last Statistics().
    std::vector<Eigen::Vector3d> residuals;

    void Add(ceres::ResidualBlockId block, const std::vector<Sample>& block_samples);
  };

  /// Refers to everything it is given; Solve() moves `estimate`.
  CalibrationProblem(const CalibrationOptions& options,
                     const PoseTrajectory& trajectory,
                     const ConditionedData& data,
                     const NoiseStd& noise,
                     Estimate* estimate);

  /// Parameter blocks of a sensor with their manifolds, constant where the options fix them.
  void AddGyroParameters();
  void AddAccelParameters();
  void AddBiasWalk(double walk, BiasKnots* knots);
  /// Parameters that are estimated only with `estimated`, then with independent priors around 0.
  void AddOptional(bool estimated, double sigma, int size, double* parameters);
  void SetConstantUnless(bool estimated, double* parameters);
  /// The sample can be compared: t_M [s, pose clock] is inside of a segment and not at its very
  /// end.
  bool IsOnTrajectory(double t_M) const;
  /// Share of each sensor's degrees of freedom that the trajectory uses up by following it [0..1].
  virtual NoiseStd FittedShare() const { return {}; }
  /// See CalibrationCovariance.
  virtual double FeignedLeverArmInformation() const = 0;

  const CalibrationOptions& options_;
  const PoseTrajectory& trajectory_;
  const ConditionedData& data_;
  const NoiseStd noise_;
  Estimate* const estimate_;

  ceres::Problem problem_;
  Sensor position_, rotation_, gyro_, accel_;
  Sensor priors_;                           ///< bias walks and priors; no samples
  std::vector<double*> trajectory_blocks_;  ///< parameters of the trajectory, if it is estimated
};

}  // namespace imu_pose_calib
