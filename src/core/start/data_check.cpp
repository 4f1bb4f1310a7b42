#include "imu_pose_calib/core/start/data_check.h"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <numeric>
#include <utility>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/base/text.h"
#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/core/start/rate_alignment.h"

namespace imu_pose_calib {
namespace {

// Bounds of the warnings, as shares of a stream unless a unit is given.
constexpr double kMaxJitter = 0.3;  // of a period
constexpr double kMaxBunched = 0.1, kMostBunched = 0.8;
constexpr struct StreamBounds {
  double missing, repeated;
} kImuBounds{0.05, 0.3}, kPoseBounds{0.3, 0.1};
constexpr double kMaxDropped = 0.01;  // not finite, zero, reversed
constexpr double kMaxOutliers = 0.03;
constexpr double kMinOverlap = 10.0;    // [s]
constexpr double kWellExplained = 0.8;  // of the gyroscope's variance
constexpr double kMaxGravityError = 0.05;
constexpr double kLeastTime = 5e-4;  // [s] of a unit that cuts stamps; of drift over the recording

constexpr double kRestWindow = 0.25;   // [s]
constexpr double kRestRate = 0.05;     // [rad/s] rms
constexpr double kRestForce = 0.15;    // [m/s^2] rms about the mean
constexpr double kMinTurnRate = 0.01;  // [rad/s] about the second axis
constexpr double kPause = 1.0;         // [s] longer than between bunches
constexpr double kDriftBlock = 2.0;    // [s] of samples whose errors may be correlated

std::string Percent(double share) { return Number(100.0 * share, "%.4g %%"); }

template <typename Sample>
StreamCheck CheckStream(const std::vector<Sample>& samples) {
  StreamCheck check;
  check.count = samples.size();
  if (samples.size() < 2) return check;
  const auto n = static_cast<double>(samples.size());
  const std::vector<bool> repeats = FindRepeats(samples);
  check.repeated = static_cast<double>(std::count(repeats.begin(), repeats.end(), true)) / n;
  size_t run = 0, longest_run = 0;
  for (const bool is_repeat : repeats) {
    run = is_repeat ? run + 1 : 0;
    longest_run = std::max(longest_run, run);
  }

  const std::vector<StampFault> faults = JudgeStamps(Stamps(samples));
  std::vector<int64_t> stamps;
  for (size_t i = 0; i < samples.size(); ++i)
    if (faults[i] != StampFault::kAstray && faults[i] != StampFault::kAhead)
      stamps.push_back(samples[i].t_ns);
  std::sort(stamps.begin(), stamps.end());
  if (stamps.size() < 2) return check;
  check.duration_s = 1e-9 * static_cast<double>(stamps.back() - stamps.front());
  std::vector<double> periods;
  for (size_t i = 1; i < stamps.size(); ++i)
    periods.push_back(1e-9 * static_cast<double>(stamps[i] - stamps[i - 1]));
  check.longest_gap_s = *std::max_element(periods.begin(), periods.end());
  double period = Median(periods);
  // Of samples that come in bunches, the median period is that inside of a bunch. Pauses are none.
  double mean = 0.0, count = 0.0;
  for (const double p : periods) {
    mean += p < kPause ? p : 0.0;
    count += p < kPause ? 1.0 : 0.0;
  }
  mean /= std::max(1.0, count);
  if (period < kBunch * mean) period = mean;
  if (period <= 0.0) return check;
  check.rate_hz = 1.0 / period;
  check.longest_freeze_s = period * static_cast<double>(longest_run);
  const auto duplicates = static_cast<double>(std::count(periods.begin(), periods.end(), 0.0));
  const auto is_bunched = [&](double p) { return p > 0.0 && p < kBunch * period; };
  check.bunched =
      static_cast<double>(std::count_if(periods.begin(), periods.end(), is_bunched)) / n;
  for (double& p : periods) p -= period;
  check.jitter_s = RobustSigma(std::move(periods));
  check.missing = std::max(0.0, 1.0 - (n - duplicates) / (check.duration_s / period + 1.0));
  return check;
}

/// Largest unit [s] of which all differences of the stamps are multiples, to a microsecond; 0 when
/// it is finer than what matters.
double CutOf(const std::vector<int64_t>& stamps_ns) {
  int64_t unit_us = 0;
  for (size_t i = 1; i < stamps_ns.size(); ++i)
    unit_us = std::gcd(unit_us, (std::abs(stamps_ns[i] - stamps_ns[i - 1]) + 500) / 1000);
  const double cut = 1e-6 * static_cast<double>(unit_us);
  return cut >= kLeastTime ? cut : 0.0;
}

/// The same of a stream whose stamps were looked at, and perhaps replaced, in `samples`.
template <typename Sample>
StreamCheck CheckStream(const std::vector<Sample>& recorded, const std::vector<Sample>& samples,
                        const StreamReport& stamps) {
  StreamCheck check = CheckStream(samples);
  if (stamps.stamps_recovered) {
    const StreamCheck before = CheckStream(recorded);
    check.jitter_s = before.jitter_s;
    check.bunched = before.bunched;
  }
  if (!stamps.stamps_even) check.cut_s = CutOf(Stamps(recorded));
  check.report = stamps;
  return check;
}

void WarnOfStamps(const std::string& stream, const StreamCheck& check, const StreamBounds& most,
                  std::vector<std::string>* warnings) {
  const auto warn = [&](const std::string& text) { warnings->push_back(stream + ": " + text); };
  if (check.report.stamps_recovered) {
    // The stamps in use are even.
  } else if (check.bunched > kMaxBunched) {
    warn(Percent(check.bunched) +
         " of the samples are stamped in bunches (bound: " + Percent(kMaxBunched) +
         "), as by time of arrival, and used as recorded; use stamps of the sensor's own clock");
  } else if (check.cut_s > 0.0) {
    warn("the stamps are multiples of " + Number(1e3 * check.cut_s) +
         " ms, not even, and used as recorded; use stamps of the sensor's own clock");
  } else if (check.jitter_s * check.rate_hz > kMaxJitter) {
    warn("the stamps jitter by " + Number(1e3 * check.jitter_s) +
         " ms (bound: " + Number(kMaxJitter) + " of the period of " + Number(1e3 / check.rate_hz) +
         " ms) and are used as recorded; use stamps of the sensor's own clock");
  }
  if (check.missing > most.missing)
    warn(Percent(check.missing) + " of the samples are missing (bound: " + Percent(most.missing) +
         "), the longest gap is " + Number(check.longest_gap_s) +
         " s; look for lost packets or a hidden marker");
  if (check.repeated > most.repeated)
    warn(Percent(check.repeated) +
         " of the samples repeat the value before (bound: " + Percent(most.repeated) +
         "), for up to " + Number(check.longest_freeze_s) + " s; they are not used");
}

void WarnOfDrops(const std::string& stream, const StreamReport& r,
                 std::vector<std::string>* warnings) {
  const auto warn = [&](const std::string& text) { warnings->push_back(stream + ": " + text); };
  const double n = std::max(1.0, static_cast<double>(r.received));
  const size_t bad = r.not_finite + r.zero_quaternion + r.reversed_stamp;
  if (static_cast<double>(bad) > kMaxDropped * n)
    warn(std::to_string(bad) + " of " + std::to_string(r.received) +
         " samples are not finite, zero or stamped backwards; they are not used");
  if (r.saturated > 0)
    warn(std::to_string(r.saturated) +
         " samples at the end of the sensor's range are not used; choose a larger range or move "
         "more gently");
  if (static_cast<double>(r.outlier) > kMaxOutliers * n)
    warn(Percent(static_cast<double>(r.outlier) / n) +
         " are outliers (bound: " + Percent(kMaxOutliers) + "); they are not used");
  if (r.between_updates > 0)
    warn("they jump or bend " + Number(r.rate_hz) +
         " times a second and are made up in between (fused with an imu, or interpolated): one is "
         "used of each such interval; record what the tracker measures");
  if (r.flipped > 0)
    warn(std::to_string(r.flipped) +
         " poses that turn against the gyroscope are not used: swapped labels? Place the markers "
         "less symmetrically");
}

/// Mean norm of the accelerometer while neither sensor shows motion, and how long that was.
void FindRest(const ConditionedImu& data, ImuCheck* check) {
  const Eigen::Vector3d gyro_bias =
      MedianOfEach(0, data.gyro.size(), [&](size_t i) { return data.gyro[i].value; });
  double sum = 0.0, count = 0.0;
  size_t a = 0, g = 0;
  const double end = std::min(data.gyro.back().t, data.accel.back().t);
  const double begin = std::min(data.gyro.front().t, data.accel.front().t);
  for (double t = begin; t + kRestWindow < end; t += kRestWindow) {
    double rate2 = 0.0, gyros = 0.0, norm = 0.0, norm2 = 0.0, accels = 0.0;
    for (; g < data.gyro.size() && data.gyro[g].t < t + kRestWindow; ++g, gyros += 1.0)
      rate2 += (data.gyro[g].value - gyro_bias).squaredNorm();
    for (; a < data.accel.size() && data.accel[a].t < t + kRestWindow; ++a, accels += 1.0) {
      norm += data.accel[a].value.norm();
      norm2 += data.accel[a].value.squaredNorm();
    }
    if (gyros < 3.0 || accels < 3.0 || rate2 / gyros > kRestRate * kRestRate) continue;
    const double mean = norm / accels;
    if (norm2 / accels - mean * mean > kRestForce * kRestForce) continue;
    check->rest_s += kRestWindow;
    sum += norm;
    count += accels;
  }
  check->rest_norm = count > 0.0 ? sum / count : 0.0;
}

/// Share of the gyroscope's variance that the poses explain, and growth of the time shift: linear
/// least squares for small changes of R_MI, bias, shift and drift on the gyroscope, with a
/// covariance from blocks of time.
void MeasureDrift(const ConditionedImu& data, const PoseTrajectory& trajectory, const Start& start,
                  ImuCheck* check) {
  using Matrix8d = Eigen::Matrix<double, 8, 8>;
  using Vector8d = Eigen::Matrix<double, 8, 1>;
  struct Equations {
    Matrix8d H = Matrix8d::Zero();
    Vector8d b = Vector8d::Zero();
  };
  const double begin = data.gyro.front().t, middle = data.MiddleOfGyro();
  std::vector<Equations> blocks(1 +
                                static_cast<size_t>((data.gyro.back().t - begin) / kDriftBlock));
  const Eigen::Matrix3d R_IM = start.q_MI.conjugate().toRotationMatrix();
  const auto pairs = PairRates(trajectory, data.gyro, Stride(data.gyro.size()),
                               [&](double t) { return t + start.time_shift; });
  if (pairs.size() < 100) return;
  double motion = 0.0, residual = 0.0;
  for (const RatePair& pair : pairs) {
    const TimedSample& s = *pair.gyro;
    const Eigen::Vector3d omega_I = R_IM * pair.marker.omega_M;
    const Eigen::Vector3d alpha_I = R_IM * pair.marker.alpha_M;
    const Eigen::Vector3d turn = s.value - start.gyro_bias, r = turn - omega_I;
    Eigen::Matrix<double, 3, 8> J;
    J << Hat(omega_I), Eigen::Matrix3d::Identity(), alpha_I, (s.t - middle) * alpha_I;
    Equations& block = blocks[static_cast<size_t>((s.t - begin) / kDriftBlock)];
    block.H += J.transpose().lazyProduct(J);
    block.b += J.transpose().lazyProduct(r);
    residual += r.squaredNorm();
    motion += turn.squaredNorm();
  }
  Equations all;
  for (const Equations& block : blocks) {
    all.H += block.H;
    all.b += block.b;
  }
  const Vector8d x = Solve(all.H, all.b);
  Matrix8d scatter = Matrix8d::Zero();
  for (const Equations& block : blocks) {
    const Vector8d score = block.b - block.H * x;
    scatter += score * score.transpose();
  }
  check->explained = 1.0 - (residual - all.b.dot(x)) / motion;
  check->time_shift += x[6];
  check->drift_ppm = 1e6 * x[7];
  const Eigen::MatrixXd covariance = Solve(all.H, Solve(all.H, scatter).transpose());
  check->drift_ppm_std = 1e6 * std::sqrt(std::max(0.0, covariance(7, 7)));
}

/// act(name, check) of all streams.
template <typename Act>
void ForEachStream(const DataCheck& check, const Act& act) {
  act("pose", check.poses);
  for (size_t i = 0; i < check.imus.size(); ++i) {
    const ImuCheck& imu = check.imus[i];
    const std::string of = OfImu(i, check.imus.size());
    act("gyroscope" + of, imu.gyro);
    act("accelerometer" + of, imu.accel);
  }
}

/// How the marker moves over the recording.
struct Motion {
  Matrix6d covariance;  ///< of the rate about its axes, and of the acceleration along those of W
  double rate_noise = 0.0;  ///< [(rad/s)^2] mean variance of the rate that is the trajectory's own

  explicit Motion(const PoseTrajectory& trajectory) {
    Vector6d x, sum = Vector6d::Zero();
    Matrix6d sum2 = Matrix6d::Zero();
    double count = 0.0;
    for (double t = 0.0; t <= trajectory.End(); t += kRateBin) {
      MarkerState<double> state;
      if (!trajectory.Evaluate(t, &state)) continue;
      x << state.omega_M, state.a_W;
      sum += x;
      sum2 += x * x.transpose();
      rate_noise += trajectory.Variance(t).omega;
      count += 1.0;
    }
    const Vector6d mean = sum / count;
    covariance = sum2 / count - mean * mean.transpose();
    rate_noise /= count;
  }
};

/// Throws DegenerateMotion unless the marker turns about two axes.
void CheckTurns(const Motion& motion) {
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> eigen(
      motion.covariance.topLeftCorner<3, 3>());
  const double noise = motion.rate_noise;
  const auto rate_std = [&](int k) {  // the largest first; 0 when within the noise
    const double excess = eigen.eigenvalues()[2 - k] - noise;
    return excess > 0.5 * noise ? std::sqrt(excess) : 0.0;
  };
  if (rate_std(1) >= kMinTurnRate) return;
  const auto rate = [](double value) { return Number(value, "%.2g rad/s"); };
  const std::string largest = rate(rate_std(0)) + " rms", bound = rate(kMinTurnRate);
  if (rate_std(0) < kMinTurnRate)
    throw DegenerateMotion("the marker does not turn (" + largest + ", bound: " + bound +
                               "): R_MI, p_MI and time_shift are undetermined; " + kTurnAdvice,
                           std::string("R_MI, p_MI and time_shift: ") + kTurnAdvice);
  const std::string axis = DescribeAxis(eigen.eigenvectors().col(2), "marker");
  throw DegenerateMotion("the marker turns about one axis only, " + axis + " (" + largest +
                             "; about any other " + rate(rate_std(1)) + ", bound: " + bound +
                             "): p_MI along it is undetermined; " + kTurnAdvice,
                         "p_MI along " + axis + ": turn about a second axis");
}

}  // namespace

std::string DescribeAxis(const Eigen::Vector3d& direction, const std::string& frame) {
  const Eigen::Vector3d axis = direction.normalized();
  int largest = 0;
  if (axis.cwiseAbs().maxCoeff(&largest) > std::cos(20.0 * M_PI / 180.0))
    return frame + " " + "xyz"[largest];
  const double sign = axis[largest] < 0.0 ? -1.0 : 1.0;
  return "(" + Number(sign * axis.x(), "%.2f") + ", " + Number(sign * axis.y(), "%.2f") + ", " +
         Number(sign * axis.z(), "%.2f") + ") in the " + frame + " frame";
}

void CheckStreams(const SessionData& recorded, const SessionData& session,
                  const SessionStamps& stamps, DataCheck* check) {
  *check = DataCheck();
  check->poses = CheckStream(recorded.poses, session.poses, stamps.poses);
  check->imus.resize(session.imus.size());
  for (size_t i = 0; i < session.imus.size(); ++i) {
    const ImuData &before = recorded.imus[i], &after = session.imus[i];
    check->imus[i].gyro = CheckStream(before.gyro, after.gyro, stamps.imus[i].first);
    check->imus[i].accel = CheckStream(before.accel, after.accel, stamps.imus[i].second);
  }
  ForEachStream(*check, [&](const std::string& name, const StreamCheck& of) {
    WarnOfStamps(name, of, &of == &check->poses ? kPoseBounds : kImuBounds, &check->warnings);
  });
  ForEachStream(*check, [](const std::string& name, const StreamCheck& of) {
    if (of.report.stamps_recovered || of.bunched <= kMostBunched) return;
    const auto percent = [](double share) { return Number(100.0 * share, "%.3g %%"); };
    Throw<DataError>(name, ": ", percent(of.bunched),
                     " of the samples are stamped in bunches (bound: ", percent(kMostBunched),
                     "), as by time of arrival, and no even clock fits them; record stamps of the "
                     "sensor's own clock");
  });
}

void CheckMotion(const CalibrationOptions& options, const ConditionedData& data,
                 const PoseTrajectory& trajectory, bool must_turn, DataCheck* check) {
  check->poses.report = data.pose_report;
  check->segments = data.segments.size();
  check->gaps = data.gaps;
  check->jumps = data.jumps;
  for (size_t i = 0; i < data.imus.size(); ++i) {
    check->imus[i].gyro.report = data.imus[i].gyro_report;
    check->imus[i].accel.report = data.imus[i].accel_report;
  }
  ForEachStream(*check, [&](const std::string& name, const StreamCheck& of) {
    WarnOfDrops(name, of.report, &check->warnings);
  });
  if (data.jumps > 0 && data.pose_report.flipped == 0)
    check->warnings.push_back(
        "pose: " + std::to_string(data.jumps) +
        " jumps; the poses are cut there, but they must all be in one frame W up to a turn about "
        "gravity and a move");

  const Motion motion(trajectory);
  const Vector6d rms = motion.covariance.diagonal().cwiseMax(0.0).cwiseSqrt();
  check->turns_M = rms.head<3>();
  check->moves_W = rms.tail<3>();

  const double g = options.GravityMagnitude();
  for (size_t i = 0; i < data.imus.size(); ++i) {
    if (!data.imus[i].IsPresent()) continue;
    ImuCheck& imu = check->imus[i];
    FindRest(data.imus[i], &imu);
    if (imu.rest_s >= 4.0 * kRestWindow && std::abs(imu.rest_norm - g) > kMaxGravityError * g)
      check->warnings.push_back(
          "accelerometer" + OfImu(i, data.imus.size()) + ": its norm at rest is " +
          Number(imu.rest_norm) + " m/s^2 (bound: within " + Percent(kMaxGravityError) +
          " of gravity_magnitude = " + Number(g) + "); check its scale and biases");
  }
  if (must_turn) CheckTurns(motion);
}

void CheckMatch(const CalibrationOptions& options, const ConditionedData& data,
                const PoseTrajectory& trajectory, const Start& start, size_t imu,
                DataCheck* check) {
  const ConditionedImu& samples = data.imus[imu];
  ImuCheck& match = check->imus[imu];
  match.is_matched = true;
  match.time_shift =
      start.time_shift + 1e-9 * static_cast<double>(data.pose_epoch_ns - samples.epoch_ns);
  const double begin = std::max(0.0, samples.gyro.front().t + start.time_shift);
  const double end = std::min(data.poses.back().t, samples.gyro.back().t + start.time_shift);
  match.overlap_s = std::max(0.0, end - begin);
  MeasureDrift(samples, trajectory, start, &match);
  const std::string of = OfImu(imu, data.imus.size());
  if (match.overlap_s < kMinOverlap)
    check->warnings.push_back("poses and IMU" + of + " have only " + Number(match.overlap_s) +
                              " s in common (bound: " + Number(kMinOverlap) +
                              " s); record 30 s or more");
  if (match.explained < kWellExplained)
    check->warnings.push_back("the poses explain only " + Percent(match.explained) +
                              " of the variance of the gyroscope" + of +
                              " (bound: " + Percent(kWellExplained) +
                              "): a loose mount, or poses that are slow, filtered or rare");
  const double drifted = 1e-6 * std::abs(match.drift_ppm) * match.overlap_s;
  if (!options.estimate_clock_drift && drifted > kLeastTime &&
      std::abs(match.drift_ppm) > kSureSigmas * match.drift_ppm_std)
    check->warnings.push_back("the clocks" + (of.empty() ? "" : of + " and the poses") +
                              " drift against each other by " + Number(match.drift_ppm) + " +- " +
                              Number(match.drift_ppm_std) + " ppm, " + Number(1e3 * drifted) +
                              " ms over the recording (bound: " + Number(1e3 * kLeastTime) +
                              " ms): set estimate_clock_drift: true");
}

}  // namespace imu_pose_calib
