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
  const auto check = [](const char* name, bool is_estimated, size_t count, const char* what) {
    if (!is_estimated && count > 1)
      Throw<InputError>(name, " = false needs a single ", what,
                        ": one value is given, but there are several");
  };
  check("estimate_rotation", options.estimate_rotation, imus, "imu");
  check("estimate_translation", options.estimate_translation, imus, "imu");
  check("estimate_accel_delay", options.estimate_accel_delay, imus, "imu");
  check("estimate_time_shift", options.estimate_time_shift, imus * sessions, "imu and recording");
  check("estimate_gravity", options.estimate_gravity, sessions, "recording");
}

PreparedSession Prepare(const CalibrationOptions& options, const SessionData& recorded,
                        DataCheck* check) {
  SessionData session = recorded;
  const SessionStamps stamps = RecoverStamps(options.recover_stamps, &session);
  CheckStreams(recorded, session, stamps, check);
  PreparedSession prepared;
  prepared.data = ConditionData(options, session, stamps);
  PoseTrajectory trajectory = FitTrajectory(options, &prepared.data);
  RemoveFlippedSegments(options, &trajectory, &prepared.data);
  prepared.pose_noise = {trajectory.position_hyperparameters().noise_std,
                         trajectory.rotation_hyperparameters().noise_std};
  prepared.trajectory = std::make_shared<const PoseTrajectory>(std::move(trajectory));
  // With a known lever arm or rotation a turn about one axis may do: the covariance will tell.
  const bool is_free = options.estimate_translation && options.estimate_rotation;
  CheckMotion(options, prepared.data, *prepared.trajectory, is_free || prepared.data.imus.empty(),
              check);
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
