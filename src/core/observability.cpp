#include "imu_pose_calib/core/observability.h"

#include <Eigen/Eigenvalues>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <limits>
#include <sstream>

namespace imu_pose_calib {
namespace {

constexpr double kMinTurnRate = 0.01;  // [rad/s] about the second axis
constexpr double kSampleStep = 0.02;   // [s] between the instants at which the motion is judged
constexpr double kDegenerateFactor = 10.0;  // times the weak threshold

const char* const kTurnAdvice = "turn the marker about at least two axes";

/// Sigma of p_MI along each principal direction once the information that the trajectory's errors
/// feign is taken away; infinite when nothing remains.
Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> HonestLeverArm(const CalibrationCovariance& c) {
  const Eigen::Matrix3d information = c.model.topLeftCorner<3, 3>().inverse();
  return Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(
      information - c.feigned_lever_arm_information * Eigen::Matrix3d::Identity());
}

/// Scales the model's covariance so that every sigma is at least the robust one.
CalibrationMatrix Larger(const CalibrationCovariance& c) {
  Eigen::Matrix<double, kCalibrationSize, 1> scale;
  for (int i = 0; i < kCalibrationSize; ++i)
    scale[i] = c.model(i, i) > 0.0 ? std::sqrt(std::max(1.0, c.robust(i, i) / c.model(i, i))) : 1.0;
  return scale.asDiagonal() * c.model * scale.asDiagonal();
}

struct Check {
  const char* what;
  double sigma, threshold, shown_unit;
  const char* unit;
};

std::string Describe(const Check& check, double bound) {
  std::ostringstream text;
  text.precision(3);
  text << "sigma of " << check.what << " is " << check.sigma / check.shown_unit << " " << check.unit
       << " (bound: " << bound / check.shown_unit << " " << check.unit << ")";
  return text.str();
}

}  // namespace

TurnExcitation MeasureTurns(const PoseTrajectory& trajectory, const ConditionedData& data) {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  Eigen::Matrix3d sum2 = Eigen::Matrix3d::Zero();
  double variance = 0.0, count = 0.0;
  for (double t = 0.0; t <= data.poses.back().t; t += kSampleStep) {
    MarkerState<double> state;
    if (!trajectory.Evaluate(t, &state)) continue;
    sum += state.omega_M;
    sum2 += state.omega_M * state.omega_M.transpose();
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

std::string DescribeAxis(const Eigen::Vector3d& axis_M) {
  const Eigen::Vector3d axis = axis_M.normalized();
  int largest = 0;
  if (axis.cwiseAbs().maxCoeff(&largest) > std::cos(20.0 * M_PI / 180.0))
    return std::string("marker ") + "xyz"[largest];
  const double sign = axis[largest] < 0.0 ? -1.0 : 1.0;
  char text[80];
  std::snprintf(text,
                sizeof(text),
                "(%.2f, %.2f, %.2f) in the marker frame",
                sign * axis.x(),
                sign * axis.y(),
                sign * axis.z());
  return text;
}

bool IsMotionDegenerate(const TurnExcitation& turns, Calibration* result) {
  if (turns.rate_std[1] >= kMinTurnRate) return false;
  result->status = Status::kDegenerate;
  std::ostringstream text;
  text.precision(2);
  if (turns.rate_std[0] < kMinTurnRate) {
    result->unobservable = {"R_MI, p_MI and time_shift: " + std::string(kTurnAdvice)};
    text << "the marker does not turn (" << turns.rate_std[0]
         << " rad/s rms, bound: " << kMinTurnRate
         << " rad/s): R_MI, p_MI and time_shift are undetermined; " << kTurnAdvice;
  } else {
    const std::string axis = DescribeAxis(turns.axes_M.col(0));
    result->unobservable = {"p_MI along " + axis + ": turn about a second axis"};
    text << "the marker turns about one axis only, " << axis << " (" << turns.rate_std[0]
         << " rad/s rms; about any other " << turns.rate_std[1] << " rad/s, bound: " << kMinTurnRate
         << " rad/s): p_MI along it is undetermined; " << kTurnAdvice;
  }
  result->message = text.str();
  return true;
}

void GradeResult(const CalibrationOptions& options,
                 const CalibrationCovariance& covariance,
                 Calibration* result) {
  if (!covariance.model.allFinite() || !covariance.robust.allFinite()) {
    result->status = Status::kDegenerate;
    result->message = std::string("the data do not determine all parameters; ") + kTurnAdvice;
    result->unobservable = {result->message};
    return;
  }
  const CalibrationMatrix C = Larger(covariance);
  result->covariance = C.topLeftCorner<6, 6>();
  result->time_shift_std = std::sqrt(C(kTimeShift, kTimeShift));
  result->accel_delay_std = std::sqrt(C(kAccelDelay, kAccelDelay));

  const auto lever_arm = HonestLeverArm(covariance);
  const double degenerate_p = kDegenerateFactor * options.weak_translation_std;
  for (int k = 0; k < 3; ++k) {
    if (lever_arm.eigenvalues()[k] * degenerate_p * degenerate_p >= 1.0) continue;
    result->unobservable.push_back("p_MI along " + DescribeAxis(lever_arm.eigenvectors().col(k)) +
                                   ": turn faster, and about a second axis");
  }
  const Eigen::Vector3d honest = lever_arm.eigenvalues().cwiseMax(1e-12).cwiseInverse().cwiseSqrt();
  const double p_std = std::max(result->Std().head<3>().maxCoeff(), honest.maxCoeff());
  const Check checks[] = {
      {"p_MI", p_std, options.weak_translation_std, 1e-3, "mm"},
      {"R_MI", result->Std().tail<3>().maxCoeff(), options.weak_rotation_std, M_PI / 180.0, "deg"},
      {"time_shift", result->time_shift_std, options.weak_time_shift_std, 1e-3, "ms"}};

  result->status = Status::kOk;
  result->message = "every sigma is within its bound";
  for (const Check& check : checks) {
    if (check.sigma <= check.threshold) continue;
    const bool degenerate = check.sigma > kDegenerateFactor * check.threshold;
    const Status status = degenerate ? Status::kDegenerate : Status::kWeak;
    if (status == result->status || result->status == Status::kDegenerate) continue;
    result->status = status;
    const double bound = (degenerate ? kDegenerateFactor : 1.0) * check.threshold;
    result->message = Describe(check, bound) + "; record longer, and turn faster about all axes";
  }
  if (result->unobservable.empty()) return;
  result->status = Status::kDegenerate;
  result->message = "the motion does not determine " + result->unobservable.front();
}

}  // namespace imu_pose_calib
