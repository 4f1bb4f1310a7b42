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

constexpr double kBin = 0.01;                  // [s] of the correlated signals
constexpr double kGuessWindow = 1.0;           // [s] searched around a given time shift
constexpr int kCandidates = 6;                 // correlation peaks tried on all three axes
constexpr double kMinPeakDistance = 0.15;      // [s] between them
constexpr double kMinExplained = 0.5;          // of the gyro's variance
constexpr double kSurelyExplained = 0.95;      // nobody asks for another reading of the poses
constexpr double kMaxUnexplainedOther = 0.2;   // of the gyro's variance, by another reading
constexpr double kMaxUnexplainedRatio = 0.25;  // of another reading over the one as given
constexpr double kFlipped = 0.2;           // unexplained share of the motion of a flipped segment
constexpr double kFlipFactor = 25.0;       // its mean square residual over that of the others
constexpr size_t kMinPairs = 50;           // gyro samples of a segment that proposes a rotation
constexpr double kMinAgreement = 0.6;      // of the log, on one rotation
constexpr double kMinProposal = 0.3;       // of the log, for a rotation to be taken seriously
constexpr double kMinSignalToNoise = 3.0;  // power of the marker's acceleration
constexpr double kUnitBound = 5.0;         // scale of the positions, either way
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

/// The rates of marker and gyroscope at one instant.
struct RatePair {
  double t;  ///< [s] pose clock
  Eigen::Vector3d omega_M, gyro_I;
};

/// `inverted`: the rates of the world seen from the marker.
std::vector<RatePair> PairRates(const PoseTrajectory& trajectory,
                                const std::vector<TimedSample>& gyro,
                                double time_shift,
                                bool inverted = false) {
  std::vector<RatePair> pairs;
  for (size_t i = 0; i < gyro.size(); i += Stride(gyro.size())) {
    const double t = gyro[i].t + time_shift;
    MarkerState<double> state;
    if (!trajectory.Evaluate(t, &state)) continue;
    if (inverted) state.omega_M = -(state.q_WM * state.omega_M);
    pairs.push_back({t, state.omega_M, gyro[i].value});
  }
  return pairs;
}

/// Wahba's problem on mean-free rates.
RateAlignment Align(const std::vector<RatePair>& pairs) {
  RateAlignment alignment;
  alignment.count = pairs.size();
  if (pairs.size() < 10) return alignment;
  Eigen::Vector3d mean_M = Eigen::Vector3d::Zero(), mean_I = Eigen::Vector3d::Zero();
  for (const RatePair& pair : pairs) {
    mean_M += pair.omega_M / static_cast<double>(pairs.size());
    mean_I += pair.gyro_I / static_cast<double>(pairs.size());
  }
  Eigen::Matrix3d H = Eigen::Matrix3d::Zero();
  double sum_M = 0.0, sum_I = 0.0;
  for (const RatePair& pair : pairs) {
    H += (pair.omega_M - mean_M) * (pair.gyro_I - mean_I).transpose();
    sum_M += (pair.omega_M - mean_M).squaredNorm();
    sum_I += (pair.gyro_I - mean_I).squaredNorm();
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

/// Residual of the gyroscope [rad/s].
Eigen::Vector3d Residual(const RateAlignment& alignment, const RatePair& pair) {
  return pair.gyro_I - alignment.gyro_bias - alignment.q_MI.conjugate() * pair.omega_M;
}

/// Throws when inverted poses explain the gyroscope far better. Quaternions whose w comes first,
/// read as if it came last, turn like inverted ones: up to fixed rotations of W and M the two are
/// the same.
void CheckPoseReading(const CalibrationOptions& options,
                      const PoseTrajectory& trajectory,
                      const std::vector<TimedSample>& gyro,
                      const std::vector<double>& time_shifts,
                      const RateAlignment& as_given) {
  if (as_given.explained > kSurelyExplained) return;
  double explained = 0.0;
  for (const double shift : time_shifts)
    explained = std::max(explained, Align(PairRates(trajectory, gyro, shift, true)).explained);
  if (1.0 - explained > kMaxUnexplainedOther ||
      1.0 - explained > kMaxUnexplainedRatio * (1.0 - as_given.explained))
    return;
  std::ostringstream text;
  text.precision(3);
  text << "the turn rates of poses and gyroscope agree only when the poses are inverted (explains "
       << 100.0 * explained << " % of the gyroscope's variance, as given "
       << 100.0 * std::max(0.0, as_given.explained)
       << " %): if they are the world seen from the marker, set invert_poses: "
       << (options.invert_poses ? "false" : "true")
       << "; if the source writes quaternions as w, x, y, z, let it write x, y, z, w";
  throw OptionNeeded(text.str());
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
    text << "; it looks like deg/s: set gyro_unit: 0.0174532925";
  else
    text << "; set gyro_unit, the unit of the gyroscope in rad/s";
  throw OptionNeeded(text.str());
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
  return Align(PairRates(trajectory, gyro, time_shift));
}

namespace {

/// Time shifts that the correlation of the turn rates proposes.
std::vector<double> CandidateShifts(const CalibrationOptions& options,
                                    const PoseTrajectory& trajectory,
                                    const ConditionedData& data,
                                    const ConditionedImu& imu) {
  std::optional<double> guess;
  if (options.initial_time_shift)  // t_pose - t_imu of absolute stamps, here of relative ones
    guess =
        *options.initial_time_shift - 1e-9 * static_cast<double>(data.pose_epoch_ns - imu.epoch_ns);
  if (!options.estimate_time_shift) return {*guess};
  return FindTimeShifts(
      trajectory, data.poses, imu.gyro, options.min_overlap_s, guess, kCandidates);
}

/// Gyro samples on one segment of the trajectory.
using SegmentRates = std::vector<RatePair>;

/// Which segments turn as the gyroscope does under one alignment.
struct RotationAgreement {
  std::vector<bool> flipped;  ///< per segment
  double agreeing = 0.0;      ///< share of the gyro samples on the others
  double explained = 0.0;     ///< share of the gyro's variance on them
  double cost = std::numeric_limits<double>::infinity();
};

RotationAgreement Judge(const std::vector<SegmentRates>& segments, const RateAlignment& alignment) {
  RotationAgreement result;
  result.cost = 0.0;
  double unexplained = 0.0, total = 1e-12, agreeing = 0.0, count = 1e-12;
  for (const SegmentRates& pairs : segments) {
    double residual = 0.0, motion = 0.0;
    for (const RatePair& pair : pairs) {
      residual += Residual(alignment, pair).squaredNorm();
      motion += (pair.gyro_I - alignment.gyro_bias).squaredNorm();
    }
    const auto n = static_cast<double>(pairs.size());
    count += n;
    result.cost += std::min(residual, kFlipped * motion);
    result.flipped.push_back(residual > kFlipped * motion);
    if (result.flipped.back()) continue;
    agreeing += n;
    unexplained += residual;
    total += motion;
  }
  result.agreeing = agreeing / count;
  result.explained = 1.0 - unexplained / total;
  // Where the marker hardly turns, noise is all there is: nothing can be said.
  const double usual = unexplained / std::max(agreeing, 1.0);
  for (size_t k = 0; k < segments.size(); ++k) {
    double residual = 0.0;
    for (const RatePair& pair : segments[k]) residual += Residual(alignment, pair).squaredNorm();
    if (residual < kFlipFactor * usual * static_cast<double>(segments[k].size()))
      result.flipped[k] = false;
  }
  return result;
}

/// The alignment that most of the motion agrees on, of those of all segments and of each one.
RotationAgreement FindAgreement(const std::vector<SegmentRates>& segments) {
  SegmentRates all;
  for (const SegmentRates& pairs : segments) all.insert(all.end(), pairs.begin(), pairs.end());
  RotationAgreement best = Judge(segments, Align(all));
  const auto improve = [&](const SegmentRates& pairs) {
    if (pairs.size() < kMinPairs) return;
    const RotationAgreement candidate = Judge(segments, Align(pairs));
    if (candidate.cost < best.cost) best = candidate;
  };
  for (const SegmentRates& pairs : segments) improve(pairs);
  SegmentRates agreeing;
  for (size_t k = 0; k < segments.size(); ++k)
    if (!best.flipped[k]) agreeing.insert(agreeing.end(), segments[k].begin(), segments[k].end());
  improve(agreeing);
  return best;
}

/// Gyro samples by the segment of the trajectory that they fall on.
std::vector<SegmentRates> PairRatesBySegment(const PoseTrajectory& trajectory,
                                             const ConditionedData& data,
                                             const ConditionedImu& imu,
                                             double time_shift) {
  std::vector<SegmentRates> segments(data.segments.size());
  for (const RatePair& pair : PairRates(trajectory, imu.gyro, time_shift)) {
    size_t k = 0;
    while (data.poses[data.segments[k].end - 1].t < pair.t) ++k;
    segments[k].push_back(pair);
  }
  return segments;
}

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

/// Normal equations of the accelerometer for x = (p_MI, g_W, R_MI b_a, s) at a given delay:
///   R_MI f = ([alpha]x + [omega]x [omega]x) p_MI - R_WM^T g_W + R_MI b_a + s R_WM^T a_W,
/// where s is 1 when positions and accelerometer are in the same unit of length.
struct LeverArmEquations {
  using Matrix10d = Eigen::Matrix<double, 10, 10>;
  using Vector10d = Eigen::Matrix<double, 10, 1>;
  Matrix10d A = Matrix10d::Zero();
  Vector10d b = Vector10d::Zero();
  double sum = 0.0, count = 0.0;

  LeverArmEquations(const PoseTrajectory& trajectory,
                    const std::vector<TimedSample>& accel,
                    const Start& start,
                    double delay) {
    const Eigen::Matrix3d R_MI = start.q_MI.toRotationMatrix();
    A.diagonal().segment<3>(6).setConstant(1.0 / (kAccelBiasPrior * kAccelBiasPrior));
    for (size_t i = 0; i < accel.size(); i += Stride(accel.size())) {
      MarkerState<double> state;
      if (!trajectory.Evaluate(accel[i].t + start.time_shift - delay, &state)) continue;
      const Eigen::Matrix3d R_MW = state.q_WM.conjugate().toRotationMatrix();
      const Eigen::Matrix3d W = Hat(state.omega_M);
      Eigen::Matrix<double, 3, 10> J;
      J << Hat(state.alpha_M) + W * W, -R_MW, Eigen::Matrix3d::Identity(), R_MW * state.a_W;
      const Eigen::Vector3d y = R_MI * accel[i].value;
      A.noalias() += J.transpose() * J;
      b.noalias() += J.transpose() * y;
      sum += y.squaredNorm();
      count += 1.0;
    }
  }

  /// (p_MI, g_W, R_MI b_a) with s = 1, and the mean squared residual.
  Eigen::Matrix<double, 9, 1> Solve(double* residual) const {
    const Eigen::Matrix<double, 9, 1> b9 = b.head<9>() - A.col(9).head<9>();
    Eigen::Matrix<double, 9, 1> x = A.topLeftCorner<9, 9>().ldlt().solve(b9);
    *residual = count > 0.0 ? (sum - 2.0 * b[9] + A(9, 9) - b9.dot(x)) / count
                            : std::numeric_limits<double>::infinity();
    return x;
  }

  double PositionScale() const { return A.ldlt().solve(b)[9]; }
};

/// Variance per axis of the marker's acceleration [(m/s^2)^2].
double MeanAccelVariance(const PoseTrajectory& trajectory,
                         const std::vector<TimedSample>& accel,
                         double time_shift) {
  double sum = 0.0, count = 1e-9;
  for (size_t i = 0; i < accel.size(); i += 10 * Stride(accel.size())) {
    const double t = accel[i].t + time_shift;
    if (!trajectory.Contains(t)) continue;
    sum += trajectory.Variance(t).accel;
    count += 1.0;
  }
  return sum / count;
}

/// Positions in another unit than metres do not fit the accelerometer. Nothing is said when they
/// hardly move: `mean_variance` [(m/s^2)^2] of the marker's acceleration per axis.
void CheckPositionUnit(const LeverArmEquations& equations, double mean_variance) {
  const double mean_square = equations.A(9, 9) / std::max(1.0, equations.count);
  if (mean_square < 3.0 * kMinSignalToNoise * mean_variance) return;
  const double scale = equations.PositionScale();
  if (scale > 1.0 / kUnitBound && scale < kUnitBound) return;
  std::ostringstream text;
  text.precision(3);
  text << "pose: the marker's acceleration has to be multiplied by " << scale
       << " to match the accelerometer (bound: " << 1.0 / kUnitBound << " to " << kUnitBound
       << "); ";
  if (scale > 2e-4 && scale < 4e-3)
    text << "positions look like millimetres: set position_unit: 1.0e-3";
  else if (scale > 6e-3 && scale < 2e-2)
    text << "positions look like centimetres: set position_unit: 1.0e-2";
  else
    text << "are positions in metres and of the body that carries the IMU? Else set position_unit";
  throw OptionNeeded(text.str());
}

}  // namespace

void RemoveFlippedSegments(const CalibrationOptions& options,
                           PoseTrajectory* trajectory,
                           ConditionedData* data) {
  if (data->segments.size() < 2) return;
  const ConditionedImu& imu = data->imus[data->FirstImu()];
  RotationAgreement best;
  for (const double shift : CandidateShifts(options, *trajectory, *data, imu)) {
    const RotationAgreement agreement =
        FindAgreement(PairRatesBySegment(*trajectory, *data, imu, shift));
    if (agreement.explained * agreement.agreeing > best.explained * best.agreeing) best = agreement;
  }
  if (best.agreeing < kMinProposal || best.explained < kMinExplained) return;  // S2 says why
  if (best.agreeing < kMinAgreement) {
    std::ostringstream text;
    text.precision(2);
    text << "pose: the marker's frame flips: only " << 100.0 * best.agreeing
         << " % of the recording turn as the gyroscope does with one rotation R_MI (bound: "
         << 100.0 * kMinAgreement << " %); place the markers less symmetrically and record again";
    throw DataError(text.str());
  }
  if (std::find(best.flipped.begin(), best.flipped.end(), true) == best.flipped.end()) return;
  std::vector<TimedPose> poses;
  std::vector<IndexRange> segments;
  for (size_t k = 0; k < best.flipped.size(); ++k) {
    const IndexRange s = data->segments[k];
    if (best.flipped[k]) {
      data->pose_report.flipped += s.size();
      continue;
    }
    segments.push_back({poses.size(), poses.size() + s.size()});
    poses.insert(poses.end(),
                 data->poses.begin() + static_cast<ptrdiff_t>(s.begin),
                 data->poses.begin() + static_cast<ptrdiff_t>(s.end));
  }
  data->poses = std::move(poses);
  data->segments = std::move(segments);
  data->pose_report.used = data->poses.size();
  *trajectory = PoseTrajectory(data->poses,
                               data->segments,
                               trajectory->position_hyperparameters(),
                               trajectory->rotation_hyperparameters());
}

void FitLeverArm(const PoseTrajectory& trajectory,
                 const std::vector<TimedSample>& accel,
                 double gravity_magnitude,
                 bool estimate_delay,
                 Start* start) {
  const auto equations_at = [&](double delay) {
    return LeverArmEquations(trajectory, accel, *start, delay);
  };
  double lowest = 0.0;
  double best_delay = start->accel_delay;
  LeverArmEquations equations = equations_at(best_delay);
  Eigen::Matrix<double, 9, 1> best = equations.Solve(&lowest);
  const int steps = estimate_delay ? static_cast<int>(std::round(kDelaySearch / kDelayStep)) : -1;
  for (int k = -steps; k <= steps; ++k) {
    const double delay = start->accel_delay + k * kDelayStep;
    const LeverArmEquations candidate = equations_at(delay);
    double residual = 0.0;
    const Eigen::Matrix<double, 9, 1> x = candidate.Solve(&residual);
    if (residual >= lowest) continue;
    lowest = residual;
    best = x;
    best_delay = delay;
    equations = candidate;
  }
  CheckPositionUnit(equations, MeanAccelVariance(trajectory, accel, start->time_shift));
  start->accel_delay = best_delay;
  start->p_MI = best.head<3>();
  CheckGravity(best.segment<3>(3).norm(), gravity_magnitude);
  start->g_W = gravity_magnitude * best.segment<3>(3).normalized();
  start->accel_bias = start->q_MI.conjugate() * best.tail<3>();
}

Start Initialise(const CalibrationOptions& options,
                 const PoseTrajectory& trajectory,
                 const ConditionedData& data,
                 size_t imu) {
  const ConditionedImu& samples = data.imus[imu];
  const std::vector<double> shifts = CandidateShifts(options, trajectory, data, samples);
  Start start;
  RateAlignment best;
  double most = -1.0;
  for (const double shift : shifts) {
    const RateAlignment alignment = AlignRates(trajectory, samples.gyro, shift);
    const double evidence = Evidence(std::sqrt(std::max(0.0, alignment.explained)),
                                     static_cast<double>(alignment.count));
    if (evidence <= most) continue;
    most = evidence;
    best = alignment;
    start.time_shift = shift;
  }
  CheckPoseReading(options, trajectory, samples.gyro, shifts, best);
  if (best.explained < kMinExplained) throw DataError(RateMismatch(best));
  CheckGyroUnit(best);
  start.q_MI = options.initial_rotation ? options.initial_rotation->normalized() : best.q_MI;
  start.gyro_bias = best.gyro_bias;
  start.accel_delay = options.accel_delay;
  FitLeverArm(
      trajectory, samples.accel, options.gravity_magnitude, options.estimate_accel_delay, &start);
  if (options.initial_translation) start.p_MI = *options.initial_translation;
  if (options.initial_gravity) start.g_W = *options.initial_gravity;
  return start;
}

}  // namespace imu_pose_calib
