#include "imu_pose_calib/core/initializer.h"

#include <Eigen/Cholesky>
#include <Eigen/SVD>
#include <algorithm>
#include <cmath>
#include <complex>
#include <limits>
#include <sstream>
#include <unsupported/Eigen/FFT>

#include "imu_pose_calib/core/so3.h"

namespace imu_pose_calib {
namespace {

constexpr double kBin = 0.01;              // [s] of the correlated signals
constexpr double kGuessWindow = 1.0;       // [s] searched around a given time shift
constexpr int kCandidates = 6;             // correlation peaks tried on all three axes
constexpr double kMinPeakDistance = 0.15;  // [s] between them
constexpr double kMinExplained = 0.5;      // of the gyro's variance
constexpr size_t kMaxSamples = 4000;       // per closed-form fit: more does not change a start
constexpr double kDelaySearch = 0.1;       // [s]
constexpr double kDelayStep = 0.01;        // [s]
constexpr double kAccelBiasPrior = 1.0;    // [m/s^2] keeps bias and gravity apart at small turns

/// A signal in bins of kBin; bins without a sample have weight 0.
struct Signal {
  std::vector<double> value, weight;

  explicit Signal(size_t bins) : value(bins, 0.0), weight(bins, 0.0) {}
  void Add(size_t bin, double x) {
    value[bin] += x;
    weight[bin] += 1.0;
  }
  void Average() {
    for (size_t i = 0; i < value.size(); ++i) {
      if (weight[i] == 0.0) continue;
      value[i] /= weight[i];
      weight[i] = 1.0;
    }
  }
  std::vector<double> Power(int exponent) const {
    std::vector<double> x(weight);
    for (size_t i = 0; i < x.size(); ++i) x[i] *= std::pow(value[i], exponent);
    return x;
  }
};

/// Pearson correlation of two masked signals at every lag, by FFT.
class MaskedCorrelation {
 public:
  MaskedCorrelation(const Signal& x, const Signal& y) : bins_(x.value.size() + y.value.size()) {
    size_ = 1;
    while (size_ < bins_) size_ *= 2;
    std::vector<std::vector<std::complex<double>>> X, Y;
    for (int exponent = 0; exponent < 3; ++exponent) {
      X.push_back(Spectrum(x.Power(exponent)));
      Y.push_back(Spectrum(y.Power(exponent)));
    }
    n_ = Correlate(X[0], Y[0]);
    x_ = Correlate(X[1], Y[0]);
    xx_ = Correlate(X[2], Y[0]);
    y_ = Correlate(X[0], Y[1]);
    yy_ = Correlate(X[0], Y[2]);
    xy_ = Correlate(X[1], Y[1]);
  }

  /// Common bins when y is moved by `lag` bins.
  double Count(ptrdiff_t lag) const { return std::round(n_[Wrap(lag)]); }

  double At(ptrdiff_t lag) const {
    const size_t i = Wrap(lag);
    const double n = n_[i];
    const double vx = xx_[i] - x_[i] * x_[i] / n;
    const double vy = yy_[i] - y_[i] * y_[i] / n;
    if (vx <= 1e-9 * xx_[i] || vy <= 1e-9 * yy_[i]) return 0.0;
    return (xy_[i] - x_[i] * y_[i] / n) / std::sqrt(vx * vy);
  }

 private:
  std::vector<std::complex<double>> Spectrum(std::vector<double> x) {
    x.resize(size_, 0.0);
    std::vector<std::complex<double>> X;
    fft_.fwd(X, x);
    return X;
  }
  std::vector<double> Correlate(const std::vector<std::complex<double>>& X,
                                const std::vector<std::complex<double>>& Y) {
    std::vector<std::complex<double>> Z(X.size());
    for (size_t i = 0; i < X.size(); ++i) Z[i] = X[i] * std::conj(Y[i]);
    std::vector<double> z;
    fft_.inv(z, Z);
    return z;
  }
  size_t Wrap(ptrdiff_t lag) const {
    return static_cast<size_t>(lag < 0 ? lag + static_cast<ptrdiff_t>(size_) : lag);
  }

  Eigen::FFT<double> fft_;
  size_t bins_, size_;
  std::vector<double> n_, x_, xx_, y_, yy_, xy_;
};

/// Every k-th element so that about kMaxSamples remain.
size_t Stride(size_t size) { return std::max<size_t>(1, size / kMaxSamples); }

/// log likelihood ratio of a correlation over n bins: long and close overlaps win.
double Evidence(double correlation, double n) {
  const double r = std::clamp(correlation, 0.0, 0.9999);
  return -0.5 * n * std::log(1.0 - r * r);
}

std::string RateMismatch(const RateAlignment& best) {
  std::ostringstream text;
  text << "the turn rates of poses and gyroscope agree at no time shift (best explains "
       << 100.0 * std::max(0.0, best.explained)
       << " % of the gyroscope's variance, bound: " << 100.0 * kMinExplained
       << " %): do both recordings overlap, and are both of the same rigid body?";
  return text.str();
}

void CheckGyroUnit(const RateAlignment& alignment) {
  if (alignment.scale > 0.5 && alignment.scale < 2.0) return;
  std::ostringstream text;
  text << "gyroscope: its rates are " << alignment.scale << " times the marker's (bound: 0.5 to 2)";
  if (alignment.scale > 40.0 && alignment.scale < 80.0)
    text << "; it looks like deg/s: convert to rad/s";
  throw DataError(text.str());
}

}  // namespace

std::vector<double> FindTimeShifts(const PoseTrajectory& trajectory,
                                   const std::vector<TimedPose>& poses,
                                   const std::vector<TimedSample>& gyro,
                                   double min_overlap_s,
                                   const std::optional<double>& guess,
                                   int count) {
  const auto bins = [](double duration) { return static_cast<size_t>(duration / kBin) + 1; };
  Signal marker(bins(poses.back().t));
  for (size_t i = 0; i < marker.value.size(); ++i) {
    MarkerState<double> state;
    if (trajectory.Evaluate((static_cast<double>(i) + 0.5) * kBin, &state))
      marker.Add(i, state.omega_M.norm());
  }
  const double gyro_begin = gyro.front().t;
  Signal imu(bins(gyro.back().t - gyro_begin));
  for (const TimedSample& s : gyro)
    imu.Add(static_cast<size_t>((s.t - gyro_begin) / kBin), s.value.norm());
  imu.Average();

  const MaskedCorrelation correlation(marker, imu);
  const auto shift = [&](double lag) { return lag * kBin - gyro_begin; };
  const auto score = [&](ptrdiff_t lag) {
    if (correlation.Count(lag) * kBin < min_overlap_s) return 0.0;
    if (guess && std::abs(shift(static_cast<double>(lag)) - *guess) > kGuessWindow) return 0.0;
    return Evidence(correlation.At(lag), correlation.Count(lag));
  };

  std::vector<std::pair<double, ptrdiff_t>> peaks;
  const auto first = 1 - static_cast<ptrdiff_t>(imu.value.size());
  const auto last = static_cast<ptrdiff_t>(marker.value.size()) - 1;
  for (ptrdiff_t lag = first; lag <= last; ++lag) {
    const double s = score(lag);
    if (s > 0.0 && (lag == first || s >= score(lag - 1)) && (lag == last || s > score(lag + 1)))
      peaks.emplace_back(s, lag);
  }
  std::sort(peaks.rbegin(), peaks.rend());

  std::vector<double> shifts;
  for (const auto& [evidence, lag] : peaks) {
    if (static_cast<int>(shifts.size()) == count) break;
    double offset = 0.0;  // vertex of the parabola through the peak and its neighbours
    if (lag > first && lag < last) {
      const double a = correlation.At(lag - 1), b = correlation.At(lag),
                   c = correlation.At(lag + 1);
      if (2.0 * b - a - c > 1e-12)
        offset = std::clamp(0.5 * (c - a) / (2.0 * b - a - c), -0.5, 0.5);
    }
    const double candidate = shift(static_cast<double>(lag) + offset);
    const auto is_near = [&](double s) { return std::abs(s - candidate) < kMinPeakDistance; };
    if (std::none_of(shifts.begin(), shifts.end(), is_near)) shifts.push_back(candidate);
  }
  return shifts;
}

RateAlignment AlignRates(const PoseTrajectory& trajectory,
                         const std::vector<TimedSample>& gyro,
                         double time_shift) {
  std::vector<std::pair<Eigen::Vector3d, Eigen::Vector3d>> rates;  // marker in M, gyro in I
  Eigen::Vector3d mean_M = Eigen::Vector3d::Zero(), mean_I = Eigen::Vector3d::Zero();
  for (size_t i = 0; i < gyro.size(); i += Stride(gyro.size())) {
    MarkerState<double> state;
    if (!trajectory.Evaluate(gyro[i].t + time_shift, &state)) continue;
    rates.emplace_back(state.omega_M, gyro[i].value);
    mean_M += state.omega_M;
    mean_I += gyro[i].value;
  }
  RateAlignment alignment;
  alignment.count = rates.size();
  if (rates.size() < 10) return alignment;
  mean_M /= static_cast<double>(rates.size());
  mean_I /= static_cast<double>(rates.size());

  Eigen::Matrix3d H = Eigen::Matrix3d::Zero();
  double sum_M = 0.0, sum_I = 0.0;
  for (const auto& [omega_M, gyro_I] : rates) {
    H += (omega_M - mean_M) * (gyro_I - mean_I).transpose();
    sum_M += (omega_M - mean_M).squaredNorm();
    sum_I += (gyro_I - mean_I).squaredNorm();
  }
  const Eigen::JacobiSVD<Eigen::Matrix3d> svd(H, Eigen::ComputeFullU | Eigen::ComputeFullV);
  const Eigen::Vector3d signs(1.0, 1.0, (svd.matrixU() * svd.matrixV()).determinant());
  const Eigen::Matrix3d R_MI = svd.matrixU() * signs.asDiagonal() * svd.matrixV().transpose();
  alignment.q_MI = Eigen::Quaterniond(R_MI);
  alignment.gyro_bias = mean_I - R_MI.transpose() * mean_M;
  alignment.scale = std::sqrt(sum_I / std::max(sum_M, 1e-12));
  // |gyro - R^T omega|^2 with the gyro scaled to the marker's size: 1 - correlation^2.
  const double correlation =
      (R_MI.transpose() * H).trace() / std::sqrt(std::max(sum_M * sum_I, 1e-24));
  alignment.explained = correlation * std::abs(correlation);
  return alignment;
}

namespace {

/// Gravity is estimated without knowing its magnitude: another one means another unit or none.
void CheckGravity(double estimated, double expected) {
  if (estimated > 0.5 * expected && estimated < 2.0 * expected) return;
  std::ostringstream text;
  text << "accelerometer: it shows a gravity of " << estimated
       << " m/s^2 (bound: " << 0.5 * expected << " to " << 2.0 * expected << " m/s^2); ";
  if (estimated < 0.5 * expected) text << "is gravity removed? Record the raw accelerometer";
  if (estimated > 2.0 * expected) text << "is its unit m/s^2?";
  throw DataError(text.str());
}

/// Linear least squares for x = (p_MI, g_W, R_MI b_a) at a given delay:
///   R_MI f - R_WM^T a_W = ([alpha]x + [omega]x [omega]x) p_MI - R_WM^T g_W + R_MI b_a.
/// Returns the mean squared residual.
double SolveLeverArm(const PoseTrajectory& trajectory,
                     const std::vector<TimedSample>& accel,
                     const Start& start,
                     double delay,
                     Eigen::Matrix<double, 9, 1>* x) {
  using Matrix9d = Eigen::Matrix<double, 9, 9>;
  const Eigen::Matrix3d R_MI = start.q_MI.toRotationMatrix();
  Matrix9d A = Matrix9d::Zero();
  A.bottomRightCorner<3, 3>().diagonal().setConstant(1.0 / (kAccelBiasPrior * kAccelBiasPrior));
  Eigen::Matrix<double, 9, 1> b = Eigen::Matrix<double, 9, 1>::Zero();
  double sum = 0.0, count = 0.0;
  for (size_t i = 0; i < accel.size(); i += Stride(accel.size())) {
    MarkerState<double> state;
    if (!trajectory.Evaluate(accel[i].t + start.time_shift - delay, &state)) continue;
    const Eigen::Matrix3d R_MW = state.q_WM.conjugate().toRotationMatrix();
    const Eigen::Matrix3d W = Hat(state.omega_M);
    Eigen::Matrix<double, 3, 9> J;
    J << Hat(state.alpha_M) + W * W, -R_MW, Eigen::Matrix3d::Identity();
    const Eigen::Vector3d y = R_MI * accel[i].value - R_MW * state.a_W;
    A += J.transpose() * J;
    b += J.transpose() * y;
    sum += y.squaredNorm();
    count += 1.0;
  }
  *x = A.ldlt().solve(b);
  return count > 0.0 ? (sum - b.dot(*x)) / count : std::numeric_limits<double>::infinity();
}

}  // namespace

void FitLeverArm(const PoseTrajectory& trajectory,
                 const std::vector<TimedSample>& accel,
                 double gravity_magnitude,
                 bool estimate_delay,
                 Start* start) {
  Eigen::Matrix<double, 9, 1> best;
  double best_delay = start->accel_delay;
  double lowest = SolveLeverArm(trajectory, accel, *start, best_delay, &best);
  const int steps = estimate_delay ? static_cast<int>(std::round(kDelaySearch / kDelayStep)) : -1;
  for (int k = -steps; k <= steps; ++k) {
    Eigen::Matrix<double, 9, 1> x;
    const double delay = start->accel_delay + k * kDelayStep;
    const double residual = SolveLeverArm(trajectory, accel, *start, delay, &x);
    if (residual >= lowest) continue;
    lowest = residual;
    best = x;
    best_delay = delay;
  }
  start->accel_delay = best_delay;
  start->p_MI = best.head<3>();
  CheckGravity(best.segment<3>(3).norm(), gravity_magnitude);
  start->g_W = gravity_magnitude * best.segment<3>(3).normalized();
  start->accel_bias = start->q_MI.conjugate() * best.tail<3>();
}

Start Initialise(const CalibrationOptions& options,
                 const PoseTrajectory& trajectory,
                 const ConditionedData& data) {
  std::optional<double> guess;
  if (options.initial_time_shift)  // t_pose - t_imu of absolute stamps, here of relative ones
    guess = *options.initial_time_shift -
            1e-9 * static_cast<double>(data.pose_epoch_ns - data.imu_epoch_ns);

  Start start;
  RateAlignment best;
  double most = -1.0;
  const std::vector<double> shifts =
      options.estimate_time_shift
          ? FindTimeShifts(
                trajectory, data.poses, data.gyro, options.min_overlap_s, guess, kCandidates)
          : std::vector<double>{*guess};
  for (const double shift : shifts) {
    const RateAlignment alignment = AlignRates(trajectory, data.gyro, shift);
    const double evidence = Evidence(std::sqrt(std::max(0.0, alignment.explained)),
                                     static_cast<double>(alignment.count));
    if (evidence <= most) continue;
    most = evidence;
    best = alignment;
    start.time_shift = shift;
  }
  if (best.explained < kMinExplained) throw DataError(RateMismatch(best));
  CheckGyroUnit(best);
  start.q_MI = options.initial_rotation ? options.initial_rotation->normalized() : best.q_MI;
  start.gyro_bias = best.gyro_bias;
  start.accel_delay = options.accel_delay;
  FitLeverArm(
      trajectory, data.accel, options.gravity_magnitude, options.estimate_accel_delay, &start);
  if (options.initial_translation) start.p_MI = *options.initial_translation;
  if (options.initial_gravity) start.g_W = *options.initial_gravity;
  return start;
}

}  // namespace imu_pose_calib
