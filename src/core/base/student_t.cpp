#include "imu_pose_calib/core/base/student_t.h"

#include <algorithm>
#include <cmath>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/peak.h"

namespace imu_pose_calib {
namespace {

constexpr double kLeastDof = 1.0, kMostDof = 100.0;
constexpr size_t kDofs = 15;      // that are tried, evenly in the logarithm
constexpr int kRounds = 10;       // of the scale, for each
constexpr size_t kEnough = 5000;  // vectors that the degrees of freedom are found from
constexpr double kLeastScale = 1e-6;
constexpr double kNormalMedian = 2.366;  // of the squared norm of a standard normal 3-vector

/// The likeliest scale^2 is a fixed point of this.
double NextScale2(const std::vector<double>& norms2, double dof, double scale2) {
  double sum = 0.0;
  for (const double norm2 : norms2) sum += norm2 / (dof + norm2 / scale2);
  return std::max(kLeastScale * kLeastScale,
                  (dof + 3.0) * sum / (3.0 * static_cast<double>(norms2.size())));
}

/// std::lgamma() writes the sign to a global variable: a race between threads.
double LogGamma(double x) {
  int sign = 0;
  return lgamma_r(x, &sign);
}

double LogLikelihood(const std::vector<double>& norms2, double dof, double scale2) {
  double sum = 0.0;
  for (const double norm2 : norms2) sum += std::log1p(norm2 / (dof * scale2));
  return static_cast<double>(norms2.size()) *
             (LogGamma(0.5 * (dof + 3.0)) - LogGamma(0.5 * dof) - 1.5 * std::log(dof * scale2)) -
         0.5 * (dof + 3.0) * sum;
}

}  // namespace

StudentT FitStudentT(const std::vector<Eigen::Vector3d>& x) {
  std::vector<double> all, some;
  const size_t stride = 1 + x.size() / kEnough;
  for (size_t i = 0; i < x.size(); ++i) {
    all.push_back(x[i].squaredNorm());
    if (i % stride == 0) some.push_back(all.back());
  }
  double scale2 = std::max(kLeastScale * kLeastScale, Median(some) / kNormalMedian);
  const auto fit = [](const std::vector<double>& norms2, double dof, double* scale2) {
    for (int round = 0; round < kRounds; ++round) *scale2 = NextScale2(norms2, dof, *scale2);
  };
  const auto dof_at = [](double k) {
    return kMostDof * std::pow(kLeastDof / kMostDof, k / (kDofs - 1.0));
  };
  std::vector<double> likelihoods;  // the last of them beyond the peak
  size_t peak = 0;
  for (size_t k = 0; k < kDofs && peak + 1 >= k; ++k) {
    fit(some, dof_at(static_cast<double>(k)), &scale2);
    likelihoods.push_back(LogLikelihood(some, dof_at(static_cast<double>(k)), scale2));
    if (likelihoods[k] > likelihoods[peak]) peak = k;
  }
  double at = static_cast<double>(peak);
  if (peak > 0 && peak + 1 < likelihoods.size())
    at += PeakOffset(likelihoods[peak - 1], likelihoods[peak], likelihoods[peak + 1]);
  fit(all, dof_at(at), &scale2);
  return {std::sqrt(scale2), dof_at(at)};
}

}  // namespace imu_pose_calib
