#pragma once

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/data/conditioned_data.h"

namespace imu_pose_calib {

/// Time between the knots of a session's correction splines [s]: options.knot_spacing_s, or halved
/// while the octave that splines then follow holds motion in the spectra of the IMUs, doc/math.md,
/// S4, "Knot spacing".
double ChooseKnotSpacing(const CalibrationOptions& options, const ConditionedData& data);

}  // namespace imu_pose_calib
