#pragma once

#include <algorithm>
#include <string>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/base/types.h"
#include "imu_pose_calib/core/data/stamp_recovery.h"

namespace imu_pose_calib {

/// A sample stamped further from the median of its stream is astray (stamp 0, clock set meanwhile).
constexpr int64_t kMaxAstrayNs = 6 * 3600 * int64_t{1'000'000'000};

/// A sample that arrives up to this much after a later-stamped one is sorted in; beyond, one of the
/// stamps is not believed.
constexpr int64_t kMaxReorderNs = 1'000'000'000;

/// Why a stamp is not believed: hours from the others; after most of what arrived around it, see
/// IsStampedAhead(); more than a second before one that arrived earlier.
enum class StampFault { kNone, kAstray, kAhead, kReversed };

/// Whether stamp i, in order of arrival, is by more than a second after most of those that come
/// next, and after most of those before it as well. The last before a clock jumps back agree with
/// those before them, the first after a pause with those that come next.
bool IsStampedAhead(const std::vector<int64_t>& stamps_ns, size_t i);

/// The faults of stamps in order of arrival.
std::vector<StampFault> JudgeStamps(const std::vector<int64_t>& stamps_ns);

template <typename Sample>
std::vector<int64_t> Stamps(const std::vector<Sample>& samples) {
  std::vector<int64_t> stamps_ns;
  for (const Sample& s : samples) stamps_ns.push_back(s.t_ns);
  return stamps_ns;
}

/// A pose at `t` [s] after ConditionedData::pose_epoch_ns.
struct TimedPose {
  double t;
  Eigen::Quaterniond q_WM;
  Eigen::Vector3d p_WM;
  /// Noise of position and rotation relative to the usual pose's, as far as the source states it.
  double position_scale = 1.0, rotation_scale = 1.0;
  /// What LimitBand() took: recorded less p_WM [m], and from q_WM to recorded [rad] in M.
  Eigen::Vector3d position_rest = Eigen::Vector3d::Zero(), rotation_rest = Eigen::Vector3d::Zero();
};

/// A gyroscope or accelerometer sample at `t` [s] after ConditionedImu::epoch_ns.
struct TimedSample {
  double t;
  Eigen::Vector3d value;
  Eigen::Vector3d rest = Eigen::Vector3d::Zero();  ///< what LimitBand() took: recorded less `value`
};

/// Half-open range of indices.
struct IndexRange {
  size_t begin = 0, end = 0;
  size_t size() const { return end - begin; }
};

/// The samples of one IMU; without any when the session lacks it.
struct ConditionedImu {
  int64_t epoch_ns = 0;  ///< IMU clock
  std::vector<TimedSample> gyro;
  std::vector<TimedSample> accel;
  StreamReport gyro_report, accel_report;

  bool IsPresent() const { return !gyro.empty(); }
  /// [s], at which a time shift holds.
  double MiddleOfGyro() const { return 0.5 * (gyro.front().t + gyro.back().t); }
};

/// A recording that the next stages can rely on: finite, in strictly increasing time, without
/// repeated samples, unit quaternions of continuous sign, in SI units.
struct ConditionedData {
  int64_t pose_epoch_ns = 0;  ///< pose clock
  std::vector<TimedPose> poses;
  std::vector<IndexRange> segments;  ///< of `poses`: runs without a gap
  std::vector<ConditionedImu> imus;  ///< in the order of the rig

  StreamReport pose_report;
  size_t gaps = 0;
  size_t jumps = 0;

  /// Place of the first IMU that the session has.
  size_t FirstImu() const;
};

/// " of imu1", or nothing for the only one of the rig: what messages add to the name of a sensor.
std::string OfImu(size_t imu, size_t count);
/// " in session 2" (the first is 1), or nothing for the only one.
std::string OfSession(size_t session, size_t count);

/// The pose T_WM [m] of what was recorded as the options say.
PoseSample ToMarkerPose(const CalibrationOptions& options, PoseSample recorded);

/// Whether two samples are the same but for their stamps.
bool SameValue(const PoseSample& a, const PoseSample& b);
bool SameValue(const ImuSample& a, const ImuSample& b);

/// Stage S0. Every dropped sample is counted in a report.
/// Throws DataError naming the number and the bound when a stream is empty, too short, mostly
/// unusable, or not in SI units.
ConditionedData ConditionData(const CalibrationOptions& options, const SessionData& session);

/// The same once RecoverStamps() has looked at the stamps.
ConditionedData ConditionData(const CalibrationOptions& options, const SessionData& session,
                              const SessionStamps& stamps);

/// Poses from one measurement to the next of a filter that carries them on with an IMU in between,
/// or of an interpolation: there, they jump or bend, and no pose in between tells anything new
/// (doc/math.md, "Fused poses"). 1 when the poses show no such beat. In order of time.
size_t FindUpdatePeriod(const std::vector<PoseSample>& poses);

/// Keeps one of `period` poses, evenly in time, and returns how many have gone.
size_t KeepOneOf(size_t period, std::vector<PoseSample>* poses);

/// Fills `used`, rate and duration of the samples used, by their stamps.
template <typename Timed>
void Summarise(const std::vector<Timed>& samples, StreamReport* report) {
  report->used = samples.size();
  if (samples.size() < 2) return;
  std::vector<double> periods;
  for (size_t i = 1; i < samples.size(); ++i) periods.push_back(samples[i].t - samples[i - 1].t);
  report->rate_hz = 1.0 / Median(std::move(periods));
  report->duration_s = samples.back().t - samples.front().t;
}

}  // namespace imu_pose_calib
