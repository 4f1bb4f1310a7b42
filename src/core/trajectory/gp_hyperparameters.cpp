#include <ceres/gradient_problem.h>
#include <ceres/gradient_problem_solver.h>

#include <algorithm>
#include <cmath>
#include <numeric>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/parallel.h"
#include "imu_pose_calib/core/trajectory/gaussian_process.h"

namespace imu_pose_calib {
namespace {

using Bool3 = Eigen::Array<bool, 3, 1>;

GpHyperparameters FromLogs(const Eigen::Vector3d& x) {
  return {std::exp(x[0]), std::exp(x[1]), std::exp(x[2])};
}

/// Negative log marginal likelihood in the logarithms of the three hyperparameters, with soft walls
/// that keep them where the data can tell them.
class MarginalLikelihoodCost : public ceres::FirstOrderFunction {
 public:
  MarginalLikelihoodCost(const std::vector<GpData>& data, const Bool3& is_fixed,
                         const Eigen::Vector3d& low, const Eigen::Vector3d& high, int threads)
      : data_(data), is_fixed_(is_fixed), low_(low), high_(high), threads_(threads) {
    for (const GpData& d : data) count_ += static_cast<double>(d.y.size());
  }

  bool Evaluate(const double* x, double* cost, double* gradient) const override {
    const Eigen::Map<const Eigen::Vector3d> logs(x);
    const Eigen::Vector3d clamped = logs.cwiseMax(low_ - kSlack).cwiseMin(high_ + kSlack);
    if (clamped != logs) return false;
    std::vector<double> likelihoods(data_.size());
    std::vector<Eigen::Vector3d> gradients(data_.size());
    InParallel(threads_, data_.size(), [&](size_t k) {
      likelihoods[k] = LogMarginalLikelihood(data_[k], FromLogs(logs), &gradients[k]);
    });
    *cost = -std::accumulate(likelihoods.begin(), likelihoods.end(), 0.0);
    const Eigen::Vector3d zero = Eigen::Vector3d::Zero();
    Eigen::Vector3d sum = std::accumulate(gradients.begin(), gradients.end(), zero);
    const Eigen::Vector3d below = (low_ - logs).cwiseMax(0.0);
    const Eigen::Vector3d above = (logs - high_).cwiseMax(0.0);
    const double ratio = std::max(0.0, x[1] - x[2] - std::log(kMaxSignalToNoise));
    const double wall = 10.0 * count_;
    *cost += wall * (below.squaredNorm() + above.squaredNorm() + ratio * ratio);
    sum = 2.0 * wall * (above - below + Eigen::Vector3d(0.0, ratio, -ratio)) - sum;
    *cost /= count_;
    for (int k = 0; gradient != nullptr && k < 3; ++k)
      gradient[k] = is_fixed_[k] ? 0.0 : sum[k] / count_;
    return std::isfinite(*cost);
  }
  int NumParameters() const override { return 3; }

 private:
  const Eigen::Vector3d kSlack = Eigen::Vector3d::Constant(0.3);
  const std::vector<GpData>& data_;
  const Bool3 is_fixed_;
  const Eigen::Vector3d low_, high_;
  const int threads_;
  double count_ = 0.0;
};

/// Moments of the data from which the search starts.
struct Moments {
  double period, duration = 0.0, signal, noise;

  explicit Moments(const std::vector<GpData>& data) {
    double sum2 = 0.0, count = 0.0;
    std::vector<double> periods, second_differences;
    for (const GpData& d : data) {
      const auto n = d.t.size();
      sum2 += d.y.squaredNorm();
      count += static_cast<double>(d.y.size());
      duration = std::max(duration, d.t[n - 1] - d.t[0]);
      for (Eigen::Index i = 1; i < n; ++i) periods.push_back(d.t[i] - d.t[i - 1]);
      for (Eigen::Index i = 2; i < n; ++i)
        for (Eigen::Index k = 0; k < d.y.cols(); ++k)
          second_differences.push_back(d.y(i, k) - 2.0 * d.y(i - 1, k) + d.y(i - 2, k));
    }
    period = Median(periods);
    signal = std::sqrt(sum2 / count);
    noise = RobustSigma(std::move(second_differences)) / std::sqrt(6.0);
  }
};

/// The start of which a few of the data are the likeliest: the likelihood has a second maximum
/// where the noise is followed as a signal.
Eigen::Vector3d FindBest(const std::vector<GpData>& data,
                         const std::vector<Eigen::Vector3d>& starts, int threads) {
  std::vector<double> likelihoods(starts.size());
  InParallel(threads, starts.size(), [&](size_t k) {
    for (size_t i = 0; i < data.size(); i += 1 + data.size() / 4)
      likelihoods[k] += LogMarginalLikelihood(data[i], FromLogs(starts[k]), nullptr);
  });
  const auto most = std::max_element(likelihoods.begin(), likelihoods.end());
  return starts[static_cast<size_t>(most - likelihoods.begin())];
}

}  // namespace

GpHyperparameters FitHyperparameters(const std::vector<GpData>& data,
                                     const GpHyperparameters& fixed, int threads) {
  const Eigen::Array3d given(fixed.lengthscale_s, fixed.signal_std, fixed.noise_std);
  const Bool3 is_fixed = given > 0.0;
  if (is_fixed.all()) return fixed;
  if (!is_fixed[0] && is_fixed[2]) {
    const GpHyperparameters fitted =
        FitHyperparameters(data, {0.0, fixed.signal_std, 0.0}, threads);
    if (fitted.noise_std > fixed.noise_std) return fitted;
  }
  const Moments moments(data);
  const double signal = std::max(moments.signal, 1e-6);
  const double noise = std::clamp(moments.noise, signal / kMaxSignalToNoise, signal);
  const double shortest = 2.0 * moments.period;
  const Eigen::Array3d low(shortest, 1e-2 * signal, 2e-6 * signal);
  const Eigen::Array3d high(std::max(moments.duration, 2.0 * shortest), 1e3 * signal, 3.0 * signal);
  std::vector<Eigen::Vector3d> starts;
  for (double lengthscale = shortest; lengthscale <= high[0]; lengthscale *= 1.6) {
    starts.push_back(is_fixed.select(given, Eigen::Array3d(lengthscale, signal, noise)).log());
    if (is_fixed[0]) break;
  }
  Eigen::Vector3d x = FindBest(data, starts, threads);

  ceres::GradientProblem problem(new MarginalLikelihoodCost(
      data, is_fixed, low.log().matrix().cwiseMin(x), high.log().matrix().cwiseMax(x), threads));
  ceres::GradientProblemSolver::Options options;
  options.logging_type = ceres::SILENT;
  options.line_search_direction_type = ceres::BFGS;
  options.max_num_iterations = 60;
  options.function_tolerance = 1e-7;
  options.gradient_tolerance = 1e-5;
  ceres::GradientProblemSolver::Summary summary;
  ceres::Solve(options, problem, x.data(), &summary);
  return FromLogs(x);
}

}  // namespace imu_pose_calib
