#pragma once

#include <Eigen/Core>
#include <vector>

namespace imu_pose_calib {

/// Square-exponential kernel k(t, t') = signal_std^2 exp(-(t - t')^2 / (2 lengthscale_s^2)) and the
/// white noise of the measurements.
struct GpHyperparameters {
  double lengthscale_s = 0.0;
  double signal_std = 0.0;  ///< unit of the values
  double noise_std = 0.0;   ///< unit of the values
};

/// Least noise that is found: keeps the normal equations well conditioned.
constexpr double kMaxSignalToNoise = 1e5;

/// Measurements of up to four outputs: row i of `y` is taken at t[i]. t increases.
struct GpData {
  Eigen::VectorXd t;  ///< [s]
  Eigen::MatrixXd y;  ///< N x D, D <= 4
  /// Noise of each over GpHyperparameters::noise_std; empty: 1. Of GaussianProcess.
  Eigen::VectorXd noise_scale = Eigen::VectorXd();
};

/// Uniform grid of Gaussian bumps exp(-(t - c_j)^2 / l^2), c_j = first + j d, of which d is a
/// fixed share of l.
struct BumpGrid {
  double lengthscale, first;  ///< [s]
  int size;
};

/// Gaussian process regression with one 1-D input and D independent outputs that share their
/// hyperparameters, at a cost linear in duration (doc/math.md, "Gaussian process").
///
/// The kernel is written as an integral over Gaussian bumps and the integral as a sum on a grid of
/// 0.4 length scales, which is exact to 1e-13. That turns regression into least squares on bump
/// weights, whose normal matrix is banded.
class GaussianProcess {
 public:
  /// Column k holds the k-th time derivative, k = 0..3; one row per output, others are 0.
  using Derivatives = Eigen::Matrix4d;

  GaussianProcess() = default;
  /// There are variances only `with_variance`.
  GaussianProcess(const GpData& data, const GpHyperparameters& hyperparameters,
                  bool with_variance = true);

  /// Posterior mean at t and its first three derivatives (paper Eqs. 3 and 6). Beyond the
  /// measurements it tends to the prior mean, zero.
  Derivatives Evaluate(double t) const;
  /// Evaluate(t).col(0) alone, at a third of the cost.
  Eigen::Vector4d Value(double t) const;

  /// Posterior variance of the value and of the first and second derivative, the same for each
  /// output (paper Eqs. 4 and 7).
  Eigen::Vector3d Variance(double t) const;

 private:
  BumpGrid grid_;
  Eigen::Matrix4Xd weights_;  ///< outputs x bumps
  /// Of the weights of one output, blocks along the diagonal, see BlockOf().
  std::vector<Eigen::MatrixXd> covariance_;
};

/// log p(y | t, hyperparameters), summed over the outputs; `gradient` (if not null) receives its
/// derivatives by (log lengthscale, log signal_std, log noise_std).
double LogMarginalLikelihood(const GpData& data, const GpHyperparameters& hyperparameters,
                             Eigen::Vector3d* gradient);

/// Hyperparameters that maximise the marginal likelihood of all of `data`. Values of `fixed` that
/// are not zero are kept; a noise without a length scale is the least: with less than the data
/// show, the length scale would follow the noise. Each of the data is taken by one of up to
/// `threads` threads.
GpHyperparameters FitHyperparameters(const std::vector<GpData>& data,
                                     const GpHyperparameters& fixed, int threads = 1);

}  // namespace imu_pose_calib
