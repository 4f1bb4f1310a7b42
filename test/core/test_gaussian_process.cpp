#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <cmath>
#include <random>

#include "imu_pose_calib/core/trajectory/gaussian_process.h"

namespace imu_pose_calib {
namespace {

/// The textbook: dense kernel matrices of the whole log and its derivatives by both arguments.
class DenseGp {
 public:
  DenseGp(const GpData& data, const GpHyperparameters& h) : data_(data), h_(h) {
    const auto n = data.t.size();
    K_.resize(n, n);
    for (Eigen::Index i = 0; i < n; ++i)
      for (Eigen::Index j = 0; j < n; ++j) K_(i, j) = Kernel(data.t[i], data.t[j], 0);
    K_.diagonal().array() += h.noise_std * h.noise_std;
    llt_.compute(K_);
    alpha_ = llt_.solve(data.y);
  }

  Eigen::VectorXd Mean(double t, int derivative) const {
    return alpha_.transpose() * KernelRow(t, derivative);
  }

  double Variance(double t, int derivative) const {
    const double l2 = h_.lengthscale_s * h_.lengthscale_s;
    const double prior[] = {1.0, 1.0 / l2, 3.0 / (l2 * l2)};
    const Eigen::VectorXd k = KernelRow(t, derivative);
    return h_.signal_std * h_.signal_std * prior[derivative] - k.dot(llt_.solve(k));
  }

  double LogLikelihood() const {
    const auto n = static_cast<double>(data_.t.size());
    const double log_det = 2.0 * llt_.matrixLLT().diagonal().array().log().sum();
    return -0.5 * (data_.y.cwiseProduct(alpha_)).sum() -
           0.5 * static_cast<double>(data_.y.cols()) * (log_det + n * std::log(2.0 * M_PI));
  }

 private:
  double Kernel(double t, double u, int derivative) const {
    const double l = h_.lengthscale_s;
    const double z = (t - u) / l;
    const double k = h_.signal_std * h_.signal_std * std::exp(-0.5 * z * z);
    switch (derivative) {
      case 0:
        return k;
      case 1:
        return -z / l * k;
      case 2:
        return (z * z - 1.0) / (l * l) * k;
      default:
        return (3.0 - z * z) * z / (l * l * l) * k;
    }
  }
  Eigen::VectorXd KernelRow(double t, int derivative) const {
    Eigen::VectorXd k(data_.t.size());
    for (Eigen::Index i = 0; i < k.size(); ++i) k[i] = Kernel(t, data_.t[i], derivative);
    return k;
  }

  GpData data_;
  GpHyperparameters h_;
  Eigen::MatrixXd K_, alpha_;
  Eigen::LLT<Eigen::MatrixXd> llt_;
};

/// Hand-held motion of about 0.3 m with `noise` [m].
GpData Measure(double duration, double rate, double noise, uint32_t seed) {
  std::mt19937 random(seed);
  std::normal_distribution<double> normal(0.0, noise);
  std::uniform_real_distribution<double> jitter(-0.2, 0.2);
  const auto n = static_cast<Eigen::Index>(duration * rate);
  GpData data{Eigen::VectorXd(n), Eigen::MatrixXd(n, 3)};
  for (Eigen::Index i = 0; i < n; ++i) {
    const double t = (static_cast<double>(i) + jitter(random)) / rate;
    data.t[i] = t;
    data.y.row(i) << 0.3 * std::sin(2.1 * t) + 0.05 * std::sin(7.3 * t + 1.0) + normal(random),
        0.2 * std::cos(3.3 * t) + normal(random), 0.25 * std::sin(1.3 * t + 0.4) + normal(random);
  }
  return data;
}

/// IMU noise per sample of the simulated bags: both must agree to well under it.
constexpr double kAccelNoise = 0.02;

TEST(GaussianProcess, EqualsTheDenseGpOfTheWholeLog) {
  const GpData data = Measure(60.0, 25.0, 1e-3, 1);
  const GpHyperparameters h{0.15, 0.4, 1e-3};
  const GaussianProcess gp(data, h);
  const DenseGp dense(data, h);
  for (int i = 0; i < 1000; ++i) {
    const double t = data.t[0] + (data.t[data.t.size() - 1] - data.t[0]) * i / 999.0;
    const Eigen::Matrix<double, 3, 4> mean = gp.Evaluate(t).topRows<3>();
    EXPECT_LT((mean.col(0) - dense.Mean(t, 0)).norm(), 1e-7) << "t = " << t;
    EXPECT_LT((mean.col(1) - dense.Mean(t, 1)).norm(), 1e-5) << "t = " << t;
    EXPECT_LT((mean.col(2) - dense.Mean(t, 2)).norm(), 0.01 * kAccelNoise) << "t = " << t;
    EXPECT_LT((mean.col(3) - dense.Mean(t, 3)).norm(), 0.2 * kAccelNoise) << "t = " << t;
    const Eigen::Vector3d variance = gp.Variance(t);
    for (int k = 0; k < 3; ++k)
      EXPECT_NEAR(std::sqrt(variance[k] / dense.Variance(t, k)), 1.0, 1e-3) << t << " " << k;
  }
}

TEST(GaussianProcess, EachDerivativeIsTheSlopeOfTheOneBefore) {
  const GaussianProcess gp(Measure(10.0, 100.0, 1e-3, 3), {0.2, 0.4, 1e-3});
  const double step = 1e-4;
  for (double t = 0.5; t < 9.5; t += 0.317) {
    const auto slope = ((gp.Evaluate(t + step) - gp.Evaluate(t - step)) / (2.0 * step)).eval();
    const auto at = gp.Evaluate(t);
    for (int k = 0; k < 3; ++k)
      EXPECT_LT((slope.col(k) - at.col(k + 1)).norm(), 1e-5 * std::max(1.0, at.col(k + 1).norm()))
          << "t = " << t << ", derivative " << k + 1;
  }
}

TEST(GaussianProcess, ErrorsAgreeWithTheVariance) {
  // Draws from the prior itself, so that the model holds: errors at unseen instants, normalised.
  const GpHyperparameters h{0.2, 0.4, 1e-3};
  std::mt19937 random(4);
  std::normal_distribution<double> normal;
  const Eigen::Index n = 600;
  Eigen::VectorXd t = Eigen::VectorXd::LinSpaced(2 * n, 0.0, 6.0);
  Eigen::MatrixXd K(2 * n, 2 * n);
  for (Eigen::Index i = 0; i < 2 * n; ++i)
    for (Eigen::Index j = 0; j < 2 * n; ++j)
      K(i, j) = 0.16 * std::exp(-0.5 * std::pow((t[i] - t[j]) / 0.2, 2)) + (i == j ? 1e-10 : 0.0);
  const Eigen::MatrixXd L = K.llt().matrixL();
  double sum = 0.0;
  int count = 0;
  for (int draw = 0; draw < 20; ++draw) {
    const Eigen::MatrixXd truth =
        L * Eigen::MatrixXd::NullaryExpr(2 * n, 3, [&] { return normal(random); });
    GpData data{Eigen::VectorXd(n), Eigen::MatrixXd(n, 3)};
    for (Eigen::Index i = 0; i < n; ++i) {
      data.t[i] = t[2 * i];
      for (int k = 0; k < 3; ++k) data.y(i, k) = truth(2 * i, k) + 1e-3 * normal(random);
    }
    const GaussianProcess gp(data, h);
    for (Eigen::Index i = 20; i < n - 20; i += 20) {
      const double at = t[2 * i + 1];
      sum += (gp.Evaluate(at).col(0).head<3>() - truth.row(2 * i + 1).transpose()).squaredNorm() /
             gp.Variance(at)[0];
      count += 3;
    }
  }
  EXPECT_NEAR(sum / count, 1.0, 0.15);
}

TEST(MarginalLikelihood, EqualsTheDenseFormula) {
  const GpData data = Measure(4.0, 60.0, 2e-3, 5);
  for (const double l : {0.08, 0.15, 0.4}) {
    const GpHyperparameters h{l, 0.3, 2e-3};
    EXPECT_NEAR(LogMarginalLikelihood(data, h, nullptr), DenseGp(data, h).LogLikelihood(), 1e-2);
  }
}

TEST(MarginalLikelihood, GradientIsTheSlope) {
  const GpData data = Measure(4.0, 60.0, 2e-3, 6);
  const Eigen::Vector3d x0(std::log(0.17), std::log(0.3), std::log(1.5e-3));
  const auto likelihood = [&](const Eigen::Vector3d& x, Eigen::Vector3d* gradient) {
    return LogMarginalLikelihood(data, {std::exp(x[0]), std::exp(x[1]), std::exp(x[2])}, gradient);
  };
  Eigen::Vector3d gradient;
  likelihood(x0, &gradient);
  for (int k = 0; k < 3; ++k) {
    const Eigen::Vector3d step = 1e-4 * Eigen::Vector3d::Unit(k);
    const double slope = (likelihood(x0 + step, nullptr) - likelihood(x0 - step, nullptr)) / 2e-4;
    EXPECT_NEAR(gradient[k], slope, 1e-3 * std::max(1.0, std::abs(slope))) << "parameter " << k;
  }
}

TEST(FitHyperparameters, FindsTheNoiseAndKeepsWhatIsFixed) {
  const GpData data = Measure(10.0, 100.0, 2e-3, 7);
  const GpHyperparameters h = FitHyperparameters({data}, {});
  EXPECT_NEAR(h.noise_std, 2e-3, 1e-4);
  EXPECT_GT(h.lengthscale_s, 0.1);
  EXPECT_LT(h.lengthscale_s, 1.0);
  EXPECT_DOUBLE_EQ(FitHyperparameters({data}, {0.3, 0.0, 0.0}).lengthscale_s, 0.3);
  // No neighbour is more likely.
  const double best = LogMarginalLikelihood(data, h, nullptr);
  for (const double factor : {0.8, 1.25}) {
    const GpHyperparameters l{factor * h.lengthscale_s, h.signal_std, h.noise_std};
    const GpHyperparameters s{h.lengthscale_s, factor * h.signal_std, h.noise_std};
    const GpHyperparameters n{h.lengthscale_s, h.signal_std, factor * h.noise_std};
    for (const GpHyperparameters& other : {l, s, n})
      EXPECT_LT(LogMarginalLikelihood(data, other, nullptr), best);
  }
}

}  // namespace
}  // namespace imu_pose_calib
