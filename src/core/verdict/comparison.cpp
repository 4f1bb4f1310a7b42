#include "imu_pose_calib/core/verdict/comparison.h"

#include <algorithm>
#include <cmath>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/so3.h"

namespace imu_pose_calib {
namespace {

/// A quantity of one calibration less a reference point, with its covariance. Rotations are those
/// from the reference's axes, in which their covariance is, too.
struct Value {
  Eigen::VectorXd x;
  Eigen::MatrixXd covariance;

  bool IsEstimated() const {
    return covariance.allFinite() && IsPositiveDefinite(covariance) &&
           covariance.diagonal().minCoeff() > 0.0;
  }
};

Value Scalar(double value, double std_dev) {
  return {Eigen::VectorXd::Constant(1, value), Eigen::MatrixXd::Constant(1, 1, std_dev * std_dev)};
}

Value Get(const Comparable& calibration, const Comparable& reference, ComparedQuantity quantity) {
  if (quantity == ComparedQuantity::kTranslation)
    return {calibration.T_MI.p - reference.T_MI.p, calibration.covariance.topLeftCorner<3, 3>()};
  if (quantity == ComparedQuantity::kAccelDelay)
    return Scalar(calibration.accel_delay - reference.accel_delay, calibration.accel_delay_std);
  if (quantity == ComparedQuantity::kTimeShift)
    return Scalar(calibration.time_shift - reference.time_shift, calibration.time_shift_std);
  const Eigen::Quaterniond q = reference.T_MI.q.conjugate() * calibration.T_MI.q;
  const Eigen::Matrix3d R = q.toRotationMatrix();
  return {Log(q), R * calibration.covariance.bottomRightCorner<3, 3>() * R.transpose()};
}

/// The values of all calibrations of one quantity.
std::vector<Value> GetAll(const std::vector<Comparable>& calibrations, const Comparable& reference,
                          ComparedQuantity quantity) {
  std::vector<Value> values;
  for (const Comparable& calibration : calibrations)
    values.push_back(Get(calibration, reference, quantity));
  return values;
}

bool AreEstimated(const std::vector<Value>& values) {
  return std::all_of(values.begin(), values.end(),
                     [](const Value& value) { return value.IsEstimated(); });
}

Value MeanOf(const std::vector<Value>& values) {
  const Eigen::Index size = values.front().x.size();
  Eigen::VectorXd sum = Eigen::VectorXd::Zero(size);
  Eigen::MatrixXd information = Eigen::MatrixXd::Zero(size, size);
  const bool is_weighted = AreEstimated(values);
  for (const Value& value : values) {
    const Eigen::MatrixXd weight =
        is_weighted ? Inverse(value.covariance) : Eigen::MatrixXd::Identity(size, size);
    information += weight;
    sum += weight * value.x;
  }
  const Eigen::MatrixXd covariance = Inverse(information);
  return {covariance * sum,
          is_weighted ? covariance : Eigen::MatrixXd(Eigen::MatrixXd::Zero(size, size))};
}

Scatter ScatterOf(const std::vector<Value>& values, ComparedQuantity quantity) {
  const auto count = static_cast<double>(values.size());
  const Eigen::Index size = values.front().x.size();
  const Value mean = MeanOf(values);
  Eigen::VectorXd plain = Eigen::VectorXd::Zero(size);
  for (const Value& value : values) plain += value.x / count;
  Scatter scatter;
  scatter.quantity = quantity;
  Eigen::VectorXd squares = Eigen::VectorXd::Zero(size), variances = squares;
  const bool is_judged = AreEstimated(values);
  for (const Value& value : values) {
    squares += (value.x - plain).cwiseAbs2();
    variances += value.covariance.diagonal();
    const Eigen::VectorXd d = value.x - mean.x;
    if (is_judged) scatter.chi2 += SquaredDistance(d, value.covariance);
  }
  scatter.deviation = (squares / (count - 1.0)).cwiseSqrt();
  scatter.sigma = (variances / count).cwiseSqrt();
  if (is_judged) scatter.dof = static_cast<int>(size) * (static_cast<int>(values.size()) - 1);
  return scatter;
}

}  // namespace

const char* ToString(ComparedQuantity quantity) {
  constexpr const char* kNames[] = {"translation", "rotation", "accel delay", "time shift"};
  return kNames[static_cast<int>(quantity)];
}

const Difference* Comparison::Worst() const {
  const Difference* worst = nullptr;
  for (const Difference& component : components)
    if (component.sigma > 0.0 && (!worst || component.sigmas > worst->sigmas)) worst = &component;
  return worst;
}

Comparison Compare(const Comparable& first, const Comparable& second,
                   const std::vector<ComparedQuantity>& quantities) {
  Comparison comparison;
  comparison.distance = (second.T_MI.p - first.T_MI.p).norm();
  comparison.angle = Log(Eigen::Quaterniond(first.T_MI.q.conjugate() * second.T_MI.q)).norm();
  for (const ComparedQuantity quantity : quantities) {
    const Value from = Get(first, first, quantity), to = Get(second, first, quantity);
    const Value difference = {to.x, from.covariance + to.covariance};
    for (int axis = 0; axis < difference.x.size(); ++axis) {
      const double value = difference.x[axis];
      const double sigma = std::sqrt(std::max(0.0, difference.covariance(axis, axis)));
      comparison.components.push_back(
          {quantity, axis, value, sigma, sigma > 0.0 ? std::abs(value) / sigma : 0.0});
    }
    if (!difference.IsEstimated()) continue;
    comparison.chi2 += SquaredDistance(difference.x, difference.covariance);
    comparison.dof += static_cast<int>(difference.x.size());
  }
  return comparison;
}

Comparable Mean(const std::vector<Comparable>& calibrations) {
  Comparable mean = calibrations.front();
  // The rotation's tangent space moves with the mean.
  for (int iteration = 0; iteration < 10; ++iteration) {
    const Value rotation = MeanOf(GetAll(calibrations, mean, ComparedQuantity::kRotation));
    mean.T_MI.q = (mean.T_MI.q * Exp(Eigen::Vector3d(rotation.x))).normalized();
    mean.covariance.setZero();
    mean.covariance.bottomRightCorner<3, 3>() = rotation.covariance;
  }
  const Value translation = MeanOf(GetAll(calibrations, mean, ComparedQuantity::kTranslation));
  mean.T_MI.p += translation.x;
  mean.covariance.topLeftCorner<3, 3>() = translation.covariance;
  const auto take = [&](ComparedQuantity quantity, double* value, double* std_dev) {
    const Value scalar = MeanOf(GetAll(calibrations, mean, quantity));
    *value += scalar.x[0];
    *std_dev = std::sqrt(scalar.covariance(0, 0));
  };
  take(ComparedQuantity::kAccelDelay, &mean.accel_delay, &mean.accel_delay_std);
  take(ComparedQuantity::kTimeShift, &mean.time_shift, &mean.time_shift_std);
  return mean;
}

Repeatability Repeat(const std::vector<Comparable>& calibrations,
                     const std::vector<ComparedQuantity>& quantities) {
  Repeatability repeatability;
  repeatability.mean = Mean(calibrations);
  for (const ComparedQuantity quantity : quantities)
    repeatability.scatters.push_back(
        ScatterOf(GetAll(calibrations, repeatability.mean, quantity), quantity));
  for (size_t i = 0; i < calibrations.size(); ++i) {
    std::vector<Comparable> others = calibrations;
    others.erase(others.begin() + static_cast<std::ptrdiff_t>(i));
    repeatability.from_others.push_back(Compare(Mean(others), calibrations[i], quantities));
  }
  return repeatability;
}

}  // namespace imu_pose_calib
