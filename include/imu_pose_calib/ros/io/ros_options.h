#pragma once

#include <string>
#include <utility>

#include "imu_pose_calib/core/base/options.h"

namespace imu_pose_calib {

/// Calls `visit(name, field)` for every field of CalibrationOptions, in the order of the struct.
/// The one list of names: the keys of the YAML files follow from it.
template <typename Options, typename Visitor>
void VisitFields(Options&& options, Visitor&& visit) {
#define IMU_POSE_CALIB_VISIT(field) visit(#field, options.field)
  IMU_POSE_CALIB_VISIT(method);
  IMU_POSE_CALIB_VISIT(solver);
  IMU_POSE_CALIB_VISIT(position_unit);
  IMU_POSE_CALIB_VISIT(gyro_unit);
  IMU_POSE_CALIB_VISIT(accel_unit);
  IMU_POSE_CALIB_VISIT(invert_poses);
  IMU_POSE_CALIB_VISIT(recover_stamps);
  IMU_POSE_CALIB_VISIT(max_gap_s);
  IMU_POSE_CALIB_VISIT(min_segment_s);
  IMU_POSE_CALIB_VISIT(min_overlap_s);
  IMU_POSE_CALIB_VISIT(max_bad_fraction);
  IMU_POSE_CALIB_VISIT(gyro_noise_density);
  IMU_POSE_CALIB_VISIT(accel_noise_density);
  IMU_POSE_CALIB_VISIT(gyro_bias_walk);
  IMU_POSE_CALIB_VISIT(accel_bias_walk);
  IMU_POSE_CALIB_VISIT(bias_knot_interval_s);
  IMU_POSE_CALIB_VISIT(position_lengthscale_s);
  IMU_POSE_CALIB_VISIT(position_signal_std);
  IMU_POSE_CALIB_VISIT(position_noise_std);
  IMU_POSE_CALIB_VISIT(rotation_lengthscale_s);
  IMU_POSE_CALIB_VISIT(rotation_signal_std);
  IMU_POSE_CALIB_VISIT(rotation_noise_std);
  IMU_POSE_CALIB_VISIT(outlier_threshold);
  IMU_POSE_CALIB_VISIT(initial_time_shift);
  IMU_POSE_CALIB_VISIT(initial_rotation);
  IMU_POSE_CALIB_VISIT(initial_translation);
  IMU_POSE_CALIB_VISIT(initial_gravity);
  IMU_POSE_CALIB_VISIT(estimate_time_shift);
  IMU_POSE_CALIB_VISIT(estimate_rotation);
  IMU_POSE_CALIB_VISIT(estimate_translation);
  IMU_POSE_CALIB_VISIT(estimate_gravity);
  IMU_POSE_CALIB_VISIT(estimate_accel_delay);
  IMU_POSE_CALIB_VISIT(accel_delay);
  IMU_POSE_CALIB_VISIT(estimate_pose_smoothing);
  IMU_POSE_CALIB_VISIT(estimate_pose_scale);
  IMU_POSE_CALIB_VISIT(estimate_accel_smoothing);
  IMU_POSE_CALIB_VISIT(estimate_clock_drift);
  IMU_POSE_CALIB_VISIT(estimate_clock_walk);
  IMU_POSE_CALIB_VISIT(imu_model);
  IMU_POSE_CALIB_VISIT(estimate_size_effect);
  IMU_POSE_CALIB_VISIT(gravity_magnitude);
  IMU_POSE_CALIB_VISIT(gravity_magnitude_std);
  IMU_POSE_CALIB_VISIT(latitude);
  IMU_POSE_CALIB_VISIT(knot_spacing_s);
  IMU_POSE_CALIB_VISIT(robust_loss_scale);
  IMU_POSE_CALIB_VISIT(max_iterations);
  IMU_POSE_CALIB_VISIT(num_threads);
  IMU_POSE_CALIB_VISIT(max_factor_mb);
  IMU_POSE_CALIB_VISIT(covariance_block_s);
  IMU_POSE_CALIB_VISIT(weak_rotation_std);
  IMU_POSE_CALIB_VISIT(weak_translation_std);
  IMU_POSE_CALIB_VISIT(weak_time_shift_std);
#undef IMU_POSE_CALIB_VISIT
}

/// Method or solver of that name; InputError listing the names when there is none.
Method ParseMethod(const std::string& name);
SolverKind ParseSolver(const std::string& name);

/// Options of a YAML text: a map whose keys are field names of CalibrationOptions. Fields without a
/// key keep their default; `~` means "not given" for the optional ones. Rotations are [x, y, z, w],
/// translations [x, y, z].
/// Throws InputError naming the key for a key that does not exist (with the nearest one that does),
/// a value of the wrong type, or a value out of range.
CalibrationOptions ParseOptions(const std::string& yaml);

/// The same of a file, which the error names too.
CalibrationOptions LoadOptions(const std::string& yaml_path);

/// The same map for every field, one `key: value` a line; ParseOptions() reads it back exactly.
std::string ToYaml(const CalibrationOptions& options);

/// IMU noise as Kalibr's imu.yaml states it. The units are those of CalibrationOptions.
struct ImuYaml {
  double gyroscope_noise_density = 0.0;      ///< [rad/s/sqrt(Hz)]
  double gyroscope_random_walk = 0.0;        ///< [rad/s^2/sqrt(Hz)]
  double accelerometer_noise_density = 0.0;  ///< [m/s^2/sqrt(Hz)]
  double accelerometer_random_walk = 0.0;    ///< [m/s^3/sqrt(Hz)]
  double update_rate = 0.0;                  ///< [Hz] 0: not given
  std::string rostopic;                      ///< empty: not given

  void CopyNoise(CalibrationOptions* options) const;
};

/// Reads the text of an imu.yaml, with its keys at the top or, as in Kalibr's results, below
/// `imu0`, or of a sensor.yaml of EuRoC. The noise keys are required. Keys of these files that say
/// nothing about noise are passed over.
///
/// Throws InputError naming key and bound for a key that is missing, unknown, of the wrong type or
/// out of range.
ImuYaml ParseImuYaml(const std::string& yaml);

/// The same of a file, which the error names too.
ImuYaml LoadImuYaml(const std::string& path);

}  // namespace imu_pose_calib
