#include "imu_pose_calib/core/start/excitation.h"

#include <Eigen/Eigenvalues>
#include <cmath>

#include "imu_pose_calib/core/base/text.h"

namespace imu_pose_calib {
namespace {

constexpr double kMinTurnRate = 0.01;  // [rad/s] about the second axis
constexpr double kSampleStep = 0.02;   // [s] between the instants at which the motion is judged

}  // namespace

std::string DescribeAxis(const Eigen::Vector3d& direction, const std::string& frame) {
  const Eigen::Vector3d axis = direction.normalized();
  int largest = 0;
  if (axis.cwiseAbs().maxCoeff(&largest) > std::cos(20.0 * M_PI / 180.0))
    return frame + " " + "xyz"[largest];
  const double sign = axis[largest] < 0.0 ? -1.0 : 1.0;
  return "(" + Number(sign * axis.x(), "%.2f") + ", " + Number(sign * axis.y(), "%.2f") + ", " +
         Number(sign * axis.z(), "%.2f") + ") in the " + frame + " frame";
}

TurnExcitation MeasureTurns(const PoseTrajectory& trajectory, const ConditionedData& data) {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  Eigen::Matrix3d sum2 = Eigen::Matrix3d::Zero();
  double variance = 0.0, count = 0.0;
  for (double t = 0.0; t <= data.poses.back().t; t += kSampleStep) {
    MarkerRotation<double> marker;
    if (!trajectory.EvaluateRotation(t, &marker)) continue;
    sum += marker.omega_M;
    sum2 += marker.omega_M * marker.omega_M.transpose();
    variance += trajectory.Variance(t).omega;
    count += 1.0;
  }
  const Eigen::Vector3d mean = sum / count;
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(
      Eigen::Matrix3d(sum2 / count - mean * mean.transpose()));
  const double noise = variance / count;
  TurnExcitation turns;
  for (int k = 0; k < 3; ++k) {
    const double excess = eigen.eigenvalues()[2 - k] - noise;
    turns.rate_std[k] = excess > 0.5 * noise ? std::sqrt(excess) : 0.0;
    turns.axes_M.col(k) = eigen.eigenvectors().col(2 - k);
  }
  return turns;
}

void CheckTurns(const TurnExcitation& turns) {
  if (turns.rate_std[1] >= kMinTurnRate) return;
  const auto rate = [](double value) { return Number(value, "%.2g rad/s"); };
  const std::string largest = rate(turns.rate_std[0]) + " rms", bound = rate(kMinTurnRate);
  if (turns.rate_std[0] < kMinTurnRate)
    throw DegenerateMotion("the marker does not turn (" + largest + ", bound: " + bound +
                               "): R_MI, p_MI and time_shift are undetermined; " + kTurnAdvice,
                           std::string("R_MI, p_MI and time_shift: ") + kTurnAdvice);
  const std::string axis = DescribeAxis(turns.axes_M.col(0), "marker");
  throw DegenerateMotion("the marker turns about one axis only, " + axis + " (" + largest +
                             "; about any other " + rate(turns.rate_std[1]) + ", bound: " + bound +
                             "): p_MI along it is undetermined; " + kTurnAdvice,
                         "p_MI along " + axis + ": turn about a second axis");
}

}  // namespace imu_pose_calib
