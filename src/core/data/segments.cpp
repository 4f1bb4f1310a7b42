#include <algorithm>
#include <utility>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/base/text.h"
#include "imu_pose_calib/core/data/conditioned_data.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kMinSegmentPoses = 8;
/// A jump between two poses: times the median of so many poses on either side, and times what the
/// IMU's largest samples make possible.
constexpr double kJumpThreshold = 20.0;
constexpr size_t kJumpRadius = 10;
constexpr double kMotionFactor = 3.0;

/// Longest time between two poses of a segment [s].
double MaxGap(const CalibrationOptions& options, const ConditionedData& data) {
  return options.max_gap_s > 0.0 ? options.max_gap_s
                                 : std::max(0.1, 5.0 / data.pose_report.rate_hz);
}

/// How far pose i is from where pose i - 1 leads with the mean velocity of the steps before and
/// after: (position [m], rotation [rad]).
Eigen::Array2d Jump(const std::vector<TimedPose>& poses, size_t i) {
  const TimedPose &a = poses[i - 2], &b = poses[i - 1], &c = poses[i], &d = poses[i + 1];
  const double dt = c.t - b.t, dt_before = b.t - a.t, dt_after = d.t - c.t;
  const Eigen::Vector3d step =
      0.5 * dt * ((b.p_WM - a.p_WM) / dt_before + (d.p_WM - c.p_WM) / dt_after);
  const auto turn = [](const TimedPose& from, const TimedPose& to) {
    return Log(Eigen::Quaterniond(from.q_WM.conjugate() * to.q_WM));
  };
  const Eigen::Quaterniond half_before = Exp<double>(0.5 * dt / dt_before * turn(a, b));
  const Eigen::Quaterniond half_after = Exp<double>(0.5 * dt / dt_after * turn(c, d));
  return {(c.p_WM - b.p_WM - step).norm(),
          (b.q_WM * half_before * half_after).angularDistance(c.q_WM)};
}

/// Poses that cannot follow from the one before: off by many times what is usual nearby, and by
/// more than the IMU allows.
std::vector<size_t> FindJumps(const ConditionedData& data) {
  double rate = 0.0, force = 0.0;  // the largest [rad/s], [m/s^2]
  for (const ConditionedImu& imu : data.imus) {
    for (const TimedSample& s : imu.gyro) rate = std::max(rate, s.value.norm());
    for (const TimedSample& s : imu.accel) force = std::max(force, s.value.norm());
  }
  const std::vector<TimedPose>& poses = data.poses;
  std::vector<Eigen::Array2d> jumps(poses.size(), Eigen::Array2d::Zero());
  for (const IndexRange& s : data.segments)
    for (size_t i = s.begin + 2; i + 1 < s.end; ++i) jumps[i] = Jump(poses, i);
  std::vector<size_t> found;
  for (const IndexRange& s : data.segments) {
    for (size_t i = s.begin + 2; i + 1 < s.end; ++i) {
      const double dt = poses[i].t - poses[i - 1].t;
      const Eigen::Array2d possible(kMotionFactor * force * dt * dt, kMotionFactor * rate * dt);
      // A jump shows in the steps on either side too, by half.
      const Eigen::Array2d beside = 0.75 * jumps[i - 1].max(jumps[i + 1]);
      if ((jumps[i] <= possible.max(beside)).all()) continue;
      const Eigen::Array2d usual =
          MedianOfEach(std::max(s.begin, i - std::min(i, kJumpRadius)),
                       std::min(s.end, i + kJumpRadius), [&](size_t k) { return jumps[k]; });
      const double periods = std::max(1.0, dt * data.pose_report.rate_hz);
      if ((jumps[i] > possible.max(beside).max(kJumpThreshold * periods * usual)).any())
        found.push_back(i);
    }
  }
  return found;
}

/// Adds a run of `poses` to the data: to their last segment, or as another one.
void AppendRun(const std::vector<TimedPose>& poses, IndexRange run, bool joins,
               ConditionedData* data) {
  if (!joins) data->segments.push_back({data->poses.size(), data->poses.size()});
  data->poses.insert(data->poses.end(), poses.begin() + static_cast<ptrdiff_t>(run.begin),
                     poses.begin() + static_cast<ptrdiff_t>(run.end));
  data->segments.back().end = data->poses.size();
}

/// Cuts the segments before the poses at `cuts` and counts gaps and jumps between what is kept:
/// runs that are too short leave, and what remains on both sides of one is joined again where it is
/// close enough.
void Cut(const std::vector<size_t>& cuts, double max_gap, double min_segment_s,
         ConditionedData* data, size_t* left) {
  const std::vector<TimedPose> poses = std::exchange(data->poses, {});
  const std::vector<IndexRange> segments = std::exchange(data->segments, {});
  auto cut = cuts.begin();
  for (const IndexRange& segment : segments) {
    size_t last_end = segment.begin;  // of the run kept last
    for (size_t begin = segment.begin; begin < segment.end;) {
      while (cut != cuts.end() && *cut <= begin) ++cut;
      const size_t end = cut != cuts.end() ? std::min(*cut, segment.end) : segment.end;
      const IndexRange run{begin, end};
      begin = end;
      if (run.size() < kMinSegmentPoses ||
          poses[run.end - 1].t - poses[run.begin].t < min_segment_s) {
        *left += run.size();
        continue;
      }
      const bool is_near =
          last_end > segment.begin && poses[run.begin].t - poses[last_end - 1].t <= max_gap;
      const bool is_next = last_end == run.begin;
      if (last_end > segment.begin && (is_next || !is_near)) ++(is_near ? data->jumps : data->gaps);
      AppendRun(poses, run, is_near && !is_next, data);
      last_end = run.end;
    }
  }
}

}  // namespace

size_t RemovePoses(const std::vector<bool>& leaves, ConditionedData* data) {
  const std::vector<TimedPose> poses = std::exchange(data->poses, {});
  const std::vector<IndexRange> segments = std::exchange(data->segments, {});
  for (const IndexRange& segment : segments) {
    std::vector<TimedPose> kept;
    for (size_t i = segment.begin; i < segment.end; ++i)
      if (!leaves[i]) kept.push_back(poses[i]);
    if (kept.size() >= 2) AppendRun(kept, {0, kept.size()}, false, data);
  }
  data->pose_report.used = data->poses.size();
  return poses.size() - data->poses.size();
}

void SplitAtGaps(const CalibrationOptions& options, ConditionedData* data) {
  const double max_gap = MaxGap(options, *data);
  std::vector<size_t> gaps;
  for (size_t i = 1; i < data->poses.size(); ++i)
    if (data->poses[i].t - data->poses[i - 1].t > max_gap) gaps.push_back(i);
  data->segments = {{0, data->poses.size()}};
  Cut(gaps, max_gap, options.min_segment_s, data, &data->pose_report.in_short_segment);
  data->gaps = gaps.size();  // beside runs that have left, too
  Summarise(data->poses, &data->pose_report);
  if (data->segments.empty())
    Throw<DataError>(
        "pose: no run without a gap is as long as min_segment_s = ", options.min_segment_s, " s (",
        data->gaps, " gaps in ", data->pose_report.received, " poses)");
}

void SplitAtJumps(const CalibrationOptions& options, ConditionedData* data) {
  const double max_gap = MaxGap(options, *data);
  for (auto jumps = FindJumps(*data); !jumps.empty(); jumps = FindJumps(*data)) {
    Cut(jumps, max_gap, options.min_segment_s, data, &data->pose_report.outlier);
    if (!data->segments.empty()) continue;
    Throw<DataError>(
        "pose: it jumps so often that no run is as long as min_segment_s = ", options.min_segment_s,
        " s; look at the tracker's rigid body and record again");
  }
  Summarise(data->poses, &data->pose_report);
}

}  // namespace imu_pose_calib
