#include "imu_pose_calib/core/conditioning.h"

#include <algorithm>
#include <cmath>
#include <sstream>
#include <string>
#include <utility>

#include "imu_pose_calib/core/median.h"

namespace imu_pose_calib {
namespace {

/// A sample that arrives up to this much after a later-stamped one is sorted in; beyond, its stamp
/// is not believed.
constexpr int64_t kMaxReorderNs = 1'000'000'000;
constexpr size_t kMinSegmentPoses = 8;
/// Median specific force of a moving body, in units of gravity.
constexpr double kMinForce = 0.4, kMaxForce = 10.0;

bool IsFinite(const PoseSample& s) { return s.p_WM.allFinite() && s.q_WM.coeffs().allFinite(); }
bool IsFinite(const ImuSample& s) { return s.value.allFinite(); }

bool HasRotation(const PoseSample& s) { return s.q_WM.norm() > 1e-3; }
bool HasRotation(const ImuSample&) { return true; }

bool SameValue(const PoseSample& a, const PoseSample& b) {
  return a.p_WM == b.p_WM && a.q_WM.coeffs() == b.q_WM.coeffs();
}
bool SameValue(const ImuSample& a, const ImuSample& b) { return a.value == b.value; }

template <typename... Args>
[[noreturn]] void Refuse(const Args&... args) {
  std::ostringstream text;
  (text << ... << args);
  throw DataError(text.str());
}

/// Throws when `bad` of `total` samples exceed the allowed share.
void CheckShare(const std::string& stream,
                const std::string& defect,
                size_t bad,
                size_t total,
                double max_fraction) {
  if (static_cast<double>(bad) <= max_fraction * static_cast<double>(total)) return;
  Refuse(stream,
         ": ",
         bad,
         " of ",
         total,
         " samples ",
         defect,
         " (bound: ",
         100.0 * max_fraction,
         " %)");
}

/// Usable samples in strictly increasing time, each with a value of its own.
template <typename Sample>
std::vector<Sample> Clean(const std::string& stream,
                          double max_bad_fraction,
                          const std::vector<Sample>& samples,
                          StreamReport* report) {
  report->received = samples.size();
  if (samples.empty()) Refuse("no ", stream, " samples");

  std::vector<Sample> kept;
  kept.reserve(samples.size());
  int64_t latest = samples.front().t_ns;
  for (const Sample& s : samples) {
    if (!IsFinite(s)) {
      ++report->not_finite;
    } else if (!HasRotation(s)) {
      ++report->zero_quaternion;
    } else if (s.t_ns < latest - kMaxReorderNs) {
      ++report->reversed_stamp;
    } else {
      latest = std::max(latest, s.t_ns);
      kept.push_back(s);
    }
  }
  const size_t n = samples.size();
  CheckShare(stream, "are not finite", report->not_finite, n, max_bad_fraction);
  CheckShare(stream, "have a zero quaternion", report->zero_quaternion, n, max_bad_fraction);
  CheckShare(stream,
             "are stamped more than 1 s before a sample that arrived earlier: its clock jumped "
             "back; cut the recording at the jump",
             report->reversed_stamp,
             n,
             max_bad_fraction);

  if (kept.empty()) Refuse("none of the ", n, " ", stream, " samples is usable");

  std::stable_sort(
      kept.begin(), kept.end(), [](const Sample& a, const Sample& b) { return a.t_ns < b.t_ns; });
  size_t last = 0;
  for (size_t i = 1; i < kept.size(); ++i) {
    if (kept[i].t_ns == kept[last].t_ns) {
      ++report->duplicate_stamp;
    } else if (SameValue(kept[i], kept[last])) {
      ++report->repeated_value;
    } else {
      kept[++last] = kept[i];
    }
  }
  kept.resize(last + 1);
  return kept;
}

/// Fills `used`, rate and duration from the stamps [s] of the samples used.
template <typename Timed>
void Summarise(const std::vector<Timed>& samples, StreamReport* report) {
  report->used = samples.size();
  if (samples.size() < 2) return;
  std::vector<double> periods;
  for (size_t i = 1; i < samples.size(); ++i) periods.push_back(samples[i].t - samples[i - 1].t);
  report->rate_hz = 1.0 / Median(std::move(periods));
  report->duration_s = samples.back().t - samples.front().t;
}

void CheckDuration(const std::string& stream, const StreamReport& report, double min_s) {
  if (report.duration_s >= min_s) return;
  Refuse(stream,
         ": ",
         report.used,
         " of ",
         report.received,
         " samples are usable and span ",
         report.duration_s,
         " s (bound: at least ",
         min_s,
         " s; not finite ",
         report.not_finite,
         ", repeated ",
         report.repeated_value,
         ", stamped backwards ",
         report.reversed_stamp,
         ", duplicate stamp ",
         report.duplicate_stamp,
         ")");
}

double Seconds(int64_t t_ns, int64_t epoch_ns) {
  return 1e-9 * static_cast<double>(t_ns - epoch_ns);
}

std::vector<TimedSample> ToSeconds(const std::vector<ImuSample>& samples, int64_t epoch_ns) {
  std::vector<TimedSample> timed;
  timed.reserve(samples.size());
  for (const ImuSample& s : samples) timed.push_back({Seconds(s.t_ns, epoch_ns), s.value});
  return timed;
}

/// Unit quaternions, neighbours in the same hemisphere.
std::vector<TimedPose> ToSeconds(const std::vector<PoseSample>& samples, int64_t epoch_ns) {
  std::vector<TimedPose> timed;
  timed.reserve(samples.size());
  for (const PoseSample& s : samples) {
    Eigen::Quaterniond q = s.q_WM.normalized();
    if (!timed.empty() && q.dot(timed.back().q_WM) < 0.0) q.coeffs() *= -1.0;
    timed.push_back({Seconds(s.t_ns, epoch_ns), q, s.p_WM});
  }
  return timed;
}

/// Cuts the poses at gaps; runs that are too short are dropped and counted.
void SplitAtGaps(const CalibrationOptions& options, ConditionedData* data) {
  const double max_gap =
      options.max_gap_s > 0.0 ? options.max_gap_s : std::max(0.1, 5.0 / data->pose_report.rate_hz);
  std::vector<TimedPose> kept;
  size_t begin = 0;
  for (size_t i = 1; i <= data->poses.size(); ++i) {
    const bool end = i == data->poses.size();
    if (!end && data->poses[i].t - data->poses[i - 1].t <= max_gap) continue;
    if (!end) ++data->gaps;
    if (i - begin >= kMinSegmentPoses &&
        data->poses[i - 1].t - data->poses[begin].t >= options.min_segment_s) {
      data->segments.push_back({kept.size(), kept.size() + i - begin});
      kept.insert(kept.end(),
                  data->poses.begin() + static_cast<ptrdiff_t>(begin),
                  data->poses.begin() + static_cast<ptrdiff_t>(i));
    } else {
      data->pose_report.in_short_segment += i - begin;
    }
    begin = i;
  }
  data->poses = std::move(kept);
}

/// The median specific force of a moving body is near gravity.
void CheckAccelerometerUnit(const std::vector<TimedSample>& accel, double gravity) {
  std::vector<double> norms;
  for (const TimedSample& s : accel) norms.push_back(s.value.norm());
  const double median = Median(std::move(norms));
  if (median > kMinForce * gravity && median < kMaxForce * gravity) return;
  std::string hint = "expected m/s^2 with gravity included";
  if (median < kMinForce * gravity)
    hint = "gravity seems to be removed: record the raw accelerometer";
  if (median > 0.7 && median < 1.5)
    hint =
        "it looks like g: convert to m/s^2 (or gravity is removed: record the raw accelerometer)";
  Refuse("accelerometer: median norm ",
         median,
         " (bound: ",
         kMinForce * gravity,
         " to ",
         kMaxForce * gravity,
         " m/s^2); ",
         hint);
}

}  // namespace

ConditionedData Condition(const CalibrationOptions& options, const CalibrationData& data) {
  ConditionedData out;
  const double max_bad = options.max_bad_fraction;
  const auto poses = Clean("pose", max_bad, data.poses, &out.pose_report);
  const auto gyro = Clean("gyroscope", max_bad, data.gyro, &out.gyro_report);
  const auto accel = Clean("accelerometer", max_bad, data.accel, &out.accel_report);

  out.pose_epoch_ns = poses.front().t_ns;
  out.imu_epoch_ns = std::min(gyro.front().t_ns, accel.front().t_ns);
  out.poses = ToSeconds(poses, out.pose_epoch_ns);
  out.gyro = ToSeconds(gyro, out.imu_epoch_ns);
  out.accel = ToSeconds(accel, out.imu_epoch_ns);

  Summarise(out.poses, &out.pose_report);
  Summarise(out.gyro, &out.gyro_report);
  Summarise(out.accel, &out.accel_report);
  CheckDuration("pose", out.pose_report, options.min_overlap_s);
  CheckDuration("gyroscope", out.gyro_report, options.min_overlap_s);
  CheckDuration("accelerometer", out.accel_report, options.min_overlap_s);

  SplitAtGaps(options, &out);
  Summarise(out.poses, &out.pose_report);
  if (out.segments.empty())
    Refuse("pose: no run without a gap is as long as min_segment_s = ",
           options.min_segment_s,
           " s (",
           out.gaps,
           " gaps in ",
           out.pose_report.received,
           " poses)");
  CheckAccelerometerUnit(out.accel, options.gravity_magnitude);
  return out;
}

}  // namespace imu_pose_calib
