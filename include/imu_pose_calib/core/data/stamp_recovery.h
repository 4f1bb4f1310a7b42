#pragma once

#include <cstdint>
#include <optional>
#include <utility>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/result.h"
#include "imu_pose_calib/core/base/types.h"

namespace imu_pose_calib {

/// Share of a period within which no source samples again: stamps of such samples are of a bunch.
constexpr double kBunch = 0.25;
/// Share of the samples that may be otherwise than a clock wants them.
constexpr double kExceptions = 0.1;
/// Sigmas by which stamps and clocks must differ from what is assumed of them.
constexpr double kSureSigmas = 4.0;

/// Why a stamp is not believed: hours from the others (stamp 0, clock set meanwhile); more than a
/// second after most of what arrived around it; more than a second before one that arrived earlier.
enum class StampFault { kNone, kAstray, kAhead, kReversed };

/// The faults of stamps in order of arrival.
std::vector<StampFault> JudgeStamps(const std::vector<int64_t>& stamps_ns);

template <typename Sample>
std::vector<int64_t> Stamps(const std::vector<Sample>& samples) {
  std::vector<int64_t> stamps_ns;
  for (const Sample& s : samples) stamps_ns.push_back(s.t_ns);
  return stamps_ns;
}

/// Reports of a session's streams that tell of their stamps, and of nothing else yet.
struct SessionStamps {
  StreamReport poses;
  std::vector<std::pair<StreamReport, StreamReport>> imus;  ///< gyroscope, accelerometer
};

/// Whether stamps [ns] are even within what matters little, but for some that are missing.
bool AreEven(std::vector<int64_t> stamps_ns);

/// Stamps of the clock of a source that samples evenly, but for missing frames, from those recorded
/// in order of arrival, with which they agree on average (doc/math.md, "Clock of the stamps").
/// Where the clock breaks another one begins; stretches too short for one stay as recorded. Nothing
/// when counting periods does not explain the stamps.
std::optional<std::vector<int64_t>> RecoverClock(const std::vector<int64_t>& recorded_ns);

/// Gives the samples of `session`, in order of arrival, the stamps of their sources' own clocks
/// (RecoverClock()) where the mode says so; kAuto: where the recorded ones are uneven and the
/// samples follow each other more smoothly at the recovered ones. Sensors of an IMU that share
/// their stamps keep doing so. Stamps that are not believed (JudgeStamps()) stay.
SessionStamps RecoverStamps(StampRecovery mode, SessionData* session);

}  // namespace imu_pose_calib
