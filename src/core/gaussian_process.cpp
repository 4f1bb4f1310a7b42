#include "imu_pose_calib/core/gaussian_process.h"

#include <ceres/gradient_problem.h>
#include <ceres/gradient_problem_solver.h>

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "imu_pose_calib/core/dense.h"
#include "imu_pose_calib/core/median.h"
#include "imu_pose_calib/core/parallel.h"

namespace imu_pose_calib {
namespace {

constexpr double kSpacing = 0.4;  // [length scales] between bumps: kernel error 2 exp(-31)
constexpr int kHalfSupport = 15;
constexpr int kSupport =
    2 * kHalfSupport;  // bumps that reach one instant: the others are below 3e-14
constexpr int kGroup = 32;
constexpr double kCore = 64.0;             // [length scales]
constexpr double kMargin = 20.0;           // [length scales]
constexpr double kMaxSignalToNoise = 1e5;  // keeps the normal equations well conditioned

/// Uniform grid of Gaussian bumps exp(-(t - c_j)^2 / l^2), c_j = first + j spacing.
struct BumpGrid {
  double lengthscale, spacing, first;
  int size;

  /// Grid that serves every t in [begin, end].
  BumpGrid(double begin, double end, double lengthscale_s)
      : lengthscale(lengthscale_s),
        spacing(kSpacing * lengthscale_s),
        first(begin - kHalfSupport * spacing),
        size(static_cast<int>(std::floor((end - begin) / spacing)) + kSupport + 1) {}
  /// The part of such a grid that starts at `first_center` and has a row of `weights` for each
  /// bump.
  BumpGrid(double first_center, const Eigen::MatrixXd& weights, double lengthscale_s)
      : lengthscale(lengthscale_s),
        spacing(kSpacing * lengthscale_s),
        first(first_center),
        size(static_cast<int>(weights.rows())) {}

  /// First of the kSupport bumps around t.
  int FirstBump(double t) const {
    const int j = static_cast<int>(std::floor((t - first) / spacing)) - kHalfSupport + 1;
    return std::clamp(j, 0, size - kSupport);
  }
};

using BumpArray = Eigen::Array<double, kSupport, 1>;
using BumpDerivatives = Eigen::Matrix<double, kSupport, 4>;

/// Distances z_j = (t - c_j) / l of the bumps around t and their values exp(-z_j^2).
struct BumpValues {
  BumpArray distance, value;

  BumpValues(const BumpGrid& grid, int first_bump, double t) {
    // exp(-(z - j d)^2) = exp(-z^2) exp(2 z d)^j exp(-(j d)^2), j counted from the middle: three
    // calls of exp instead of thirty, in the innermost loop of every solve.
    static const BumpArray kSteps = BumpArray::LinSpaced(-kMiddle, kSupport - 1.0 - kMiddle);
    static const BumpArray kGaussian = (-(kSpacing * kSteps).square()).exp();
    const double z = (t - grid.first) / grid.lengthscale - kSpacing * (first_bump + kMiddle);
    const double ratio = std::exp(2.0 * z * kSpacing);
    // Up and down from the middle, in kLanes products that do not wait for each other.
    const double inverse = 1.0 / ratio;
    double factor = 1.0;
    for (int lane = 0; lane < kLanes; ++lane) factor *= ratio;
    const double inverse_factor = 1.0 / factor;
    double up = std::exp(-z * z), down = up * inverse;
    for (int lane = 0; lane < kLanes; ++lane, up *= ratio, down *= inverse) {
      double value_up = up, value_down = down;
      for (int j = lane; j < kMiddle; j += kLanes) {
        value[kMiddle + j] = value_up * kGaussian[kMiddle + j];
        value[kMiddle - 1 - j] = value_down * kGaussian[kMiddle - 1 - j];
        value_up *= factor;
        value_down *= inverse_factor;
      }
    }
    distance = z - kSpacing * kSteps;
  }

 private:
  static constexpr int kMiddle = kHalfSupport, kLanes = 5;
  static_assert(kSupport == 2 * kMiddle, "as many below as above");
};

/// Values of the bumps around t and their first three time derivatives.
BumpDerivatives Bumps(const BumpGrid& grid, int first_bump, double t) {
  const BumpValues bumps(grid, first_bump, t);
  const BumpArray& z = bumps.distance;
  const BumpArray& bump = bumps.value;
  const double l = grid.lengthscale;
  BumpDerivatives B;
  B.col(0) = bump;
  B.col(1) = -2.0 / l * z * bump;
  B.col(2) = (4.0 * z.square() - 2.0) / (l * l) * bump;
  B.col(3) = (12.0 - 8.0 * z.square()) * z / (l * l * l) * bump;
  return B;
}

/// Prior standard deviation of a bump weight: k = sum_j weight_std^2 bump_j bump_j.
double WeightStd(const GpHyperparameters& h) {
  return h.signal_std * std::sqrt(kSpacing * std::sqrt(2.0 / M_PI));
}

constexpr Eigen::Index kTile = 32;
static_assert(kTile >= kSupport, "a bump must not reach beyond the next tile");

/// Lower triangle of a symmetric matrix, as far as it is in a tile of kTile rows and columns on the
/// diagonal or below one. Columns begin with the diagonal, so that blocks are matrices of columns
/// one element less apart; above the diagonal, blocks have what is beyond the band.
class BandMatrix {
 public:
  using Block = Eigen::Map<Eigen::MatrixXd, 0, Eigen::OuterStride<>>;
  using Diagonal = Eigen::Map<Eigen::VectorXd, 0, Eigen::InnerStride<>>;

  explicit BandMatrix(Eigen::Index size)
      : size_(size), elements_(Eigen::VectorXd::Zero(size * kHeight)) {}

  Eigen::Index size() const { return size_; }
  Block block(Eigen::Index i, Eigen::Index j, Eigen::Index rows, Eigen::Index columns) {
    return {
        elements_.data() + i + j * (kHeight - 1), rows, columns, Eigen::OuterStride<>(kHeight - 1)};
  }
  /// `count` elements that are k rows below the diagonal, from column j on.
  Diagonal diagonal(Eigen::Index k, Eigen::Index j, Eigen::Index count) {
    return {elements_.data() + j * kHeight + k, count, Eigen::InnerStride<>(kHeight)};
  }
  void Scale(double factor) { elements_ *= factor; }

 private:
  static constexpr Eigen::Index kHeight = 3 * kTile;
  Eigen::Index size_;
  Eigen::VectorXd elements_;
};

/// Cholesky factor of a matrix whose entries further than kSupport from the diagonal are zero.
class BandedCholesky {
 public:
  explicit BandedCholesky(BandMatrix A) : L_(std::move(A)) {
    for (Eigen::Index i = 0; i < L_.size(); i += kTile) {
      const Eigen::Index n = Size(i), next = Size(i + n);
      auto diagonal = L_.block(i, i, n, n);
      Eigen::LLT<Eigen::Ref<Eigen::MatrixXd>> in_place(diagonal);
      if (next == 0) break;
      auto below = L_.block(i + n, i, next, n);
      diagonal.triangularView<Eigen::Lower>().transpose().solveInPlace<Eigen::OnTheRight>(below);
      AddProduct(-1.0, below, below, true, L_.block(i + n, i + n, next, next));
    }
  }

  double LogDeterminant() { return 2.0 * L_.diagonal(0, 0, L_.size()).array().log().sum(); }

  Eigen::MatrixXd Solve(Eigen::MatrixXd b) {
    for (Eigen::Index i = 0; i < L_.size(); i += kTile) {
      const Eigen::Index n = Size(i), next = Size(i + n);
      auto x = b.middleRows(i, n);
      L_.block(i, i, n, n).triangularView<Eigen::Lower>().solveInPlace(x);
      b.middleRows(i + n, next).noalias() -= L_.block(i + n, i, next, n) * x;
    }
    for (Eigen::Index i = LastTile(); i >= 0; i -= kTile) {
      const Eigen::Index n = Size(i), next = Size(i + n);
      auto x = b.middleRows(i, n);
      x.noalias() -= L_.block(i + n, i, next, n).transpose() * b.middleRows(i + n, next);
      L_.block(i, i, n, n).triangularView<Eigen::Lower>().transpose().solveInPlace(x);
    }
    return b;
  }

  /// Of the inverse, what a BandMatrix has. From the last tile up, with G = L_below L_ii^-1:
  ///   S_below,i = -S_below G,  S_ii = (L_ii L_ii^T)^-1 + G^T S_below G.
  BandMatrix InverseInBand() {
    BandMatrix S(L_.size());
    Eigen::MatrixXd later;  // S_below
    for (Eigen::Index i = LastTile(); i >= 0; i -= kTile) {
      const Eigen::Index n = Size(i), next = Size(i + n);
      Eigen::MatrixXd inverse = Eigen::MatrixXd::Identity(n, n);
      L_.block(i, i, n, n).triangularView<Eigen::Lower>().solveInPlace(inverse);
      const Eigen::MatrixXd inverse_T = inverse.transpose();
      Eigen::MatrixXd own = Eigen::MatrixXd::Zero(n, n);
      AddProduct(1.0, inverse_T, inverse_T, false, own);
      if (next > 0) {
        Eigen::MatrixXd G_T = Eigen::MatrixXd::Zero(n, next), below_T = G_T;
        AddProduct(1.0, inverse_T, L_.block(i + n, i, next, n), false, G_T);
        AddProduct(-1.0, G_T, later, false, below_T);
        AddProduct(-1.0, G_T, below_T, false, own);
        S.block(i + n, i, next, n) = below_T.transpose();
      }
      S.block(i, i, n, n).triangularView<Eigen::Lower>() = own;
      later = std::move(own);
    }
    return S;
  }

 private:
  /// Rows of the tile that begins at row i.
  Eigen::Index Size(Eigen::Index i) const { return std::min(kTile, L_.size() - i); }
  Eigen::Index LastTile() const { return (L_.size() - 1) / kTile * kTile; }

  BandMatrix L_;
};

/// Values of the bumps around neighbours that share them: one product for all of them.
using BumpGroup = Eigen::Matrix<double, kSupport, kGroup>;

/// Whether the measurement i + count, before `end`, is one of those from i on, whose bumps begin at
/// j.
bool IsInGroup(const GpData& data,
               Eigen::Index end,
               const BumpGrid& grid,
               int j,
               Eigen::Index i,
               Eigen::Index count) {
  return i + count < end && count < kGroup && grid.FirstBump(data.t[i + count]) == j;
}

/// Posterior of unit-variance bump weights given rows [begin, end) of the data:
///   A = I + F^T F / noise^2, mean = A^-1 F^T y / noise^2, with F = weight_std * bumps.
struct WeightPosterior {
  BandedCholesky A;
  Eigen::MatrixXd mean;
};

WeightPosterior FitWeights(const GpData& data,
                           Eigen::Index begin,
                           Eigen::Index end,
                           const BumpGrid& grid,
                           const GpHyperparameters& h) {
  BandMatrix A(grid.size);
  Eigen::MatrixXd b = Eigen::MatrixXd::Zero(grid.size, data.y.cols());
  BumpGroup F;
  for (Eigen::Index i = begin, count = 0; i < end; i += count) {
    const int j = grid.FirstBump(data.t[i]);
    for (count = 0; IsInGroup(data, end, grid, j, i, count); ++count)
      F.col(count) = BumpValues(grid, j, data.t[i + count]).value;
    auto group = F.leftCols(count);
    if (data.noise_scale.size() > 0)
      group *= data.noise_scale.segment(i, count).cwiseInverse().asDiagonal();
    AddProduct(1.0, group, group, true, A.block(j, j, kSupport, kSupport));
    if (data.noise_scale.size() > 0)
      group *= data.noise_scale.segment(i, count).cwiseInverse().asDiagonal();
    b.middleRows<kSupport>(j).noalias() += group * data.y.middleRows(i, count);
  }
  const double weight_std = WeightStd(h);
  A.Scale(std::pow(weight_std / h.noise_std, 2));
  A.diagonal(0, 0, grid.size).array() += 1.0;
  b *= weight_std / (h.noise_std * h.noise_std);
  WeightPosterior posterior{BandedCholesky(std::move(A)), {}};
  posterior.mean = posterior.A.Solve(std::move(b));
  return posterior;
}

/// Of the sum of weights, from bump j on, times `factors`; of their covariance, column k holds the
/// elements that are k rows below the diagonal.
double VarianceOf(const Eigen::MatrixXd& covariance, int j, const BumpArray& factors) {
  double variance = 0.0;
  for (int k = 0; k < kSupport; ++k) {
    const int n = kSupport - k;
    const auto products =
        factors.head(n) * factors.tail(n) * covariance.col(k).segment(j, n).array();
    variance += (k == 0 ? 1.0 : 2.0) * products.sum();
  }
  return variance;
}

}  // namespace

WindowedGp::WindowedGp(const GpData& data,
                       const GpHyperparameters& hyperparameters,
                       int threads,
                       bool with_variance)
    : hyperparameters_(hyperparameters),
      with_variance_(with_variance),
      begin_(data.t[0]),
      end_(data.t[data.t.size() - 1]) {
  const double windows = std::round((end_ - begin_) / (kCore * hyperparameters_.lengthscale_s));
  const double count = std::max(1.0, windows);
  core_ = std::max((end_ - begin_) / count, 1e-9);
  windows_.resize(static_cast<size_t>(count));
  InParallel(threads, windows_.size(), [&](size_t k) { windows_[k] = Fit(data, k); });
}

WindowedGp::WindowedGp(const WindowedGp& before,
                       const GpData& data,
                       const std::vector<double>& removed,
                       int threads)
    : WindowedGp(before) {
  InParallel(threads, windows_.size(), [&](size_t k) {
    const auto [low, high] = Span(k);
    const auto first = std::lower_bound(removed.begin(), removed.end(), low);
    if (first != removed.end() && *first <= high) windows_[k] = Fit(data, k);
  });
}

std::pair<double, double> WindowedGp::Span(size_t window) const {
  const double core_begin = begin_ + static_cast<double>(window) * core_;
  const double margin = kMargin * hyperparameters_.lengthscale_s;
  return {std::max(begin_, core_begin - margin), std::min(end_, core_begin + core_ + margin)};
}

std::shared_ptr<const WindowedGp::Window> WindowedGp::Fit(const GpData& data, size_t window) const {
  const GpHyperparameters& h = hyperparameters_;
  const double* const t_begin = data.t.data();
  const double* const t_end = t_begin + data.t.size();
  const double core_begin = begin_ + static_cast<double>(window) * core_;
  const auto [low, high] = Span(window);
  const BumpGrid grid(low, high, h.lengthscale_s);
  WeightPosterior posterior = FitWeights(data,
                                         std::lower_bound(t_begin, t_end, low) - t_begin,
                                         std::upper_bound(t_begin, t_end, high) - t_begin,
                                         grid,
                                         h);
  // Queries come from the core only: the margins' weights have done their work.
  const int first = grid.FirstBump(core_begin);
  const int size = grid.FirstBump(core_begin + core_) + kSupport - first;
  const double weight_std = WeightStd(h);
  auto fitted = std::make_shared<Window>(Window{
      grid.first + first * grid.spacing, weight_std * posterior.mean.middleRows(first, size), {}});
  if (!with_variance_) return fitted;
  BandMatrix inverse = posterior.A.InverseInBand();
  fitted->covariance = Eigen::MatrixXd::Zero(size, kSupport);
  for (int k = 0; k < std::min(kSupport, size); ++k)
    fitted->covariance.col(k).head(size - k) =
        weight_std * weight_std * inverse.diagonal(k, first, size - k);
  return fitted;
}

bool WindowedGp::Reaches(double t, double other) const {
  const double core_begin = begin_ + static_cast<double>(IndexAt(t)) * core_;
  const double margin = kMargin * hyperparameters_.lengthscale_s;
  return other >= core_begin - margin && other <= core_begin + core_ + margin;
}

size_t WindowedGp::IndexAt(double t) const {
  const double k = std::floor((t - begin_) / core_);
  return static_cast<size_t>(std::clamp(k, 0.0, static_cast<double>(windows_.size()) - 1));
}

WindowedGp::Derivatives WindowedGp::Evaluate(double t) const {
  const Window& window = At(t);
  const BumpGrid grid(window.first_center, window.weights, hyperparameters_.lengthscale_s);
  const int j = grid.FirstBump(t);
  return window.weights.middleRows<kSupport>(j).transpose().lazyProduct(Bumps(grid, j, t));
}

WindowedGp::Values WindowedGp::Value(double t) const {
  const Window& window = At(t);
  const BumpGrid grid(window.first_center, window.weights, hyperparameters_.lengthscale_s);
  const int j = grid.FirstBump(t);
  return window.weights.middleRows<kSupport>(j).transpose().lazyProduct(
      BumpValues(grid, j, t).value.matrix());
}

Eigen::Vector3d WindowedGp::Variance(double t) const {
  const Window& window = At(t);
  const BumpGrid grid(window.first_center, window.weights, hyperparameters_.lengthscale_s);
  const int j = grid.FirstBump(t);
  const BumpDerivatives B = Bumps(grid, j, t);
  Eigen::Vector3d variance;
  for (int k = 0; k < 3; ++k) variance[k] = VarianceOf(window.covariance, j, B.col(k));
  return variance;
}

double WindowedGp::ValueVariance(double t) const {
  const Window& window = At(t);
  const BumpGrid grid(window.first_center, window.weights, hyperparameters_.lengthscale_s);
  const int j = grid.FirstBump(t);
  return VarianceOf(window.covariance, j, BumpValues(grid, j, t).value);
}

double LogMarginalLikelihood(const GpData& data,
                             const GpHyperparameters& h,
                             Eigen::Vector3d* gradient) {
  // With K = F F^T + noise^2 I:  log|K| = log|A| + N log noise^2, K^-1 y = (y - F mean) / noise^2,
  // F^T K^-1 y = mean, and for a change dF of F: tr(K^-1 dK) = 2 tr(A^-1 F^T dF) / noise^2.
  const auto n = data.t.size();
  const auto outputs = static_cast<double>(data.y.cols());
  const BumpGrid grid(data.t[0], data.t[n - 1], h.lengthscale_s);
  WeightPosterior posterior = FitWeights(data, 0, n, grid, h);
  const double noise2 = h.noise_std * h.noise_std;
  const double weight_std = WeightStd(h);

  double fit = posterior.mean.squaredNorm();
  double length_fit = 0.0;
  double tr_length = 0.0;
  double residual_norm2 = 0.0;
  BandMatrix inverse(0);  // of A
  if (gradient != nullptr) inverse = posterior.A.InverseInBand();
  BumpGroup F, dF;
  for (Eigen::Index i = 0, count = 0; i < n; i += count) {
    const int j = grid.FirstBump(data.t[i]);
    for (count = 0; IsInGroup(data, n, grid, j, i, count); ++count) {
      const BumpValues bumps(grid, j, data.t[i + count]);
      F.col(count) = weight_std * bumps.value;
      // d F / d log l; the 1/2 is the change of weight_std per length of a fixed grid.
      dF.col(count) = F.col(count).array() * (2.0 * bumps.distance.square() - 0.5);
    }
    const auto mean = posterior.mean.middleRows<kSupport>(j);
    const auto f = F.leftCols(count), df = dF.leftCols(count);
    const Eigen::MatrixXd residual = data.y.middleRows(i, count) - f.transpose() * mean;
    residual_norm2 += residual.squaredNorm();
    if (gradient == nullptr) continue;
    length_fit += residual.cwiseProduct(df.transpose() * mean).sum() / noise2;
    Eigen::Matrix<double, kSupport, kSupport> product = decltype(product)::Zero();
    AddProduct(1.0, df, f, false, product);
    product += product.transpose().eval();
    const auto own = inverse.block(j, j, kSupport, kSupport);  // lower triangle
    for (int k = 0; k < kSupport; ++k)
      tr_length += (own.col(k).tail(kSupport - k).dot(product.col(k).tail(kSupport - k)) -
                    0.5 * own(k, k) * product(k, k)) /
                   noise2;
  }
  fit += residual_norm2 / noise2;
  const double log_likelihood =
      -0.5 * fit -
      0.5 * outputs *
          (posterior.A.LogDeterminant() + static_cast<double>(n) * std::log(2.0 * M_PI * noise2));

  if (gradient != nullptr) {
    const double trace_A_inv = inverse.diagonal(0, 0, grid.size).sum();
    const double m = grid.size;
    (*gradient)[0] = length_fit - outputs * tr_length;
    (*gradient)[1] = posterior.mean.squaredNorm() - outputs * (m - trace_A_inv);
    (*gradient)[2] = residual_norm2 / noise2 - outputs * (static_cast<double>(n) - m + trace_A_inv);
  }
  return log_likelihood;
}

namespace {

/// Negative log marginal likelihood in the logarithms of the three hyperparameters, with soft walls
/// that keep them where the data can tell them.
class MarginalLikelihoodCost : public ceres::FirstOrderFunction {
 public:
  MarginalLikelihoodCost(const std::vector<GpData>& data,
                         const GpHyperparameters& fixed,
                         const Eigen::Vector3d& low,
                         const Eigen::Vector3d& high)
      : data_(data),
        is_free_(fixed.lengthscale_s == 0.0, fixed.signal_std == 0.0, fixed.noise_std == 0.0),
        low_(low),
        high_(high) {
    for (const GpData& d : data) count_ += static_cast<double>(d.y.size());
  }

  bool Evaluate(const double* x, double* cost, double* gradient) const override {
    const Eigen::Map<const Eigen::Vector3d> logs(x);
    const Eigen::Vector3d clamped = logs.cwiseMax(low_ - kSlack).cwiseMin(high_ + kSlack);
    if (clamped != logs) return false;
    const GpHyperparameters h{std::exp(x[0]), std::exp(x[1]), std::exp(x[2])};
    *cost = 0.0;
    Eigen::Vector3d sum = Eigen::Vector3d::Zero();
    for (const GpData& d : data_) {
      Eigen::Vector3d g;
      *cost -= LogMarginalLikelihood(d, h, gradient != nullptr ? &g : nullptr);
      if (gradient != nullptr) sum -= g;
    }
    const Eigen::Vector3d below = (low_ - logs).cwiseMax(0.0);
    const Eigen::Vector3d above = (logs - high_).cwiseMax(0.0);
    const double ratio = std::max(0.0, x[1] - x[2] - std::log(kMaxSignalToNoise));
    const double wall = 10.0 * count_;
    *cost += wall * (below.squaredNorm() + above.squaredNorm() + ratio * ratio);
    sum += 2.0 * wall * (above - below + Eigen::Vector3d(0.0, ratio, -ratio));
    *cost /= count_;
    for (int k = 0; gradient != nullptr && k < 3; ++k)
      gradient[k] = is_free_[k] ? sum[k] / count_ : 0.0;
    return std::isfinite(*cost);
  }
  int NumParameters() const override { return 3; }

 private:
  const Eigen::Vector3d kSlack = Eigen::Vector3d::Constant(0.3);
  const std::vector<GpData>& data_;
  const Eigen::Array<bool, 3, 1> is_free_;
  const Eigen::Vector3d low_, high_;
  double count_ = 0.0;
};

/// Moments of the data from which the search starts.
struct Moments {
  double period, duration, signal, rate, noise;

  explicit Moments(const std::vector<GpData>& data) {
    double sum2 = 0.0, count = 0.0;
    std::vector<double> periods, rates, second_differences;
    duration = 0.0;
    for (const GpData& d : data) {
      const auto n = d.t.size();
      sum2 += d.y.squaredNorm();
      count += static_cast<double>(d.y.size());
      duration = std::max(duration, d.t[n - 1] - d.t[0]);
      Eigen::Index lag = 0;  // a rate over 50 ms is not all noise
      for (Eigen::Index i = 1; i < n; ++i) {
        periods.push_back(d.t[i] - d.t[i - 1]);
        while (d.t[i] - d.t[lag] > 0.05 && lag + 1 < i) ++lag;
        rates.push_back((d.y.row(i) - d.y.row(lag)).squaredNorm() / std::pow(d.t[i] - d.t[lag], 2) /
                        static_cast<double>(d.y.cols()));
        if (i < 2) continue;
        for (Eigen::Index k = 0; k < d.y.cols(); ++k)
          second_differences.push_back(std::abs(d.y(i, k) - 2.0 * d.y(i - 1, k) + d.y(i - 2, k)));
      }
    }
    period = Median(periods);
    signal = std::sqrt(sum2 / count);
    rate = std::sqrt(Median(rates));
    noise = Median(second_differences) / 0.6745 / std::sqrt(6.0);
  }
};

/// Of a few of the data; x: logarithms of the hyperparameters.
double RoughLikelihood(const std::vector<GpData>& data, const Eigen::Vector3d& x) {
  double likelihood = 0.0;
  for (size_t k = 0; k < data.size(); k += 1 + data.size() / 4)
    likelihood +=
        LogMarginalLikelihood(data[k], {std::exp(x[0]), std::exp(x[1]), std::exp(x[2])}, nullptr);
  return likelihood;
}

/// The likelihood has a second maximum where the noise is followed as a signal: start the search in
/// the right valley, with the best of a few length scales around exp(x[0]).
Eigen::Vector3d ScanLengthscale(const std::vector<GpData>& data,
                                const Eigen::Vector3d& x,
                                double low,
                                double high) {
  Eigen::Vector3d best = x;
  double most = -std::numeric_limits<double>::infinity();
  for (double step = -3.5; step <= 1.0; step += 0.5) {
    const Eigen::Vector3d candidate(x[0] + step, x[1], x[2]);
    if (candidate[0] < low || candidate[0] > high) continue;
    const double likelihood = RoughLikelihood(data, candidate);
    if (likelihood <= most) continue;
    most = likelihood;
    best = candidate;
  }
  return best;
}

}  // namespace

GpHyperparameters FitHyperparameters(const std::vector<GpData>& data,
                                     const GpHyperparameters& fixed,
                                     const GpHyperparameters& before) {
  if (fixed.lengthscale_s > 0.0 && fixed.signal_std > 0.0 && fixed.noise_std > 0.0) return fixed;
  if (fixed.lengthscale_s == 0.0 && fixed.noise_std > 0.0) {
    const GpHyperparameters fitted =
        FitHyperparameters(data, {fixed.lengthscale_s, fixed.signal_std, 0.0}, before);
    if (fitted.noise_std > fixed.noise_std) return fitted;
  }
  const Moments moments(data);
  const double signal = std::max(moments.signal, 1e-6);
  const double noise = std::clamp(moments.noise, 1e-5 * signal, signal);
  const Eigen::Vector3d low =
      Eigen::Vector3d(2.0 * moments.period, 1e-2 * signal, 2e-6 * signal).array().log();
  const Eigen::Vector3d high =
      Eigen::Vector3d(std::max(moments.duration, 4.0 * moments.period), 1e3 * signal, 3.0 * signal)
          .array()
          .log();
  Eigen::Vector3d x(
      std::log(signal / std::max(moments.rate, 1e-6)), std::log(signal), std::log(noise));
  x = x.cwiseMax(low).cwiseMin(high);
  if (fixed.lengthscale_s > 0.0) x[0] = std::log(fixed.lengthscale_s);
  if (fixed.signal_std > 0.0) x[1] = std::log(fixed.signal_std);
  if (fixed.noise_std > 0.0) x[2] = std::log(fixed.noise_std);
  if (fixed.lengthscale_s == 0.0) x = ScanLengthscale(data, x, low[0], high[0]);
  if (before.lengthscale_s > 0.0) {
    Eigen::Vector3d there(before.lengthscale_s, before.signal_std, before.noise_std);
    there = there.array().log().matrix().cwiseMax(low).cwiseMin(high).eval();
    if (fixed.lengthscale_s > 0.0) there[0] = x[0];
    if (fixed.signal_std > 0.0) there[1] = x[1];
    if (fixed.noise_std > 0.0) there[2] = x[2];
    if (RoughLikelihood(data, there) > RoughLikelihood(data, x)) x = there;
  }

  ceres::GradientProblem problem(
      new MarginalLikelihoodCost(data, fixed, low.cwiseMin(x), high.cwiseMax(x)));
  ceres::GradientProblemSolver::Options options;
  options.logging_type = ceres::SILENT;
  options.line_search_direction_type = ceres::BFGS;
  options.max_num_iterations = 60;
  options.function_tolerance = 1e-7;
  options.gradient_tolerance = 1e-5;
  ceres::GradientProblemSolver::Summary summary;
  ceres::Solve(options, problem, x.data(), &summary);
  return {std::exp(x[0]), std::exp(x[1]), std::exp(x[2])};
}

}  // namespace imu_pose_calib
