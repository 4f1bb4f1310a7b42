#pragma once

#include <memory>

#include "imu_pose_calib/core/calibration/correction_splines.h"
#include "imu_pose_calib/core/calibration/estimate.h"

namespace imu_pose_calib {

/// What splines with knots `spacing_s` [s] apart follow well, below the highest frequency that they
/// can hold [Hz].
inline double Band(double spacing_s) { return 0.5625 * 0.5 / spacing_s; }

/// The session with nothing beyond `cutoff` [Hz] in its trajectory, its poses and the samples of
/// its IMUs, all smoothed alike; what is taken from a sample is its `rest`. doc/math.md, S4, "One
/// band".
PreparedSession LimitBand(const PreparedSession& session, double cutoff, int threads);

/// What LimitBand() returned for the band of splines with one sample between knots of those that
/// are smoothed, which stands for the others: where a trajectory cannot follow samples, that passes
/// for what the calibration is told by. doc/math.md, S4, "One band".
PreparedSession Thinned(const PreparedSession& limited, const Estimate& estimate, size_t session,
                        const CorrectionSplines& splines);

/// What `splines` make of `gp`, where they are, with what LimitBand() leaves a trajectory of their
/// band.
std::shared_ptr<const PoseTrajectory> SmoothTrajectory(const PoseTrajectory& gp,
                                                       const CorrectionSplines& splines,
                                                       int threads);

}  // namespace imu_pose_calib
