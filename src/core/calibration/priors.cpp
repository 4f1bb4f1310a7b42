#include "imu_pose_calib/core/calibration/priors.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

namespace imu_pose_calib {
namespace {

using Eigen::Index;
using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Sigmas of the Gaussians of a prior, in those of its peak; each is less likely than the one
/// before by their ratio, which is how Cauchy's tails fall.
constexpr std::array<double, 4> kScales = {1.0, 10.0, 100.0, 1000.0};
constexpr double kWidest = 1.0 / (kScales.back() * kScales.back());  // information of the last one
/// A delay of positions is less likely by this: slow errors of rotations look like one by four
/// sigma.
constexpr double kPositionDelayOdds = 1e-6;
/// Gaussians of a product of priors that are kept, the most likely ones.
constexpr size_t kMixture = 64;
/// A factor takes nothing from what all else says, and adds this share of what is known at least.
constexpr double kLeastInformation = 1e-4;

/// Component of a parameter that has a peak.
struct Component {
  ParameterKind kind;
  double value, peak;
  Index column;
};

double PeakOf(const Parameter& p, int component, const Estimate& estimate) {
  switch (p.kind) {
    case ParameterKind::kAccelSmoothing:
      return AccelSmoothingPeak(estimate.imus[p.imu].accel_delay);
    case ParameterKind::kMountCompliance:
      return kCompliancePeak;
    case ParameterKind::kPoseCumulants:
    case ParameterKind::kPositionCumulants:
      return component == 0 ? kThirdPeak : kFourthPeak;
    case ParameterKind::kPositionDelay:
      return kPositionDelayPeak;
    default:
      return kSmoothingPeak;
  }
}

/// `parameters` are in columns of x one after the other.
std::vector<Component> ComponentsWithPeaks(const Estimate& estimate,
                                           const std::vector<Parameter>& parameters) {
  std::vector<Component> components;
  Index column = 0;
  for (const Parameter& p : parameters) {
    for (int k = 0; k < p.size && HasPeak(p.kind); ++k)
      components.push_back({p.kind, p.data[k], PeakOf(p, k, estimate), column + k});
    column += p.size;
  }
  return components;
}

/// Its root S, S^T S, with eigenvalues of this at least.
MatrixXd RootOf(const MatrixXd& symmetric, double least) {
  const Eigen::SelfAdjointEigenSolver<MatrixXd> eigen(symmetric);
  return eigen.eigenvalues().cwiseMax(least).cwiseSqrt().asDiagonal() *
         eigen.eigenvectors().transpose();
}

MatrixXd InverseOf(const MatrixXd& positive) {
  return positive.llt().solve(MatrixXd::Identity(positive.rows(), positive.cols()));
}

/// Of a mixture, with the logarithm of its weight.
struct Gaussian {
  VectorXd mean;
  MatrixXd covariance;
  double log_weight = 0.0;

  /// Times exp(-information x_k^2 / 2).
  void Multiply(Index k, double information) {
    const double growth = 1.0 + information * covariance(k, k);
    const double gain = information / growth;
    log_weight -= 0.5 * (gain * mean[k] * mean[k] + std::log(growth));
    const VectorXd column = covariance.col(k);
    mean -= gain * mean[k] * column;
    covariance -= gain * column * column.transpose();
  }
};

/// `rest`, which has the widest Gaussian of each prior as a factor, with the priors instead. In
/// units of the peaks.
std::vector<Gaussian> WithPriors(const std::vector<Component>& components, Gaussian rest) {
  std::vector<Gaussian> mixture = {std::move(rest)};
  for (size_t k = 0; k < components.size(); ++k) {
    std::vector<Gaussian> next;
    for (const Gaussian& before : mixture)
      for (const double scale : kScales) {
        next.push_back(before);
        next.back().log_weight -= 2.0 * std::log(scale);  // less likely, and wider
        if (scale > 1.0 && components[k].kind == ParameterKind::kPositionDelay)
          next.back().log_weight += std::log(kPositionDelayOdds);
        next.back().Multiply(static_cast<Index>(k), 1.0 / (scale * scale) - kWidest);
      }
    std::sort(next.begin(), next.end(),
              [](const Gaussian& a, const Gaussian& b) { return a.log_weight > b.log_weight; });
    next.resize(std::min(kMixture, next.size()));
    mixture = std::move(next);
  }
  return mixture;
}

/// Mean and covariance of a mixture.
Gaussian MomentsOf(const std::vector<Component>& components, const std::vector<Gaussian>& mixture) {
  const double largest = mixture.front().log_weight;
  Gaussian moments{VectorXd::Zero(mixture[0].mean.size()), 0.0 * mixture[0].covariance};
  double sum = 0.0;
  for (const Gaussian& own : mixture) {
    double weight = std::exp(own.log_weight - largest);
    for (size_t k = 0; k < components.size(); ++k) {
      const auto i = static_cast<Index>(k);
      if (components[k].kind == ParameterKind::kMountCompliance)  // no mount gives way upwards
        weight *= std::erfc(-own.mean[i] / std::sqrt(2.0 * own.covariance(i, i)));
    }
    sum += weight;
    moments.mean += weight * own.mean;
    moments.covariance += weight * (own.covariance + own.mean * own.mean.transpose());
  }
  moments.mean /= sum;
  moments.covariance = moments.covariance / sum - moments.mean * moments.mean.transpose();
  return moments;
}

/// r = A x - b.
class FactorCost : public ceres::CostFunction {
 public:
  FactorCost(const std::vector<Parameter>& parameters, GaussianFactor factor)
      : factor_(std::move(factor)) {
    for (const Parameter& p : parameters) mutable_parameter_block_sizes()->push_back(p.size);
    set_num_residuals(static_cast<int>(factor_.b.size()));
  }

  bool Evaluate(double const* const* parameters, double* residuals,
                double** jacobians) const override {
    using RowMajor = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
    Eigen::Map<VectorXd> r(residuals, num_residuals());
    r = -factor_.b;
    Index column = 0;
    for (size_t k = 0; k < parameter_block_sizes().size(); ++k) {
      const int size = parameter_block_sizes()[k];
      const auto own = factor_.A.middleCols(column, size);
      r += own * Eigen::Map<const VectorXd>(parameters[k], size);
      if (jacobians && jacobians[k]) Eigen::Map<RowMajor>(jacobians[k], r.size(), size) = own;
      column += size;
    }
    return true;
  }

 private:
  const GaussianFactor factor_;
};

}  // namespace

GaussianPrior PriorOf(const Parameter& p, int component, const CalibrationOptions& options) {
  switch (p.kind) {
    case ParameterKind::kAccelDelay:
      return {options.accel_delay, kDelayPrior};
    case ParameterKind::kClockDrift:
      return {0.0, kDriftPrior};
    case ParameterKind::kPoseScale:
      return {1.0, kPoseScalePrior};
    case ParameterKind::kGyroIntrinsics: {
      const bool is_diagonal = component == 0 || component == 2 || component == 5;
      return {0.0, is_diagonal ? kScalePrior : kAlignmentPrior};
    }
    case ParameterKind::kAccelIntrinsics:
      return {0.0, component % 4 == 0 ? kScalePrior : kAlignmentPrior};
    case ParameterKind::kAccelPositions:
      return {0.0, kSizePrior};
    default:
      return {};
  }
}

bool HasPeak(ParameterKind kind) {
  switch (kind) {
    case ParameterKind::kPoseSmoothing:
    case ParameterKind::kPositionSmoothing:
    case ParameterKind::kPoseCumulants:
    case ParameterKind::kPositionCumulants:
    case ParameterKind::kPositionDelay:
    case ParameterKind::kGyroSmoothing:
    case ParameterKind::kAccelSmoothing:
    case ParameterKind::kMountCompliance:
      return true;
    default:
      return false;
  }
}

std::unique_ptr<ceres::CostFunction> PeakPriors(const std::vector<Parameter>& parameters,
                                                const GaussianFactor& factor) {
  return std::make_unique<FactorCost>(parameters, factor);
}

GaussianFactor FirstPeaks(const Estimate& estimate, const std::vector<Parameter>& parameters) {
  const std::vector<Component> components = ComponentsWithPeaks(estimate, parameters);
  VectorXd std(components.size());
  for (size_t k = 0; k < components.size(); ++k)
    std[static_cast<Index>(k)] = kScales.front() * components[k].peak;
  return {std.cwiseInverse().asDiagonal(), VectorXd::Zero(std.size())};
}

GaussianFactor MatchPeaks(const Estimate& estimate, const std::vector<Parameter>& parameters,
                          const MatrixXd& covariance) {
  const std::vector<Component> components = ComponentsWithPeaks(estimate, parameters);
  const auto n = static_cast<Index>(components.size());
  if (n == 0) return {};
  VectorXd unit(n), value(n);
  MatrixXd own(n, n);
  for (Index i = 0; i < n; ++i) {
    const Component& row = components[static_cast<size_t>(i)];
    unit[i] = row.peak;
    value[i] = row.value / row.peak;
    for (Index k = 0; k < n; ++k) {
      const Component& column = components[static_cast<size_t>(k)];
      own(i, k) = covariance(row.column, column.column) / (row.peak * column.peak);
    }
  }
  // What all else says: information, and its product with the mean.
  const MatrixXd A = estimate.peaks.A * unit.asDiagonal();
  const MatrixXd information = InverseOf(own);
  const MatrixXd root = RootOf(information - A.transpose() * A, 0.0);
  const MatrixXd rest = root.transpose() * root;
  const VectorXd rest_mean = information * value - A.transpose() * estimate.peaks.b;

  Gaussian wide;
  wide.covariance = InverseOf(rest + kWidest * MatrixXd::Identity(n, n));
  wide.mean = wide.covariance * rest_mean;
  const Gaussian all = MomentsOf(components, WithPriors(components, std::move(wide)));

  const MatrixXd wanted = InverseOf(all.covariance);
  const VectorXd scale = wanted.diagonal().cwiseSqrt(), of_scale = scale.cwiseInverse();
  GaussianFactor factor;
  factor.A =
      RootOf(of_scale.asDiagonal() * (wanted - rest) * of_scale.asDiagonal(), kLeastInformation) *
      scale.asDiagonal();
  factor.b = factor.A.transpose().partialPivLu().solve(
      (rest + factor.A.transpose() * factor.A) * all.mean - rest_mean);
  factor.A = factor.A * unit.cwiseInverse().asDiagonal();
  // Where no covariance is finite, the solve says so itself.
  if (!factor.A.allFinite() || !factor.b.allFinite()) return estimate.peaks;
  return factor;
}

}  // namespace imu_pose_calib
