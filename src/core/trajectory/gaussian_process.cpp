#include "imu_pose_calib/core/trajectory/gaussian_process.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/parallel.h"

namespace imu_pose_calib {
namespace {

constexpr double kSpacing = 0.4;  // [length scales] between bumps: kernel error 2 exp(-31)
constexpr int kHalfSupport = 15;
constexpr int kSupport =
    2 * kHalfSupport;  // bumps that reach one instant: the others are below 3e-14
constexpr int kGroup = 32;
constexpr double kCore = 64.0;    // [length scales]
constexpr double kMargin = 20.0;  // [length scales]

double Spacing(const BumpGrid& grid) { return kSpacing * grid.lengthscale; }

/// First of the kSupport bumps around t.
int FirstBump(const BumpGrid& grid, double t) {
  const int j = static_cast<int>(std::floor((t - grid.first) / Spacing(grid))) - kHalfSupport + 1;
  return std::clamp(j, 0, grid.size - kSupport);
}

/// Grid that serves every t in [begin, end].
BumpGrid GridOf(double begin, double end, double lengthscale_s) {
  const double spacing = kSpacing * lengthscale_s;
  return {lengthscale_s, begin - kHalfSupport * spacing,
          static_cast<int>(std::floor((end - begin) / spacing)) + kSupport + 1};
}

using BumpArray = Eigen::Array<double, kSupport, 1>;
using BumpDerivatives = Eigen::Matrix<double, kSupport, 4>;

/// Distances z_j = (t - c_j) / l of the bumps around t and their values exp(-z_j^2).
struct BumpValues {
  BumpArray distance, value;

  BumpValues(const BumpGrid& grid, int first_bump, double t) {
    // exp(-(z - j d)^2) = exp(-z^2) exp(2 z d)^j exp(-(j d)^2), j counted from the middle: two
    // calls of exp instead of thirty, in the innermost loop of every solve.
    static const BumpArray kSteps =
        BumpArray::LinSpaced(-kHalfSupport, kSupport - 1.0 - kHalfSupport);
    static const BumpArray kGaussian = (-(kSpacing * kSteps).square()).exp();
    const double z = (t - grid.first) / grid.lengthscale - kSpacing * (first_bump + kHalfSupport);
    const double ratio = std::exp(2.0 * z * kSpacing);
    const double inverse = 1.0 / ratio;
    double up = std::exp(-z * z), down = up * inverse;
    for (int j = 0; j < kHalfSupport; ++j, up *= ratio, down *= inverse) {
      value[kHalfSupport + j] = up * kGaussian[kHalfSupport + j];
      value[kHalfSupport - 1 - j] = down * kGaussian[kHalfSupport - 1 - j];
    }
    distance = z - kSpacing * kSteps;
  }
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
    return {elements_.data() + i + j * (kHeight - 1), rows, columns,
            Eigen::OuterStride<>(kHeight - 1)};
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
      const auto below = L_.block(i + n, i, next, n);
      Factor(L_.block(i, i, n, n), below);
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
    Eigen::MatrixXd later(0, 0);  // S_below
    for (Eigen::Index i = LastTile(); i >= 0; i -= kTile) {
      const Eigen::Index n = Size(i), next = Size(i + n);
      Eigen::MatrixXd inverse = Eigen::MatrixXd::Identity(n, n);
      L_.block(i, i, n, n).triangularView<Eigen::Lower>().solveInPlace(inverse);
      const Eigen::MatrixXd inverse_T = inverse.transpose();
      Eigen::MatrixXd own = Eigen::MatrixXd::Zero(n, n);
      Eigen::MatrixXd G_T = Eigen::MatrixXd::Zero(n, next), below_T = G_T;
      AddProduct(1.0, inverse_T, inverse_T, false, own);
      AddProduct(1.0, inverse_T, L_.block(i + n, i, next, n), false, G_T);
      AddProduct(-1.0, G_T, later, false, below_T);
      AddProduct(-1.0, G_T, below_T, false, own);
      S.block(i + n, i, next, n) = below_T.transpose();
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
bool IsInGroup(const GpData& data, Eigen::Index end, const BumpGrid& grid, int j, Eigen::Index i,
               Eigen::Index count) {
  return i + count < end && count < kGroup && FirstBump(grid, data.t[i + count]) == j;
}

/// Posterior of unit-variance bump weights given rows [begin, end) of the data:
///   A = I + F^T F / noise^2, mean = A^-1 F^T y / noise^2, with F = weight_std * bumps.
struct WeightPosterior {
  BandedCholesky A;
  Eigen::MatrixXd mean;
};

WeightPosterior FitWeights(const GpData& data, Eigen::Index begin, Eigen::Index end,
                           const BumpGrid& grid, const GpHyperparameters& h) {
  BandMatrix A(grid.size);
  Eigen::MatrixXd b = Eigen::MatrixXd::Zero(grid.size, data.y.cols());
  BumpGroup F;
  for (Eigen::Index i = begin, count = 0; i < end; i += count) {
    const int j = FirstBump(grid, data.t[i]);
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

WindowedGp::WindowedGp(const GpData& data, const GpHyperparameters& h, int threads,
                       bool with_variance)
    : begin_(data.t[0]), end_(data.t[data.t.size() - 1]) {
  const double windows = std::round((end_ - begin_) / (kCore * h.lengthscale_s));
  const double count = std::max(1.0, windows);
  core_ = std::max((end_ - begin_) / count, 1e-9);
  windows_.resize(static_cast<size_t>(count));
  InParallel(threads, windows_.size(),
             [&](size_t k) { windows_[k] = Fit(data, h, with_variance, k); });
}

WindowedGp::Window WindowedGp::Fit(const GpData& data, const GpHyperparameters& h,
                                   bool with_variance, size_t window) const {
  const double* const t_begin = data.t.data();
  const double* const t_end = t_begin + data.t.size();
  const double core_begin = begin_ + static_cast<double>(window) * core_;
  const double margin = kMargin * h.lengthscale_s;
  const double low = std::max(begin_, core_begin - margin);
  const double high = std::min(end_, core_begin + core_ + margin);
  const BumpGrid grid = GridOf(low, high, h.lengthscale_s);
  WeightPosterior posterior = FitWeights(data, std::lower_bound(t_begin, t_end, low) - t_begin,
                                         std::upper_bound(t_begin, t_end, high) - t_begin, grid, h);
  // Queries come from the core only: the margins' weights have done their work.
  const int first = FirstBump(grid, core_begin);
  const int size = FirstBump(grid, core_begin + core_) + kSupport - first;
  const double weight_std = WeightStd(h);
  Window fitted{{h.lengthscale_s, grid.first + first * Spacing(grid), size},
                weight_std * posterior.mean.middleRows(first, size),
                {}};
  if (!with_variance) return fitted;
  BandMatrix inverse = posterior.A.InverseInBand();
  fitted.covariance = Eigen::MatrixXd::Zero(size, kSupport);
  for (int k = 0; k < std::min(kSupport, size); ++k)
    fitted.covariance.col(k).head(size - k) =
        weight_std * weight_std * inverse.diagonal(k, first, size - k);
  return fitted;
}

const WindowedGp::Window& WindowedGp::At(double t) const {
  const double k = std::floor((t - begin_) / core_);
  return windows_[static_cast<size_t>(
      std::clamp(k, 0.0, static_cast<double>(windows_.size()) - 1))];
}

WindowedGp::Derivatives WindowedGp::Evaluate(double t) const {
  const Window& window = At(t);
  const int j = FirstBump(window.grid, t);
  return window.weights.middleRows<kSupport>(j).transpose().lazyProduct(Bumps(window.grid, j, t));
}

WindowedGp::Values WindowedGp::Value(double t, double* variance) const {
  const Window& window = At(t);
  const int j = FirstBump(window.grid, t);
  const BumpArray bumps = BumpValues(window.grid, j, t).value;
  if (variance != nullptr) *variance = VarianceOf(window.covariance, j, bumps);
  return window.weights.middleRows<kSupport>(j).transpose().lazyProduct(bumps.matrix());
}

Eigen::Vector3d WindowedGp::Variance(double t) const {
  const Window& window = At(t);
  const int j = FirstBump(window.grid, t);
  const BumpDerivatives B = Bumps(window.grid, j, t);
  Eigen::Vector3d variance;
  for (int k = 0; k < 3; ++k) variance[k] = VarianceOf(window.covariance, j, B.col(k));
  return variance;
}

double LogMarginalLikelihood(const GpData& data, const GpHyperparameters& h,
                             Eigen::Vector3d* gradient) {
  // With K = F F^T + noise^2 I:  log|K| = log|A| + N log noise^2, K^-1 y = (y - F mean) / noise^2,
  // F^T K^-1 y = mean, and for a change dF of F: tr(K^-1 dK) = 2 tr(A^-1 F^T dF) / noise^2.
  const auto n = data.t.size();
  const auto outputs = static_cast<double>(data.y.cols());
  const BumpGrid grid = GridOf(data.t[0], data.t[n - 1], h.lengthscale_s);
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
    const int j = FirstBump(grid, data.t[i]);
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

}  // namespace imu_pose_calib
