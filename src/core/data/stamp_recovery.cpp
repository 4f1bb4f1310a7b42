#include "imu_pose_calib/core/data/stamp_recovery.h"

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <limits>

#include "imu_pose_calib/core/base/median.h"

namespace imu_pose_calib {
namespace {

constexpr int64_t kMaxAstrayNs = 6 * 3600 * int64_t{1'000'000'000};  // from the median
/// A sample that arrives up to this much after a later-stamped one is sorted in.
constexpr int64_t kMaxReorderNs = 1'000'000'000;

/// Whether stamp i, in order of arrival, is by more than a second after most of those that come
/// next, and after most of those before it as well. The last before a clock jumps back agree with
/// those before them, the first after a pause with those that come next.
bool IsStampedAhead(const std::vector<int64_t>& stamps_ns, size_t i) {
  constexpr size_t kNear = 9;
  const auto earlier = [&](size_t begin, size_t end) {
    size_t count = 0;
    for (size_t k = begin; k < end; ++k)
      if (stamps_ns[k] < stamps_ns[i] - kMaxReorderNs) ++count;
    return count;
  };
  const size_t before = std::min(i, kNear), after = std::min(stamps_ns.size() - 1 - i, kNear);
  return 2 * earlier(i + 1, i + 1 + after) > after && 2 * earlier(i - before, i) >= before;
}

constexpr double kEven = 0.02;  // rms jitter in periods

/// Two vectors of a sample, one after the other: position and rotation, a rate and a force; zeros
/// where there is but one.
using Values = Eigen::Matrix<double, 8, 1>;

/// Samples in order of arrival.
struct Stream {
  std::vector<int64_t> t_ns;
  std::vector<Values> values;

  explicit Stream(const std::vector<PoseSample>& samples) : t_ns(Stamps(samples)) {
    Eigen::Vector4d q = Eigen::Vector4d::Zero();
    for (const PoseSample& s : samples) {
      q = q.dot(s.q_WM.coeffs()) < 0.0 ? Eigen::Vector4d(-s.q_WM.coeffs()) : s.q_WM.coeffs();
      values.push_back((Values() << s.p_WM, 0.0, q).finished());
    }
  }
  explicit Stream(const std::vector<ImuSample>& samples) : t_ns(Stamps(samples)) {
    for (const ImuSample& s : samples)
      values.push_back((Values() << s.value, Eigen::Matrix<double, 5, 1>::Zero()).finished());
  }
  Stream() = default;
};

/// Error of the cubic through two samples on either side of sample i at the times t, over what it
/// makes of their noise.
double Roughness(const std::array<Eigen::Vector4d, 5>& values, const std::array<double, 5>& t) {
  Eigen::Vector4d error = values[2];
  double gain = 1.0;
  for (const size_t j : {0u, 1u, 3u, 4u}) {
    double w = 1.0;
    for (const size_t k : {0u, 1u, 3u, 4u})
      if (k != j) w *= (t[2] - t[k]) / (t[j] - t[k]);
    error -= w * values[j];
    gain += w * w;
  }
  return error.squaredNorm() / gain;
}

/// Whether the samples follow each other more smoothly at the stamps `recovered` [ns] than at their
/// own, by vote of those at which it matters. New values in no time are not smooth.
bool IsSmoother(const Stream& stream, const std::vector<int64_t>& recovered) {
  const double period = MedianStep(recovered);
  double votes = 0.0, lead = 0.0;
  for (size_t i = 2; i + 2 < recovered.size(); ++i) {
    std::array<double, 5> a, b;
    bool is_bunched = false, matters = false;
    for (size_t k = 0; k < 5; ++k) {
      a[k] = static_cast<double>(stream.t_ns[i + k - 2] - stream.t_ns[i - 2]);
      b[k] = static_cast<double>(recovered[i + k - 2] - recovered[i - 2]);
      for (size_t j = 0; j < k; ++j)
        is_bunched = is_bunched || std::abs(a[j] - a[k]) < kBunch * period;
    }
    for (size_t k = 1; k < 4; ++k)  // more than a change of rate
      matters = matters || std::abs(a[k] * b[4] - b[k] * a[4]) > kEven * period * std::abs(a[4]);
    if (!is_bunched && !matters) continue;
    for (const Eigen::Index part : {0, 4}) {
      std::array<Eigen::Vector4d, 5> values;
      for (size_t k = 0; k < 5; ++k) values[k] = stream.values[i + k - 2].segment<4>(part);
      const bool is_new = std::adjacent_find(values.begin(), values.end()) == values.end();
      const double after = Roughness(values, b);
      if (!is_new || !std::isfinite(after)) continue;
      votes += 1.0;
      lead += is_bunched || after < Roughness(values, a) ? 1.0 : -1.0;
    }
  }
  return lead > kSureSigmas * std::sqrt(3.0 * votes);  // neighbours vote alike
}

/// What is done about the stamps of a stream, which become the new ones.
StreamReport Recover(StampRecovery mode, Stream* stream) {
  StreamReport result;
  const std::vector<StampFault> faults = JudgeStamps(stream->t_ns);
  // The same message twice is one frame.
  Stream frames;
  std::vector<size_t> places(stream->t_ns.size(), 0);  // in `frames`
  for (size_t i = 0, last = 0; i < places.size(); ++i) {
    if (faults[i] != StampFault::kNone) continue;
    const bool is_twice =
        stream->t_ns[last] == stream->t_ns[i] && stream->values[last] == stream->values[i];
    if (frames.t_ns.empty() || !is_twice) {
      frames.t_ns.push_back(stream->t_ns[i]);
      frames.values.push_back(stream->values[i]);
    }
    last = i;
    places[i] = frames.t_ns.size() - 1;
  }
  result.stamps_even = AreEven(frames.t_ns);
  const bool is_auto = mode == StampRecovery::kAuto;
  if (mode == StampRecovery::kNever || (is_auto && result.stamps_even)) return result;
  const auto recovered = RecoverClock(frames.t_ns);
  if (!recovered) return result;
  Eigen::ArrayXd off(static_cast<Eigen::Index>(recovered->size()));
  for (size_t k = 0; k < recovered->size(); ++k)
    off[static_cast<Eigen::Index>(k)] =
        1e-9 * static_cast<double>(frames.t_ns[k] - (*recovered)[k]);
  const double jitter = std::sqrt((off - off.mean()).square().mean());
  result.stamps_even = jitter < 1e-9 * kEven * MedianStep(*recovered);
  if (is_auto && !IsSmoother(frames, *recovered)) return result;
  for (size_t i = 0; i < places.size(); ++i)
    if (faults[i] == StampFault::kNone) stream->t_ns[i] = (*recovered)[places[i]];
  result.stamps_recovered = true;
  result.stamp_jitter_s = jitter;
  return result;
}

template <typename Sample>
void SetStamps(const Stream& stream, std::vector<Sample>* samples) {
  for (size_t i = 0; i < samples->size(); ++i) (*samples)[i].t_ns = stream.t_ns[i];
}

}  // namespace

std::vector<StampFault> JudgeStamps(const std::vector<int64_t>& stamps_ns) {
  std::vector<StampFault> faults(stamps_ns.size(), StampFault::kNone);
  if (stamps_ns.empty()) return faults;
  const int64_t middle = Median(stamps_ns);
  int64_t latest = std::numeric_limits<int64_t>::min() + kMaxReorderNs;
  for (size_t i = 0; i < stamps_ns.size(); ++i) {
    if (std::abs(stamps_ns[i] - middle) > kMaxAstrayNs)
      faults[i] = StampFault::kAstray;
    else if (IsStampedAhead(stamps_ns, i))
      faults[i] = StampFault::kAhead;
    else if (stamps_ns[i] < latest - kMaxReorderNs)
      faults[i] = StampFault::kReversed;
    else
      latest = std::max(latest, stamps_ns[i]);
  }
  return faults;
}

bool AreEven(std::vector<int64_t> stamps_ns) {
  if (stamps_ns.size() < 3) return true;
  std::sort(stamps_ns.begin(), stamps_ns.end());
  std::vector<double> steps, advances;
  for (size_t i = 1; i < stamps_ns.size(); ++i) {
    steps.push_back(static_cast<double>(stamps_ns[i] - stamps_ns[i - 1]));
    if (steps.back() > 0.0) advances.push_back(steps.back());
  }
  if (advances.empty()) return false;
  const double usual = Median(std::move(advances));
  const auto count = static_cast<double>(steps.size());
  // Within bunches, steps are far below the mean.
  if (count * usual < kBunch * static_cast<double>(stamps_ns.back() - stamps_ns.front()))
    return false;
  double n = 0.0, sum = 0.0, sum2 = 0.0;  // of the steps to the next frame, less the usual one
  for (const double step : steps) {
    if (step > 1.5 * usual) continue;
    n += 1.0;
    sum += step - usual;
    sum2 += std::pow(step - usual, 2);
  }
  const double mean = sum / n;
  return n > (1.0 - kExceptions) * count &&
         sum2 / n - mean * mean < 2.0 * std::pow(kEven * (usual + mean), 2);
}

SessionStamps RecoverStamps(StampRecovery mode, SessionData* session) {
  SessionStamps stamps;
  Stream poses(session->poses);
  stamps.poses = Recover(mode, &poses);
  SetStamps(poses, &session->poses);
  for (ImuData& imu : session->imus) {
    Stream gyro(imu.gyro), accel(imu.accel);
    const bool is_shared = gyro.t_ns == accel.t_ns;
    for (size_t i = 0; is_shared && i < gyro.values.size(); ++i)
      gyro.values[i].tail<4>() = accel.values[i].head<4>();
    const StreamReport of_gyro = Recover(mode, &gyro);
    const StreamReport of_accel = is_shared ? of_gyro : Recover(mode, &accel);
    SetStamps(gyro, &imu.gyro);
    SetStamps(is_shared ? gyro : accel, &imu.accel);
    stamps.imus.emplace_back(of_gyro, of_accel);
  }
  return stamps;
}

}  // namespace imu_pose_calib
