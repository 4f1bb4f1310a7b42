#pragma once

#include <vector>

#include "imu_pose_calib/core/simulator.h"

namespace imu_pose_calib {

/// An effect that one number switches on.
struct EffectOption {
  const char* name;
  const char* unit;
  const char* text;
  double usual;        ///< strength that recordings have
  double least, most;  ///< that make sense
  double& (*strength)(SimulatorOptions* options);
};

/// All effects that recordings usually have.
const std::vector<EffectOption>& EffectOptions();

}  // namespace imu_pose_calib
