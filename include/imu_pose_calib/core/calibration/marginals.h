#pragma once

#include <Eigen/Core>
#include <future>
#include <memory>
#include <vector>

#include "imu_pose_calib/core/calibration/least_squares.h"

namespace imu_pose_calib {

/// A parameter and the place of its first component in the vectors and matrices of Marginals.
struct PlacedParameter {
  Parameter parameter;
  int place;
};

/// What a session says alone of the parameters that act in it.
struct SessionMarginals {
  std::vector<int> places;         ///< in Marginals
  Eigen::VectorXd difference;      ///< its own estimate less the common one
  Eigen::VectorXd model_variance;  ///< of its own estimate
  Eigen::MatrixXd covariance;      ///< the same, enlarged by Enlargement()
};

/// Marginal uncertainty of calibration, gravity and biases after a solve.
struct Marginals {
  std::vector<PlacedParameter> parameters;
  Eigen::MatrixXd model;   ///< H^-1: right when residuals are independent
  Eigen::MatrixXd robust;  ///< sandwich over time blocks: right when they are not

  /// What the second halves of the sessions say less what the first halves say, and the largest of
  /// these differences in sigma.
  Eigen::VectorXd halves_difference;
  double halves_sigmas = 0.0;

  std::vector<SessionMarginals> sessions;  ///< none when there is only one

  /// Of H: what is calibrated, gravity of each session, then of each session
  /// the bias knots, gyroscope and accelerometer of each IMU, knots of the clocks, then of each
  /// session those of the slow errors, and the control points.
  std::shared_ptr<const Elimination> elimination;
  /// Elements of H^-1 where its factor has any, found when they are asked for. Not valid when that
  /// would take more than CalibrationOptions::max_factor_mb, and when the trajectory is not
  /// determined.
  std::shared_future<Panels> inverse;

  int calibrated_end = 0;    ///< column of H after what is calibrated
  int trajectory_begin = 0;  ///< first column of H of the control points

  /// Place of a parameter, for what is calibrated the column of H, too; -1 when there is none.
  int Find(ParameterKind kind, size_t imu = 0, size_t session = 0) const;
};

/// Stage S5 where a solve has ended, doc/math.md, "Covariance" and "What one more step tells".
Marginals FindMarginals(LeastSquares* solved);

/// By how much the robust sigma exceeds the model's, at least 1: factors of rows and columns of the
/// covariance that is reported.
Eigen::VectorXd Enlargement(const Eigen::MatrixXd& model, const Eigen::MatrixXd& robust);

}  // namespace imu_pose_calib
