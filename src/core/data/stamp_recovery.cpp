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

/// Even stamps: rms jitter in periods, and shares of the steps over missing frames, and over more
/// than so many periods.
constexpr double kEven = 0.02;
constexpr double kMaxMissing = 0.1, kMaxPauses = 0.02;
constexpr double kLongStep = 20.0;

constexpr double kSmootherSigmas = 4.0;  // by which the recovered stamps win the vote

/// Values of one kind, one vector a sample: positions, rotations, rates, ...
using Channel = std::vector<Eigen::Vector4d>;

/// Samples in order of arrival. The channels share the stamps.
struct Stream {
  std::vector<int64_t> t_ns;
  std::vector<Channel> channels;

  bool IsSame(size_t i, size_t k) const {
    return t_ns[i] == t_ns[k] &&
           std::all_of(channels.begin(), channels.end(),
                       [&](const Channel& channel) { return channel[i] == channel[k]; });
  }
};

Stream ToStream(const std::vector<PoseSample>& samples) {
  Stream stream{Stamps(samples), std::vector<Channel>(2)};
  Channel &positions = stream.channels[0], &rotations = stream.channels[1];
  for (const PoseSample& s : samples) {
    const Eigen::Vector4d q = s.q_WM.coeffs();
    const bool is_opposite = !rotations.empty() && rotations.back().dot(q) < 0.0;
    rotations.push_back(is_opposite ? Eigen::Vector4d(-q) : q);
    positions.emplace_back(s.p_WM.x(), s.p_WM.y(), s.p_WM.z(), 0.0);
  }
  return stream;
}

Stream ToStream(const std::vector<ImuSample>& samples) {
  Stream stream{Stamps(samples), std::vector<Channel>(1)};
  for (const ImuSample& s : samples)
    stream.channels[0].emplace_back(s.value.x(), s.value.y(), s.value.z(), 0.0);
  return stream;
}

/// Error of the cubic through two samples on either side of sample i at the times t, over what it
/// makes of their noise.
double Roughness(const Channel& channel, size_t i, const std::array<double, 5>& t) {
  Eigen::Vector4d error = channel[i];
  double gain = 1.0;
  for (const size_t j : {0u, 1u, 3u, 4u}) {
    double w = 1.0;
    for (const size_t k : {0u, 1u, 3u, 4u})
      if (k != j) w *= (t[2] - t[k]) / (t[j] - t[k]);
    error -= w * channel[i + j - 2];
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
    if ((!is_bunched && !matters) || b[4] > kLongStep * period) continue;
    for (const Channel& channel : stream.channels) {
      bool is_new = true;
      for (size_t k = i - 1; k <= i + 2; ++k) is_new = is_new && channel[k] != channel[k - 1];
      const double after = Roughness(channel, i, b);
      if (!is_new || !std::isfinite(after)) continue;
      votes += 1.0;
      lead += is_bunched || after < Roughness(channel, i, a) ? 1.0 : -1.0;
    }
  }
  return lead > kSmootherSigmas * std::sqrt(3.0 * votes);  // neighbours vote alike
}

/// What is done about the stamps of a stream, which become the new ones.
StreamStamps Recover(StampRecovery mode, Stream* stream) {
  StreamStamps result;
  const std::vector<StampFault> faults = JudgeStamps(stream->t_ns);
  // The same message twice is one frame.
  Stream frames{{}, std::vector<Channel>(stream->channels.size())};
  std::vector<size_t> places(stream->t_ns.size(), 0);  // in `frames`
  for (size_t i = 0, last = 0; i < places.size(); ++i) {
    if (faults[i] != StampFault::kNone) continue;
    if (frames.t_ns.empty() || !stream->IsSame(last, i)) {
      frames.t_ns.push_back(stream->t_ns[i]);
      for (size_t c = 0; c < frames.channels.size(); ++c)
        frames.channels[c].push_back(stream->channels[c][i]);
    }
    last = i;
    places[i] = frames.t_ns.size() - 1;
  }
  result.even = AreEven(frames.t_ns);
  const bool is_auto = mode == StampRecovery::kAuto;
  if (mode == StampRecovery::kNever || (is_auto && result.even)) return result;
  const auto recovered = RecoverClock(frames.t_ns);
  if (!recovered) return result;
  Eigen::ArrayXd off(static_cast<Eigen::Index>(recovered->size()));
  for (size_t k = 0; k < recovered->size(); ++k)
    off[static_cast<Eigen::Index>(k)] =
        1e-9 * static_cast<double>(frames.t_ns[k] - (*recovered)[k]);
  const double jitter = std::sqrt((off - off.mean()).square().mean());
  result.even = jitter < 1e-9 * kEven * MedianStep(*recovered);
  if (is_auto && (result.even || !IsSmoother(frames, *recovered))) return result;
  for (size_t i = 0; i < places.size(); ++i)
    if (faults[i] == StampFault::kNone) stream->t_ns[i] = (*recovered)[places[i]];
  result.recovered = true;
  result.jitter_s = jitter;
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

bool SameValue(const PoseSample& a, const PoseSample& b) {
  return a.p_WM == b.p_WM && a.q_WM.coeffs() == b.q_WM.coeffs();
}
bool SameValue(const ImuSample& a, const ImuSample& b) { return a.value == b.value; }

bool AreEven(std::vector<int64_t> stamps_ns) {
  if (stamps_ns.size() < 3) return true;
  std::sort(stamps_ns.begin(), stamps_ns.end());
  std::vector<double> steps, advances;
  for (size_t i = 1; i < stamps_ns.size(); ++i) {
    steps.push_back(static_cast<double>(stamps_ns[i] - stamps_ns[i - 1]));
    if (steps.back() > 0.0) advances.push_back(steps.back());
  }
  if (advances.empty()) return false;
  double period = Median(std::move(advances));
  const auto frames = [&](double step) { return std::max(1.0, std::round(step / period)); };
  const auto is_long = [&](double step) { return frames(step) > kLongStep; };
  const auto all = static_cast<double>(steps.size());
  steps.erase(std::remove_if(steps.begin(), steps.end(), is_long), steps.end());
  double time = 0.0, count = 0.0;
  for (const double step : steps) {
    time += step;
    count += frames(step);
  }
  period = time / count;
  double off2 = 0.0, missing = 0.0;
  for (const double step : steps) {
    off2 += std::pow(step - period * frames(step), 2);
    missing += frames(step) > 1.0 ? 1.0 : 0.0;
  }
  // Steps over two periods may be of cut stamps, long ones lie between bursts.
  const auto n = static_cast<double>(steps.size());
  return n > (1.0 - kMaxPauses) * all && missing < kMaxMissing * n &&
         off2 < 2.0 * std::pow(kEven * period, 2) * n;
}

SessionStamps RecoverStamps(StampRecovery mode, SessionData* session) {
  SessionStamps stamps;
  Stream poses = ToStream(session->poses);
  stamps.poses = Recover(mode, &poses);
  SetStamps(poses, &session->poses);
  for (ImuData& imu : session->imus) {
    Stream gyro = ToStream(imu.gyro), accel = ToStream(imu.accel);
    const bool is_shared = gyro.t_ns == accel.t_ns;
    if (is_shared) gyro.channels.push_back(accel.channels[0]);
    const StreamStamps of_gyro = Recover(mode, &gyro);
    const StreamStamps of_accel = is_shared ? of_gyro : Recover(mode, &accel);
    SetStamps(gyro, &imu.gyro);
    SetStamps(is_shared ? gyro : accel, &imu.accel);
    stamps.imus.emplace_back(of_gyro, of_accel);
  }
  return stamps;
}

}  // namespace imu_pose_calib
