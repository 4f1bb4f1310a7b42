#pragma once

#include <limits>

#include "imu_pose_calib/core/base/options.h"

namespace imu_pose_calib {

/// What a number, or the norm of a vector, must be within.
struct Bound {
  double low = -std::numeric_limits<double>::infinity();
  double high = std::numeric_limits<double>::infinity();
  bool or_zero = false;  ///< 0 has a meaning of its own
};

/// Calls `visit(name, field, bound)` for every field of CalibrationOptions, in the order of the
/// struct. The one list of names and bounds: checks and the keys of the YAML files follow from it.
template <typename Options, typename Visitor>
void VisitFields(Options&& options, Visitor&& visit) {
#define IMU_POSE_CALIB_FIELD(field) #field, options.field
  visit(IMU_POSE_CALIB_FIELD(method), Bound{});
  visit(IMU_POSE_CALIB_FIELD(position_unit), Bound{1e-9, 1e9});
  visit(IMU_POSE_CALIB_FIELD(gyro_unit), Bound{1e-9, 1e9});
  visit(IMU_POSE_CALIB_FIELD(accel_unit), Bound{1e-9, 1e9});
  visit(IMU_POSE_CALIB_FIELD(invert_poses), Bound{});
  visit(IMU_POSE_CALIB_FIELD(recover_stamps), Bound{});
  visit(IMU_POSE_CALIB_FIELD(max_gap_s), Bound{0.0, 1e3});
  visit(IMU_POSE_CALIB_FIELD(min_segment_s), Bound{0.0, 1e3});
  visit(IMU_POSE_CALIB_FIELD(min_overlap_s), Bound{1.0, 1e6});
  visit(IMU_POSE_CALIB_FIELD(max_bad_fraction), Bound{0.0, 1.0});
  visit(IMU_POSE_CALIB_FIELD(gyro_noise_density), Bound{1e-9, 1e3});
  visit(IMU_POSE_CALIB_FIELD(accel_noise_density), Bound{1e-9, 1e3});
  visit(IMU_POSE_CALIB_FIELD(gyro_bias_walk), Bound{1e-12, 1e3});
  visit(IMU_POSE_CALIB_FIELD(accel_bias_walk), Bound{1e-12, 1e3});
  visit(IMU_POSE_CALIB_FIELD(bias_knot_interval_s), Bound{1e-2, 1e9, true});
  visit(IMU_POSE_CALIB_FIELD(position_lengthscale_s), Bound{1e-3, 1e3, true});
  visit(IMU_POSE_CALIB_FIELD(position_signal_std), Bound{0.0, 1e9});
  visit(IMU_POSE_CALIB_FIELD(position_noise_std), Bound{0.0, 1e3});
  visit(IMU_POSE_CALIB_FIELD(rotation_lengthscale_s), Bound{1e-3, 1e3, true});
  visit(IMU_POSE_CALIB_FIELD(rotation_signal_std), Bound{0.0, 1e3});
  visit(IMU_POSE_CALIB_FIELD(rotation_noise_std), Bound{0.0, 1e3});
  visit(IMU_POSE_CALIB_FIELD(outlier_threshold), Bound{3.0});
  visit(IMU_POSE_CALIB_FIELD(initial_time_shift), Bound{-1e10, 1e10});
  visit(IMU_POSE_CALIB_FIELD(initial_rotation), Bound{0.99, 1.01});
  visit(IMU_POSE_CALIB_FIELD(initial_translation), Bound{0.0, 1e3});
  visit(IMU_POSE_CALIB_FIELD(initial_gravity), Bound{0.1, 100.0});
  visit(IMU_POSE_CALIB_FIELD(estimate_time_shift), Bound{});
  visit(IMU_POSE_CALIB_FIELD(estimate_rotation), Bound{});
  visit(IMU_POSE_CALIB_FIELD(estimate_translation), Bound{});
  visit(IMU_POSE_CALIB_FIELD(estimate_gravity), Bound{});
  visit(IMU_POSE_CALIB_FIELD(estimate_accel_delay), Bound{});
  visit(IMU_POSE_CALIB_FIELD(accel_delay), Bound{-0.5, 0.5});
  visit(IMU_POSE_CALIB_FIELD(estimate_pose_smoothing), Bound{});
  visit(IMU_POSE_CALIB_FIELD(estimate_pose_scale), Bound{});
  visit(IMU_POSE_CALIB_FIELD(estimate_accel_smoothing), Bound{});
  visit(IMU_POSE_CALIB_FIELD(estimate_clock_drift), Bound{});
  visit(IMU_POSE_CALIB_FIELD(estimate_clock_walk), Bound{});
  visit(IMU_POSE_CALIB_FIELD(imu_model), Bound{});
  visit(IMU_POSE_CALIB_FIELD(estimate_size_effect), Bound{});
  visit(IMU_POSE_CALIB_FIELD(gravity_magnitude), Bound{0.1, 100.0});
  visit(IMU_POSE_CALIB_FIELD(gravity_magnitude_std), Bound{1e-9, 10.0});
  visit(IMU_POSE_CALIB_FIELD(latitude), Bound{-90.0, 90.0});
  visit(IMU_POSE_CALIB_FIELD(knot_spacing_s), Bound{1e-3, 10.0, true});
  visit(IMU_POSE_CALIB_FIELD(robust_loss_scale), Bound{1.0});
  visit(IMU_POSE_CALIB_FIELD(max_iterations), Bound{1, 10000});
  visit(IMU_POSE_CALIB_FIELD(num_threads), Bound{0, 1024});
  visit(IMU_POSE_CALIB_FIELD(max_factor_mb), Bound{0.0, 1e6});
  visit(IMU_POSE_CALIB_FIELD(covariance_block_s), Bound{0.1, 1e6, true});
  visit(IMU_POSE_CALIB_FIELD(weak_rotation_std), Bound{1e-9, 1.0});
  visit(IMU_POSE_CALIB_FIELD(weak_translation_std), Bound{1e-9, 10.0});
  visit(IMU_POSE_CALIB_FIELD(weak_time_shift_std), Bound{1e-9, 1.0});
#undef IMU_POSE_CALIB_FIELD
}

}  // namespace imu_pose_calib
