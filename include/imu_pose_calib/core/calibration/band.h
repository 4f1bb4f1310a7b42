#pragma once

#include "imu_pose_calib/core/calibration/estimate.h"

namespace imu_pose_calib {

/// What splines with knots `spacing_s` [s] apart follow well, below the highest frequency that they
/// can hold [Hz].
inline double Band(double spacing_s) { return 0.75 * 0.5 / spacing_s; }

/// The session with nothing beyond `cutoff` [Hz] in its trajectory, its poses and the samples of
/// its IMUs, all smoothed alike; what is taken from a sample is its `rest`. doc/math.md, S4, "One
/// band".
PreparedSession LimitBand(const PreparedSession& session, double cutoff, int threads);

/// What LimitBand() returned for that `cutoff` [Hz] with one sample of each few that are smoothed,
/// which stands for them.
PreparedSession Thinned(const PreparedSession& limited, double cutoff);

/// Trajectory through `poses` at the instants of the session's that are as good as exact, but for
/// those of a larger `noise_scale`, with what LimitBand() leaves a trajectory of `cutoff` [Hz].
std::shared_ptr<const PoseTrajectory> SmoothTrajectory(const PreparedSession& session,
                                                       const std::vector<TimedPose>& poses,
                                                       const Eigen::VectorXd& noise_scale,
                                                       double cutoff, int threads);

}  // namespace imu_pose_calib
