#pragma once

#include <gtest/gtest.h>

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <cmath>
#include <random>
#include <string>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/simulation/simulator.h"

/// What several of the core tests need.
namespace imu_pose_calib {

/// Jacobian of f: vector -> vector at x by five-point differences, exact to O(step^4).
template <typename F>
Eigen::MatrixXd NumericJacobian(const F& f, const Eigen::VectorXd& x, double step) {
  Eigen::MatrixXd J;
  for (Eigen::Index i = 0; i < x.size(); ++i) {
    const auto at = [&](double steps) {
      Eigen::VectorXd moved = x;
      moved[i] += steps * step;
      return Eigen::VectorXd(f(moved));
    };
    const Eigen::VectorXd slope =
        (8.0 * (at(1.0) - at(-1.0)) - (at(2.0) - at(-2.0))) / (12.0 * step);
    J.conservativeResize(slope.size(), x.size());
    J.col(i) = slope;
  }
  return J;
}

/// Time derivative of f: double -> matrix or vector at t, as a column of its coefficients.
template <typename F>
Eigen::VectorXd NumericRate(const F& f, double t, double step) {
  const auto flat = [&f](const Eigen::VectorXd& x) {
    const auto y = f(x[0]).eval();
    return Eigen::VectorXd(Eigen::Map<const Eigen::VectorXd>(y.data(), y.size()));
  };
  return NumericJacobian(flat, Eigen::VectorXd::Constant(1, t), step);
}

/// Direction with uniform distribution.
inline Eigen::Vector3d RandomAxis(std::mt19937* random) {
  std::normal_distribution<double> normal;
  Eigen::Vector3d v;
  for (int i = 0; i < 3; ++i) v[i] = normal(*random);
  return v.normalized();
}

/// What `call` throws as an `Error`; a failure of the test when it does not.
template <typename Error, typename Call>
std::string ErrorText(const Call& call) {
  try {
    call();
  } catch (const Error& error) {
    return error.what();
  } catch (const std::exception& other) {
    ADD_FAILURE() << "another exception: " << other.what();
    return "";
  }
  ADD_FAILURE() << "nothing was thrown";
  return "";
}

/// For EXPECT_TRUE: says what is missing in which text.
inline ::testing::AssertionResult Contains(const std::string& text, const std::string& part) {
  if (text.find(part) != std::string::npos) return ::testing::AssertionSuccess();
  return ::testing::AssertionFailure() << "'" << part << "' is missing in: " << text;
}

/// Sensors without noise and biases; poses too good to be of influence.
inline SimulatorOptions WithoutNoise(SimulatorOptions options) {
  options.position_std = 1e-7;
  options.rotation_std = 1e-7;
  options.gyro_std = options.accel_std = 0.0;
  options.gyro_bias_walk = options.accel_bias_walk = 0.0;
  options.gyro_bias.setZero();
  options.accel_bias.setZero();
  return options;
}

}  // namespace imu_pose_calib
