#include "imu_pose_calib/core/data/conditioning.h"

#include <algorithm>
#include <limits>
#include <sstream>
#include <string>
#include <tuple>
#include <utility>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/text.h"
#include "imu_pose_calib/core/data/conditioned_data.h"

namespace imu_pose_calib {
namespace {

/// Steps of its resolution that a sensor at rest does not exceed: two, as steps differ by rounding.
constexpr double kNextSteps = 2.5;
/// A spike: off the median of the samples this near by so many times the median step between the
/// samples of the log, and by so many times the spread of those near.
constexpr size_t kSpikeReach = 3;
constexpr double kSpikeSteps = 10.0, kSpikeSpreads = 5.0;
/// Stated noises are believed to differ by this factor from the median at most.
constexpr double kMaxNoiseScale = 10.0;
/// Median specific force of a moving body, in units of gravity.
constexpr double kMinForce = 0.4, kMaxForce = 10.0;
constexpr double kLeastRate = 0.5;  // [Hz] of an IMU: less has no spectrum

/// A clipped axis: at least so many samples at the limit, and more than within so much below it.
constexpr size_t kMinClipped = 3;
constexpr double kBelowClip = 0.05;  // both limits of a sensor, and those of its axes, are as near

/// All that a sample measures: of a pose, position and coefficients of the quaternion.
Eigen::Matrix<double, 7, 1> ValueOf(const PoseSample& s) {
  return (Eigen::Matrix<double, 7, 1>() << s.p_WM, s.q_WM.coeffs()).finished();
}
const Eigen::Vector3d& ValueOf(const ImuSample& s) { return s.value; }

bool HasRotation(const PoseSample& s) { return s.q_WM.norm() > 1e-3; }
bool HasRotation(const ImuSample&) { return true; }

/// Of the runs of equal values all but the first sample; but where the value after a run is near.
template <typename Sample, typename Near>
std::vector<bool> FindRepeats(const std::vector<Sample>& samples, const Near& is_near) {
  std::vector<bool> repeats(samples.size(), false);
  for (size_t begin = 0, end = 1; begin < samples.size(); begin = end++) {
    while (end < samples.size() && ValueOf(samples[begin]) == ValueOf(samples[end])) ++end;
    if (end < samples.size() && is_near(samples[begin], samples[end])) continue;
    for (size_t i = begin + 1; i < end; ++i) repeats[i] = true;
  }
  return repeats;
}

/// Throws when `bad` of `total` samples exceed the allowed share.
void CheckShare(const std::string& stream, const std::string& defect, size_t bad, size_t total,
                double max_fraction) {
  if (static_cast<double>(bad) <= max_fraction * static_cast<double>(total)) return;
  Throw<DataError>(stream, ": ", bad, " of ", total, " samples ", defect,
                   " (bound: ", 100.0 * max_fraction, " %)");
}

/// Removes the samples that leave and returns how many.
template <typename Sample>
size_t Remove(const std::vector<bool>& leaves, std::vector<Sample>* samples) {
  size_t kept = 0;
  for (size_t i = 0; i < samples->size(); ++i)
    if (!leaves[i]) (*samples)[kept++] = (*samples)[i];
  const size_t gone = samples->size() - kept;
  samples->resize(kept, samples->front());
  return gone;
}

/// Usable samples in strictly increasing time, each with a value of its own.
template <typename Sample>
std::vector<Sample> Clean(const std::string& stream, double max_bad_fraction,
                          const std::vector<Sample>& samples, StreamReport* report) {
  report->received = samples.size();
  if (samples.empty()) Throw<DataError>("no ", stream, " samples");

  std::vector<Sample> kept;
  const std::vector<StampFault> faults = JudgeStamps(Stamps(samples));
  size_t astray = 0, ahead = 0;
  size_t* const of_fault[] = {nullptr, &astray, &ahead, &report->reversed_stamp};
  for (size_t i = 0; i < samples.size(); ++i) {
    const Sample& s = samples[i];
    size_t* count = of_fault[static_cast<int>(faults[i])];
    if (!HasRotation(s)) count = &report->zero_quaternion;
    if (!ValueOf(s).allFinite()) count = &report->not_finite;
    if (count)
      ++*count;
    else
      kept.push_back(s);
  }
  const auto check = [&](size_t bad, const char* defect) {
    CheckShare(stream, defect, bad, samples.size(), max_bad_fraction);
  };
  check(report->not_finite, "are not finite: look at the driver");
  check(report->zero_quaternion, "have a zero quaternion: look at the driver");
  check(astray,
        "are stamped hours from most others: its clock jumped; cut the recording at the jump");
  check(ahead, "are stamped more than 1 s ahead of those around them: look at the driver");
  check(report->reversed_stamp,
        "are stamped more than 1 s before a sample that arrived earlier: its clock jumped back; "
        "cut the recording at the jump");
  report->reversed_stamp += astray + ahead;

  if (kept.empty())
    Throw<DataError>("none of the ", samples.size(), " ", stream, " samples is usable");

  std::stable_sort(kept.begin(), kept.end(),
                   [](const Sample& a, const Sample& b) { return a.t_ns < b.t_ns; });
  size_t last = 0;
  for (size_t i = 1; i < kept.size(); ++i)
    if (kept[i].t_ns > kept[last].t_ns) kept[++last] = kept[i];
  report->duplicate_stamp = kept.size() - last - 1;
  kept.resize(last + 1);
  report->repeated_value = Remove(FindRepeats(kept), &kept);
  return kept;
}

/// Whether `size` components of the values, from `first` on, never change.
template <typename Sample>
bool IsAlways(const std::vector<Sample>& samples, Eigen::Index first, Eigen::Index size) {
  const auto part = [=](const Sample& s) { return ValueOf(s).segment(first, size).eval(); };
  const auto is_same = [&](const Sample& s) { return part(s) == part(samples.front()); };
  return samples.size() > 1 && std::all_of(samples.begin(), samples.end(), is_same);
}

/// Throws when a sensor or one of its axes never changes: it is not read.
void CheckAlive(const std::string& stream, const std::vector<ImuSample>& samples, size_t received) {
  const Eigen::Vector3d& first = samples.front().value;
  if (samples.size() == 1 && received > 1)
    Throw<DataError>(stream, ": all ", received, " samples are ",
                     first.isZero(0.0) ? "zero" : "the same",
                     ": the sensor is not read; look at its driver and record again");
  for (int axis = 0; axis < 3; ++axis)
    if (IsAlways(samples, axis, 1))
      Throw<DataError>(stream, ": its ", "xyz"[axis], " axis is always ", first[axis],
                       "; look at its driver and record again with all three axes");
}

/// Throws when the source gives only half of the pose.
void CheckAlive(const std::vector<PoseSample>& poses) {
  if (IsAlways(poses, 0, 3))
    Throw<DataError>("pose: the position never changes; use a source that gives positions too");
  if (IsAlways(poses, 3, 4))
    Throw<DataError>(
        "pose: the orientation never changes; use a source that gives orientations too");
}

/// Marks the samples at the end of the sensor's range on one side (+1, -1) of one axis. The end
/// shows as a pile of samples at the largest magnitude `peak` of the sensor; a motion that is
/// within the range passes its largest value quickly.
void MarkClipped(const std::vector<ImuSample>& samples, int axis, double side, double peak,
                 std::vector<bool>* clipped) {
  double limit = 0.0;
  for (const ImuSample& s : samples) limit = std::max(limit, side * s.value[axis]);
  if (limit < (1.0 - kBelowClip) * peak) return;
  const auto is_at = [&](size_t i) { return side * samples[i].value[axis] > limit * (1.0 - 1e-6); };
  size_t at = 0, below = 0;
  for (size_t i = 0; i < samples.size(); ++i)
    if (side * samples[i].value[axis] > limit * (1.0 - kBelowClip)) ++(is_at(i) ? at : below);
  if (at < kMinClipped || at <= below) return;
  for (size_t i = 0; i < samples.size(); ++i)
    if (is_at(i)) (*clipped)[i] = true;
}

/// Samples that are at the end of the sensor's range on any axis leave and are counted.
void RemoveSaturated(const std::string& stream, double max_bad_fraction,
                     std::vector<ImuSample>* samples, StreamReport* report) {
  double peak = 0.0;
  for (const ImuSample& s : *samples) peak = std::max(peak, s.value.cwiseAbs().maxCoeff());
  std::vector<bool> clipped(samples->size(), false);
  for (int axis = 0; axis < 3; ++axis)
    for (const double side : {-1.0, 1.0}) MarkClipped(*samples, axis, side, peak, &clipped);
  const size_t size = samples->size();
  report->saturated = Remove(clipped, samples);
  std::ostringstream defect;
  defect << "are at the end of the sensor's range (" << peak
         << "): choose a larger range or move more gently";
  CheckShare(stream, defect.str(), report->saturated, size, max_bad_fraction);
  if (samples->empty()) Throw<DataError>(stream, ": all ", size, " samples ", defect.str());
}

/// Spikes leave and are counted: up to three samples in a row, off their neighbours by many times
/// the usual step and the spread of these neighbours: that of a hard knock is wide. A closed form
/// cannot bear them, and robust weights would not believe the motion around them either.
void RemoveSpikes(std::vector<ImuSample>* spiky, StreamReport* report) {
  if (spiky->size() < 2) return;
  const std::vector<ImuSample> samples = std::exchange(*spiky, {});
  std::vector<double> steps;
  for (size_t i = 1; i < samples.size(); ++i)
    steps.push_back((samples[i].value - samples[i - 1].value).norm());
  const double least = kSpikeSteps * Median(std::move(steps));
  for (size_t i = 0; i < samples.size(); ++i) {
    const size_t begin = i - std::min(i, kSpikeReach);
    const size_t end = std::min(i + kSpikeReach + 1, samples.size());
    const Eigen::Vector3d middle =
        MedianOfEach(begin, end, [&](size_t k) { return samples[k].value; });
    const double distance = (samples[i].value - middle).norm();
    if (distance > least) {
      std::vector<double> distances;
      for (size_t k = begin; k < end; ++k) distances.push_back((samples[k].value - middle).norm());
      if (distance > kSpikeSpreads * Median(std::move(distances))) continue;
    }
    spiky->push_back(samples[i]);
  }
  report->outlier = samples.size() - spiky->size();
}

/// Summarises the samples of a stream, which must span `min_s`.
template <typename Timed>
void CheckDuration(const std::string& stream, const std::vector<Timed>& samples, double min_s,
                   StreamReport* summary) {
  Summarise(samples, summary);
  const StreamReport& report = *summary;
  if (report.duration_s >= min_s) return;
  std::ostringstream dropped;
  const auto add = [&](size_t count, const char* reason) {
    if (count > 0) dropped << ", " << count << " " << reason;
  };
  add(report.not_finite, "not finite");
  add(report.repeated_value, "repeated");
  add(report.reversed_stamp, "stamped backwards");
  add(report.duplicate_stamp, "of a duplicate stamp");
  Throw<DataError>(stream, ": ", report.used, " of ", report.received,
                   " samples are usable and span ", report.duration_s, " s (bound: at least ",
                   min_s, " s", dropped.str(), "); ",
                   2 * report.used < report.received ? "look at the driver and record again"
                                                     : "record 30 s or more");
}

double Seconds(int64_t t_ns, int64_t epoch_ns) {
  return 1e-9 * static_cast<double>(t_ns - epoch_ns);
}

std::vector<TimedSample> ToSeconds(const std::vector<ImuSample>& samples, int64_t epoch_ns) {
  std::vector<TimedSample> timed;
  timed.reserve(samples.size());
  for (const ImuSample& s : samples)
    timed.push_back({Seconds(s.t_ns, epoch_ns), s.value, {0, 0, 0}});
  return timed;
}

/// Unit quaternions, neighbours in the same hemisphere.
std::vector<TimedPose> ToSeconds(const std::vector<PoseSample>& samples, int64_t epoch_ns) {
  std::vector<TimedPose> timed;
  timed.reserve(samples.size());
  for (const PoseSample& s : samples) {
    Eigen::Quaterniond q = s.q_WM.normalized();
    if (!timed.empty() && q.dot(timed.back().q_WM) < 0.0) q.coeffs() *= -1.0;
    timed.push_back({Seconds(s.t_ns, epoch_ns), q, s.p_WM, 1.0, 1.0, {0, 0, 0}, {0, 0, 0}});
  }
  return timed;
}

/// Noise of each pose relative to the median, when all poses state theirs.
void ScaleNoise(const std::vector<PoseSample>& samples, std::vector<TimedPose>* poses) {
  const auto scale = [&](double PoseStd::*stated, double TimedPose::*result) {
    std::vector<double> sigmas;
    for (const PoseSample& s : samples) sigmas.push_back(s.stated_std.*stated);
    if (*std::min_element(sigmas.begin(), sigmas.end()) <= 0.0) return;
    const double median = Median(sigmas);
    for (size_t i = 0; i < sigmas.size(); ++i)
      (*poses)[i].*result = std::clamp(sigmas[i] / median, 1.0 / kMaxNoiseScale, kMaxNoiseScale);
  };
  scale(&PoseStd::position, &TimedPose::position_scale);
  scale(&PoseStd::rotation, &TimedPose::rotation_scale);
}

/// The median specific force of a moving body is near gravity.
void CheckAccelerometerUnit(const std::string& stream, const std::vector<TimedSample>& accel,
                            double gravity) {
  std::vector<double> norms;
  for (const TimedSample& s : accel) norms.push_back(s.value.norm());
  const double median = Median(std::move(norms));
  if (median > kMinForce * gravity && median < kMaxForce * gravity) return;
  std::ostringstream text;
  text << stream << ": median norm " << median << " (bound: " << kMinForce * gravity << " to "
       << kMaxForce * gravity << " m/s^2); ";
  if (median > 0.7 && median < 1.5)
    throw OptionNeeded(text.str() +
                       "it looks like g: set accel_unit: 9.80665 (or gravity is "
                       "removed: record the raw accelerometer)");
  if (median > 700.0 && median < 1500.0)
    throw OptionNeeded(text.str() + "it looks like mg: set accel_unit: 0.00980665");
  if (median < kMinForce * gravity)
    throw DataError(text.str() + "gravity seems to be removed: record the raw accelerometer");
  throw OptionNeeded(text.str() + "set accel_unit, the unit of the accelerometer in m/s^2");
}

/// `of`: see OfImu().
void ConditionImu(const CalibrationOptions& options, const std::string& of, const ImuData& data,
                  ConditionedImu* imu) {
  const auto clean = [&](const std::string& stream, const std::vector<ImuSample>& samples,
                         double unit, StreamReport* report) {
    auto kept = Clean(stream, options.max_bad_fraction, samples, report);
    for (ImuSample& s : kept) s.value *= unit;
    CheckAlive(stream, kept, report->received);
    RemoveSaturated(stream, options.max_bad_fraction, &kept, report);
    RemoveSpikes(&kept, report);
    return kept;
  };
  const auto gyro = clean("gyroscope" + of, data.gyro, options.gyro_unit, &imu->gyro_report);
  const auto accel =
      clean("accelerometer" + of, data.accel, options.accel_unit, &imu->accel_report);
  imu->epoch_ns = std::min(gyro.front().t_ns, accel.front().t_ns);
  imu->gyro = ToSeconds(gyro, imu->epoch_ns);
  imu->accel = ToSeconds(accel, imu->epoch_ns);
  CheckDuration("gyroscope" + of, imu->gyro, options.min_overlap_s, &imu->gyro_report);
  CheckDuration("accelerometer" + of, imu->accel, options.min_overlap_s, &imu->accel_report);
  for (const StreamReport* report : {&imu->gyro_report, &imu->accel_report})
    if (report->rate_hz < kLeastRate)
      Throw<DataError>(report == &imu->gyro_report ? "gyroscope" : "accelerometer", of, ": ",
                       report->rate_hz, " Hz (bound: at least ", kLeastRate, " Hz)");
  CheckAccelerometerUnit("accelerometer" + of, imu->accel, options.GravityMagnitude());
}

}  // namespace

bool SameValue(const PoseSample& a, const PoseSample& b) { return ValueOf(a) == ValueOf(b); }

std::vector<bool> FindRepeats(const std::vector<PoseSample>& samples) {
  return FindRepeats(samples, [](const PoseSample&, const PoseSample&) { return false; });
}

std::vector<bool> FindRepeats(const std::vector<ImuSample>& samples) {
  Eigen::Array3d resolution = Eigen::Array3d::Constant(std::numeric_limits<double>::infinity());
  for (size_t i = 1; i < samples.size(); ++i) {
    const Eigen::Array3d step = (samples[i].value - samples[i - 1].value).array().abs();
    resolution = (step > 0.0).select(resolution.min(step), resolution);
  }
  return FindRepeats(samples, [&](const ImuSample& a, const ImuSample& b) {
    return ((b.value - a.value).array().abs() < kNextSteps * resolution).all();
  });
}

PoseSample ToMarkerPose(const CalibrationOptions& options, PoseSample recorded) {
  recorded.p_WM *= options.position_unit;
  if (!options.invert_poses) return recorded;
  recorded.q_WM = recorded.q_WM.conjugate();
  recorded.p_WM = -(recorded.q_WM.normalized() * recorded.p_WM);
  return recorded;
}

ConditionedData ConditionData(const CalibrationOptions& options, const SessionData& recorded) {
  SessionData session = recorded;
  const SessionStamps stamps = RecoverStamps(options.recover_stamps, &session);
  return ConditionData(options, session, stamps);
}

ConditionedData ConditionData(const CalibrationOptions& options, const SessionData& session,
                              const SessionStamps& stamps) {
  ConditionedData out;
  out.pose_report = stamps.poses;
  auto poses = Clean("pose", options.max_bad_fraction, session.poses, &out.pose_report);
  for (PoseSample& s : poses) s = ToMarkerPose(options, s);
  CheckAlive(poses);
  out.pose_report.between_updates = KeepOneOf(FindUpdatePeriod(poses), &poses);
  out.pose_epoch_ns = poses.front().t_ns;
  out.poses = ToSeconds(poses, out.pose_epoch_ns);
  ScaleNoise(poses, &out.poses);
  CheckDuration("pose", out.poses, options.min_overlap_s, &out.pose_report);
  const bool has_imu = std::any_of(session.imus.begin(), session.imus.end(),
                                   [](const ImuData& imu) { return !imu.IsEmpty(); });
  out.imus.resize(session.imus.size());
  for (size_t i = 0; i < session.imus.size(); ++i) {
    std::tie(out.imus[i].gyro_report, out.imus[i].accel_report) = stamps.imus[i];
    if (has_imu && session.imus[i].IsEmpty()) continue;
    ConditionImu(options, OfImu(i, session.imus.size()), session.imus[i], &out.imus[i]);
  }
  SplitAtGaps(options, &out);
  return out;
}

}  // namespace imu_pose_calib
