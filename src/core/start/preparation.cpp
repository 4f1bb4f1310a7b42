#include "imu_pose_calib/core/start/preparation.h"

#include <string>

#include "imu_pose_calib/core/base/text.h"

namespace imu_pose_calib {
namespace {

/// S2 of one IMU. What it throws names the IMU when there are several.
Start StartOf(const CalibrationOptions& options, const PreparedSession& session, size_t imu) {
  const std::string of = OfImu(imu, session.data.imus.size());
  try {
    return Initialise(options, *session.trajectory, session.data, imu);
  } catch (const OptionNeeded& error) {
    throw OptionNeeded(error.what() + of);
  } catch (const DataError& error) {
    throw DataError(error.what() + of);
  }
}

}  // namespace

void CheckSingle(const CalibrationOptions& options, size_t imus, size_t sessions) {
  const auto refuse = [](const char* option, const char* what) {
    throw InputError(std::string(option) + " = false needs a single " + what +
                     ": one value is given, but there are several");
  };
  if (imus > 1 && !options.estimate_rotation) refuse("estimate_rotation", "imu");
  if (imus > 1 && !options.estimate_translation) refuse("estimate_translation", "imu");
  if (imus > 1 && !options.estimate_accel_delay) refuse("estimate_accel_delay", "imu");
  if (imus * sessions > 1 && !options.estimate_time_shift)
    refuse("estimate_time_shift", "imu and recording");
  if (sessions > 1 && !options.estimate_gravity) refuse("estimate_gravity", "recording");
}

PreparedSession Prepare(const CalibrationOptions& options, const SessionData& recorded,
                        DataCheck* check) {
  SessionData session = recorded;
  const SessionStamps stamps = RecoverStamps(options.recover_stamps, &session);
  *check = CheckStreams(recorded, session, stamps);
  RefuseBunches(*check);
  PreparedSession prepared;
  prepared.data = ConditionData(options, session, stamps);
  PoseTrajectory trajectory = FitTrajectory(options, &prepared.data);
  RemoveFlippedSegments(options, &trajectory, &prepared.data);
  prepared.pose_noise = {trajectory.position_hyperparameters().noise_std,
                         trajectory.rotation_hyperparameters().noise_std};
  prepared.trajectory = std::make_shared<const PoseTrajectory>(std::move(trajectory));
  CheckMotion(options, prepared.data, *prepared.trajectory, check);
  // With a known lever arm or rotation a turn about one axis may do: the covariance will tell.
  const bool is_free = options.estimate_translation && options.estimate_rotation;
  if (is_free || prepared.data.imus.empty()) CheckTurns(*prepared.trajectory);
  for (size_t i = 0; i < prepared.data.imus.size(); ++i) {
    const bool is_present = prepared.data.imus[i].IsPresent();
    prepared.starts.push_back(is_present ? StartOf(options, prepared, i) : Start());
    if (is_present)
      CheckMatch(options, prepared.data, *prepared.trajectory, prepared.starts[i], i, check);
  }
  return prepared;
}

DataCheck CheckData(const CalibrationOptions& options, const SessionData& session) {
  options.Validate();
  CheckSingle(options, session.imus.size(), 1);
  DataCheck check;
  try {
    Prepare(options, session, &check);
  } catch (const DataError& error) {
    const bool needs_option = dynamic_cast<const OptionNeeded*>(&error) != nullptr;
    check.verdict = needs_option ? DataVerdict::kUsable : DataVerdict::kRecordAgain;
    check.message = error.what();
    return check;
  }
  check.verdict = check.warnings.empty() ? DataVerdict::kGood : DataVerdict::kUsable;
  check.message = check.warnings.empty() ? "nothing to remark" : "see the warnings below";
  return check;
}

}  // namespace imu_pose_calib
