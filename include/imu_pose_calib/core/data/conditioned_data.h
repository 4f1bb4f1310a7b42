#pragma once

#include <algorithm>
#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/median.h"
#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// A pose at `t` [s] after ConditionedData::pose_epoch_ns.
struct TimedPose {
  double t;
  Eigen::Quaterniond q_WM;
  Eigen::Vector3d p_WM;
  /// Noise of position and rotation relative to the usual pose's, as far as the source states it.
  double position_scale = 1.0, rotation_scale = 1.0;
  /// What LimitBand() took: recorded less p_WM [m], and from q_WM to recorded [rad] in M.
  Eigen::Vector3d position_rest = Eigen::Vector3d::Zero(), rotation_rest = Eigen::Vector3d::Zero();
  int count = 1;  ///< recorded poses that it stands for
};

/// A gyroscope or accelerometer sample at `t` [s] after ConditionedImu::epoch_ns.
struct TimedSample {
  double t;
  Eigen::Vector3d value;
  Eigen::Vector3d rest = Eigen::Vector3d::Zero();  ///< what LimitBand() took: recorded less `value`
  int count = 1;                                   ///< recorded samples that it stands for
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
  size_t FirstImu() const {
    const auto is_present = [](const ConditionedImu& imu) { return imu.IsPresent(); };
    return static_cast<size_t>(std::find_if(imus.begin(), imus.end(), is_present) - imus.begin());
  }
};

/// " of imu1", or nothing for the only one of the rig: what messages add to the name of a sensor.
inline std::string OfImu(size_t imu, size_t count) {
  return count == 1 ? "" : " of imu" + std::to_string(imu);
}
/// " in session 2" (the first is 1), or nothing for the only one.
inline std::string OfSession(size_t session, size_t count) {
  return count == 1 ? "" : " in session " + std::to_string(session + 1);
}

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

/// Removes the poses that leave, and segments of which less than two are left, and returns how many
/// have gone.
size_t RemovePoses(const std::vector<bool>& leaves, ConditionedData* data);

/// Cuts the poses into segments at gaps; runs that are too short are dropped and counted.
/// Throws DataError when no run is left.
void SplitAtGaps(const CalibrationOptions& options, ConditionedData* data);

/// Cuts the segments where a pose cannot follow from the one before it (swapped marker labels, a
/// tracker that finds itself anew) and counts the jumps. Runs between jumps that are too short for
/// a segment are dropped and count as outliers. Single spikes must be gone already.
/// Throws DataError when no run is left.
void SplitAtJumps(const CalibrationOptions& options, ConditionedData* data);

}  // namespace imu_pose_calib
