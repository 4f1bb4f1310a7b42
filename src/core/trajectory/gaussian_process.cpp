#include "imu_pose_calib/core/trajectory/gaussian_process.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "imu_pose_calib/core/base/dense.h"

namespace imu_pose_calib {
namespace {

constexpr double kSpacing = 0.4;  // [length scales] between bumps: kernel error 2 exp(-31)
constexpr int kHalfSupport = 13;
constexpr int kSupport = 2 * kHalfSupport;  // bumps around one instant: the others are below 2e-12
constexpr int kTile = 26;
static_assert(kTile >= kSupport, "a bump must not reach beyond the next tile");

double Spacing(const BumpGrid& grid) { return kSpacing * grid.lengthscale; }

/// First of the kSupport bumps around t.
int FirstBump(const BumpGrid& grid, double t) {
  const int j = static_cast<int>(std::floor((t - grid.first) / Spacing(grid))) - kHalfSupport + 1;
  return std::clamp(j, 0, grid.size - kSupport);
}

/// Grid of whole tiles that serves all of t.
BumpGrid GridOf(const Eigen::VectorXd& t, double lengthscale_s) {
  const double spacing = kSpacing * lengthscale_s, duration = t[t.size() - 1] - t[0];
  const int size = static_cast<int>(std::floor(duration / spacing)) + kSupport + 1;
  return {lengthscale_s, t[0] - kHalfSupport * spacing, (size + kTile - 1) / kTile * kTile};
}

using BumpArray = Eigen::Array<double, kSupport, 1>;
using BumpDerivatives = Eigen::Matrix<double, 4, kSupport>;

/// Distances z_j = (t - c_j) / l of the bumps around t and their values exp(-z_j^2).
struct BumpValues {
  BumpArray distance, value;

  BumpValues(const BumpGrid& grid, int first_bump, double t) {
    // exp(-(z - j d)^2) = exp(-z^2) exp(2 z d)^j exp(-(j d)^2), j counted from the middle: two
    // calls of exp instead of 26, in the innermost loop of every solve.
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
  B.row(0) = bump;
  B.row(1) = -2.0 / l * z * bump;
  B.row(2) = (4.0 * z.square() - 2.0) / (l * l) * bump;
  B.row(3) = (12.0 - 8.0 * z.square()) * z / (l * l * l) * bump;
  return B;
}

/// Prior standard deviation of a bump weight: k = sum_j weight_std^2 bump_j bump_j.
double WeightStd(const GpHyperparameters& h) {
  return h.signal_std * std::sqrt(kSpacing * std::sqrt(2.0 / M_PI));
}

/// A symmetric matrix of bumps, whose elements further than kSupport from the diagonal do not
/// matter: for each tile, its block of 2 kTile rows and columns. Bumps that reach one instant are
/// in one of these blocks.
using Band = std::vector<Eigen::MatrixXd>;

/// Of the bumps from `bump` on that reach one instant.
template <typename AnyBand>
auto BlockOf(AnyBand& band, int bump) {
  return band[static_cast<size_t>(bump / kTile)].block(bump % kTile, bump % kTile, kSupport,
                                                       kSupport);
}

/// Cholesky factor of a matrix which is the sum of the blocks of a Band, of which the lower
/// triangle is read; of the last one only the first tile.
class BandedCholesky {
 public:
  explicit BandedCholesky(Band A) : blocks_(std::move(A)) {
    for (size_t k = 0; k < blocks_.size(); ++k) {
      Factor(Diagonal(k), Below(k));
      if (k + 1 == blocks_.size()) break;
      Diagonal(k + 1) += blocks_[k].bottomRightCorner<kTile, kTile>();
      AddProduct(-1.0, Below(k), Below(k), true, Diagonal(k + 1));
    }
  }

  double LogDeterminant() {
    double sum = 0.0;
    for (size_t k = 0; k < blocks_.size(); ++k) sum += Diagonal(k).diagonal().array().log().sum();
    return 2.0 * sum;
  }

  Eigen::MatrixXd Solve(Eigen::MatrixXd b) {
    const auto tile = [&b](size_t k) {
      return b.middleRows<kTile>(kTile * static_cast<Eigen::Index>(k));
    };
    for (size_t k = 0; k < blocks_.size(); ++k) {
      auto x = tile(k);
      if (k > 0) x.noalias() -= Below(k - 1) * tile(k - 1);
      Diagonal(k).triangularView<Eigen::Lower>().solveInPlace(x);
    }
    for (size_t k = blocks_.size(); k-- > 0;) {
      auto x = tile(k);
      if (k + 1 < blocks_.size()) x.noalias() -= Below(k).transpose() * tile(k + 1);
      Diagonal(k).triangularView<Eigen::Lower>().transpose().solveInPlace(x);
    }
    return b;
  }

  /// From the last tile up, with G = L_below L_ii^-1:
  ///   S_below,i = -S_below G,  S_ii = (L_ii L_ii^T)^-1 + G^T S_below G.
  Band Inverse() {
    Band S(blocks_.size(), Eigen::MatrixXd::Zero(2 * kTile, 2 * kTile));
    for (size_t k = blocks_.size(); k-- > 0;) {
      auto own = S[k].topLeftCorner<kTile, kTile>();
      auto right = S[k].topRightCorner<kTile, kTile>();
      auto later = S[k].bottomRightCorner<kTile, kTile>();
      if (k + 1 < blocks_.size()) later = S[k + 1].topLeftCorner<kTile, kTile>();
      Eigen::MatrixXd inverse = Eigen::MatrixXd::Identity(kTile, kTile);
      Diagonal(k).triangularView<Eigen::Lower>().solveInPlace(inverse);
      const Eigen::MatrixXd inverse_T = inverse.transpose();
      Eigen::MatrixXd G_T = Eigen::MatrixXd::Zero(kTile, kTile);
      AddProduct(1.0, inverse_T, inverse_T, false, own);
      AddProduct(1.0, inverse_T, Below(k), false, G_T);
      AddProduct(-1.0, G_T, later, false, right);
      AddProduct(-1.0, G_T, right, false, own);
      S[k].bottomLeftCorner<kTile, kTile>() = right.transpose();
    }
    return S;
  }

 private:
  using Tile = Eigen::Block<Eigen::MatrixXd, kTile, kTile>;
  Tile Diagonal(size_t k) { return blocks_[k].topLeftCorner<kTile, kTile>(); }
  Tile Below(size_t k) { return blocks_[k].bottomLeftCorner<kTile, kTile>(); }

  Band blocks_;
};

/// Bumps around neighbouring measurements, from `begin` on, that share those from `bump` on: one
/// product for all of them.
struct BumpGroup {
  using Columns = Eigen::Matrix<double, kSupport, kTile>;
  Eigen::Index begin, count;
  int bump;
  Columns distance, value;
};

/// act(group) of all measurements.
template <typename Act>
void ForEachGroup(const Eigen::VectorXd& t, const BumpGrid& grid, const Act& act) {
  BumpGroup group;
  for (Eigen::Index i = 0; i < t.size(); i += group.count) {
    group.begin = i;
    group.bump = FirstBump(grid, t[i]);
    group.count = 0;
    for (; i + group.count < t.size() && group.count < kTile; ++group.count) {
      if (FirstBump(grid, t[i + group.count]) != group.bump) break;
      const BumpValues bumps(grid, group.bump, t[i + group.count]);
      group.distance.col(group.count) = bumps.distance;
      group.value.col(group.count) = bumps.value;
    }
    act(group);
  }
}

/// Posterior of unit-variance bump weights given the data:
///   A = I + F^T F / noise^2, mean = A^-1 F^T y / noise^2, with F = weight_std * bumps.
struct WeightPosterior {
  BandedCholesky A;
  Eigen::MatrixXd mean;
};

WeightPosterior FitWeights(const GpData& data, const BumpGrid& grid, const GpHyperparameters& h) {
  Band A(static_cast<size_t>(grid.size / kTile), Eigen::MatrixXd::Zero(2 * kTile, 2 * kTile));
  Eigen::MatrixXd b = Eigen::MatrixXd::Zero(grid.size, data.y.cols());
  const Eigen::VectorXd all = data.noise_scale.size() > 0 ? data.noise_scale.cwiseInverse().eval()
                                                          : Eigen::VectorXd::Ones(data.t.size());
  ForEachGroup(data.t, grid, [&](const BumpGroup& group) {
    const auto per_noise = all.segment(group.begin, group.count).asDiagonal();
    Eigen::MatrixXd F = group.value.leftCols(group.count) * per_noise;
    AddProduct(1.0, F, F, true, BlockOf(A, group.bump));
    F *= per_noise;
    b.middleRows<kSupport>(group.bump).noalias() += F * data.y.middleRows(group.begin, group.count);
  });
  const double weight_std = WeightStd(h);
  for (Eigen::MatrixXd& block : A) {
    block *= std::pow(weight_std / h.noise_std, 2);
    block.diagonal().head<kTile>().array() += 1.0;
  }
  b *= weight_std / (h.noise_std * h.noise_std);
  WeightPosterior posterior{BandedCholesky(std::move(A)), {}};
  posterior.mean = posterior.A.Solve(std::move(b));
  return posterior;
}

}  // namespace

GaussianProcess::GaussianProcess(const GpData& data, const GpHyperparameters& h, bool with_variance)
    : grid_(GridOf(data.t, h.lengthscale_s)) {
  WeightPosterior posterior = FitWeights(data, grid_, h);
  const double weight_std = WeightStd(h);
  weights_.setZero(4, grid_.size);
  weights_.topRows(data.y.cols()) = weight_std * posterior.mean.transpose();
  if (!with_variance) return;
  covariance_ = posterior.A.Inverse();
  for (Eigen::MatrixXd& block : covariance_) block *= weight_std * weight_std;
}

GaussianProcess::Derivatives GaussianProcess::Evaluate(double t) const {
  const int j = FirstBump(grid_, t);
  Derivatives mean = Derivatives::Zero();
  AddProduct(1.0, weights_.middleCols<kSupport>(j), Bumps(grid_, j, t), false, mean);
  return mean;
}

Eigen::Vector4d GaussianProcess::Value(double t) const {
  const int j = FirstBump(grid_, t);
  return weights_.middleCols<kSupport>(j).lazyProduct(BumpValues(grid_, j, t).value.matrix());
}

Eigen::Vector3d GaussianProcess::Variance(double t) const {
  const int j = FirstBump(grid_, t);
  const BumpDerivatives B = Bumps(grid_, j, t);
  Eigen::Matrix<double, kSupport, 3> S_B = decltype(S_B)::Zero();
  AddProduct(1.0, BlockOf(covariance_, j), B.topRows<3>(), false, S_B);
  return B.topRows<3>().transpose().cwiseProduct(S_B).colwise().sum();
}

double LogMarginalLikelihood(const GpData& data, const GpHyperparameters& h,
                             Eigen::Vector3d* gradient) {
  // With K = F F^T + noise^2 I:  log|K| = log|A| + N log noise^2, K^-1 y = (y - F mean) / noise^2,
  // F^T K^-1 y = mean, and for a change dF of F: tr(K^-1 dK) = 2 tr(A^-1 F^T dF) / noise^2.
  const auto n = data.t.size();
  const auto outputs = static_cast<double>(data.y.cols());
  const BumpGrid grid = GridOf(data.t, h.lengthscale_s);
  WeightPosterior posterior = FitWeights(data, grid, h);
  const double noise2 = h.noise_std * h.noise_std;
  const double weight_std = WeightStd(h);

  double length_fit = 0.0, tr_length = 0.0, residual_norm2 = 0.0;
  Band inverse;  // of A
  if (gradient != nullptr) inverse = posterior.A.Inverse();
  ForEachGroup(data.t, grid, [&](const BumpGroup& group) {
    const Eigen::MatrixXd f = weight_std * group.value.leftCols(group.count);
    const auto mean = posterior.mean.middleRows<kSupport>(group.bump);
    const Eigen::MatrixXd residual =
        data.y.middleRows(group.begin, group.count) - f.transpose() * mean;
    residual_norm2 += residual.squaredNorm();
    if (gradient == nullptr) return;
    // d F / d log l; the 1/2 is the change of weight_std per length of a fixed grid.
    const Eigen::MatrixXd df =
        f.array() * (2.0 * group.distance.leftCols(group.count).array().square() - 0.5);
    length_fit += residual.cwiseProduct(df.transpose() * mean).sum() / noise2;
    Eigen::MatrixXd product = Eigen::MatrixXd::Zero(kSupport, group.count);
    AddProduct(1.0, BlockOf(inverse, group.bump), f.transpose(), false, product);
    tr_length += product.cwiseProduct(df).sum() / noise2;
  });
  const double fit = posterior.mean.squaredNorm() + residual_norm2 / noise2;
  const double log_likelihood =
      -0.5 * fit -
      0.5 * outputs *
          (posterior.A.LogDeterminant() + static_cast<double>(n) * std::log(2.0 * M_PI * noise2));

  if (gradient != nullptr) {
    double trace_A_inv = 0.0;
    for (const Eigen::MatrixXd& block : inverse)
      trace_A_inv += block.diagonal().head<kTile>().sum();
    const double m = grid.size;
    (*gradient)[0] = length_fit - outputs * tr_length;
    (*gradient)[1] = posterior.mean.squaredNorm() - outputs * (m - trace_A_inv);
    (*gradient)[2] = residual_norm2 / noise2 - outputs * (static_cast<double>(n) - m + trace_A_inv);
  }
  return log_likelihood;
}

}  // namespace imu_pose_calib
