#pragma once

#include <ceres/problem.h>

#include <vector>

#include "imu_pose_calib/core/conditioning.h"
#include "imu_pose_calib/core/initializer.h"
#include "imu_pose_calib/core/options.h"
#include "imu_pose_calib/core/pose_trajectory.h"

namespace imu_pose_calib {

/// A bias that changes linearly between knots.
struct BiasKnots {
  std::vector<double> t;                ///< [s] IMU clock, increasing, at least two
  std::vector<Eigen::Vector3d> values;  ///< in I

  /// Knots every `interval_s` over the samples, or one at every sample when 0.
  BiasKnots(const std::vector<TimedSample>& samples,
            double interval_s,
            const Eigen::Vector3d& initial);

  /// Index of the knot before t (not the last one) and the fraction of the way to the next.
  std::pair<size_t, double> Locate(double t) const;
  Eigen::Vector3d Mean() const;
};

/// State of the solve; times as in Start.
struct Estimate {
  double time_shift, accel_delay;
  Eigen::Quaterniond q_MI;
  Eigen::Vector3d p_MI, g_W;
  BiasKnots gyro_bias, accel_bias;

  Estimate(const Start& start, const ConditionedData& data, double bias_knot_interval_s);
};

/// White noise per sample: gyroscope [rad/s], accelerometer [m/s^2].
struct ImuNoise {
  double gyro, accel;
};

/// What the residuals say after a solve.
struct ResidualStatistics {
  ImuNoise noise;  ///< robust spread less the trajectory's own variance
  ImuNoise rms;    ///< per axis, of all samples used
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

/// Stage S3: the calibration against a fixed trajectory. Gyroscope alone first (rotation, gyro
/// bias, time shift), then both sensors.
class GpProblem {
 public:
  enum class Sensors { kGyro, kGyroAndAccel };

  /// Refers to everything it is given; `estimate` is moved by Solve().
  GpProblem(const CalibrationOptions& options,
            const PoseTrajectory& trajectory,
            const ConditionedData& data,
            Sensors sensors,
            const ImuNoise& noise,
            Estimate* estimate);

  /// Throws DataError when Ceres does not converge.
  void Solve();
  ResidualStatistics Statistics();
  CalibrationCovariance Covariance();

 private:
  struct Term {
    ceres::ResidualBlockId id;
    double t;                    ///< [s] IMU clock
    double sigma;                ///< residual * sigma has the sensor's unit
    double trajectory_variance;  ///< share of sigma^2
  };
  void AddGyro();
  void AddAccel();
  void AddBiasWalk(double walk, BiasKnots* knots);
  ceres::LossFunction* Loss() const;

  const CalibrationOptions& options_;
  const PoseTrajectory& trajectory_;
  const ConditionedData& data_;
  const ImuNoise noise_;
  Estimate* const estimate_;
  ceres::Problem problem_;
  std::vector<Term> gyro_terms_, accel_terms_, walk_terms_;
  double feigned_information_ = 0.0;
};

}  // namespace imu_pose_calib
