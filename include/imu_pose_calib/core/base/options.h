#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <array>
#include <limits>
#include <optional>

namespace imu_pose_calib {

/// How the calibration is solved.
enum class Method {
  kJoint,  ///< trajectory and calibration estimated together (doc/math.md, S4)
  kGp,     ///< Gaussian-process trajectory held fixed, calibration fitted to it (doc/math.md, S3)
};
inline const char* ToString(Method method) { return method == Method::kJoint ? "joint" : "gp"; }

/// What takes the steps of the joint solve.
enum class SolverKind {
  kWindows,  ///< the own one, window by window of time (core/solver)
  kCeres,    ///< ceres::Solve on the same residuals, each pass to its minimum: slower
};
inline const char* ToString(SolverKind solver) {
  return solver == SolverKind::kWindows ? "windows" : "ceres";
}

/// What is estimated of the IMU beside its biases.
enum class ImuModel {
  kCalibrated,         ///< nothing: measured = true + bias + noise
  kScaleMisalignment,  ///< measured = M true + bias + noise, one matrix M per sensor
};
inline const char* ToString(ImuModel model) {
  return model == ImuModel::kCalibrated ? "calibrated" : "scale_misalignment";
}

/// Where stamps are replaced by those of the source's own clock (doc/math.md, S0).
enum class StampRecovery {
  kAuto,    ///< where that explains the samples better
  kAlways,  ///< where such a clock is found
  kNever,
};
inline const char* ToString(StampRecovery mode) {
  return std::array{"auto", "always", "never"}[static_cast<size_t>(mode)];
}

/// What is known beforehand of the growth of a time shift: its sigma [s/s].
constexpr double kDriftPrior = 1e-4;

/// Everything that can be set. The defaults work on a normal recording; the same names, with the
/// same defaults, are the keys of config/default.yaml.
struct CalibrationOptions {
  Method method = Method::kJoint;
  /// Of the joint solve; method gp is solved by Ceres.
  SolverKind solver = SolverKind::kWindows;

  // --- Data (S0) ---

  /// Unit of the recorded positions [m]: 1e-3 for millimetres.
  double position_unit = 1.0;
  /// Unit of the recorded gyroscope [rad/s]: 0.0174532925 for deg/s.
  double gyro_unit = 1.0;
  /// Unit of the recorded accelerometer [m/s^2]: 9.80665 for g.
  double accel_unit = 1.0;
  /// The recorded poses are T_MW (world seen from the marker) and have to be inverted.
  bool invert_poses = false;
  /// Estimate the even clock of a source whose stamps are not (time of arrival, cut), and use it.
  StampRecovery recover_stamps = StampRecovery::kAuto;
  /// Poses further apart than this are not interpolated between [s]. 0: five pose periods, at least
  /// 0.1 s.
  double max_gap_s = 0.0;
  /// Shortest run of poses without a gap that is used [s].
  double min_segment_s = 0.5;
  /// Shortest time that both clocks must have in common [s].
  double min_overlap_s = 5.0;
  /// Largest share of samples that may be unusable (not finite, stamped backwards,
  /// saturated) [0..1].
  double max_bad_fraction = 0.1;

  // --- IMU noise: starting values; the solve re-estimates both white noises from the residuals ---

  /// Gyroscope white noise [rad/s/sqrt(Hz)].
  double gyro_noise_density = 3e-4;
  /// Accelerometer white noise [m/s^2/sqrt(Hz)].
  double accel_noise_density = 2e-3;
  /// Gyroscope bias random walk [rad/s^2/sqrt(Hz)].
  double gyro_bias_walk = 2e-5;
  /// Accelerometer bias random walk [m/s^3/sqrt(Hz)].
  double accel_bias_walk = 2e-4;
  /// Time between the knots of the piecewise linear biases [s]. 0: a knot at every sample.
  double bias_knot_interval_s = 5.0;

  // --- Gaussian-process trajectory (S1); 0: from the marginal likelihood. A noise without a length
  // scale is the least ---

  double position_lengthscale_s = 0.0;  ///< [s]
  double position_signal_std = 0.0;     ///< [m]
  double position_noise_std = 0.0;      ///< [m] per pose and axis
  double rotation_lengthscale_s = 0.0;  ///< [s]
  double rotation_signal_std = 0.0;     ///< [rad]
  double rotation_noise_std = 0.0;      ///< [rad] per pose and axis
  /// A pose is an outlier when its leave-one-out residual exceeds this many sigma.
  double outlier_threshold = 6.0;

  // --- Start (S2): not needed; used when given, and kept when it is not to be estimated ---

  /// Guess of t_pose - t_imu [s]; the search is then limited to 1 s around it.
  std::optional<double> initial_time_shift;
  /// Guess of the rotation q_MI.
  std::optional<Eigen::Quaterniond> initial_rotation;
  /// Guess of the translation p_MI [m].
  std::optional<Eigen::Vector3d> initial_translation;
  /// Guess of gravity in W [m/s^2].
  std::optional<Eigen::Vector3d> initial_gravity;

  // --- What is estimated; false keeps the initial value, which must then be given ---

  bool estimate_time_shift = true;
  bool estimate_rotation = true;
  bool estimate_translation = true;
  bool estimate_gravity = true;
  /// How much later than the gyroscope's the accelerometer's data are delivered.
  bool estimate_accel_delay = true;
  /// Start or fixed value [s]: t_pose = t_accel + time_shift - accel_delay.
  double accel_delay = 0.0;
  /// Over what time the source of the poses averages. Joint solve only.
  bool estimate_pose_smoothing = true;
  /// By how much the source of the poses exaggerates positions, usually within 0.1 %. Joint solve
  /// only.
  bool estimate_pose_scale = true;
  /// Over what time gyroscope and accelerometer average. Joint solve only.
  bool estimate_accel_smoothing = true;
  /// How far specific force moves the IMU on its mount. Joint solve only.
  bool estimate_mount_compliance = true;
  /// Linear growth of the time shift, usually within 100 ppm. Joint solve only.
  bool estimate_clock_drift = true;
  /// What the time shift does beyond that: a walk, where the gyroscope shows one. Joint solve only.
  bool estimate_clock_walk = true;
  /// Scale and misalignment of the sensors, usually within 1 % and 0.5 deg. Joint solve only.
  ImuModel imu_model = ImuModel::kScaleMisalignment;
  /// Places of the accelerometer's axes, usually within 2 mm of each other. Joint solve only.
  bool estimate_size_effect = true;
  /// What is known of the magnitude of gravity [m/s^2], and its sigma. The norm of initial_gravity
  /// and the latitude, where they are given, count instead of the magnitude.
  double gravity_magnitude = 9.80665;
  double gravity_magnitude_std = 0.03;
  /// [deg] Then the sigma is that of unknown heights and anomalies, 0.003, or less if that is set.
  std::optional<double> latitude;

  // --- Further pose sensors on the rig (doc/math.md, "Pose sensors") ---

  /// They give T_SV, the world seen from the sensor, instead of T_VS.
  bool invert_sensor_poses = false;
  /// Their positions have a scale of their own, as those of a single camera.
  bool estimate_sensor_scale = false;

  // --- Solve (S3, S4) ---

  /// Joint solve: time between the knots of the trajectory's correction [s]. 0: refined until the
  /// residuals stop shrinking.
  double knot_spacing_s = 0.0;
  /// Cauchy scale of the robust loss of method gp, in sigma of a 3-vector residual. The joint solve
  /// finds from the data how heavy the tails of the noise are.
  double robust_loss_scale = 5.0;
  /// Steps of each solve.
  int max_iterations = 50;
  /// Threads. 0: one per processor.
  int num_threads = 0;
  /// When the factor of the normal equations would take more [MB], it is found again where it is
  /// needed, and so is the trajectory where the samples are when those take more: memory grows less
  /// with the recording, and the solve takes longer by a half. There is no TrajectoryCovariance
  /// without the factor.
  double max_factor_mb = 128.0;

  // --- Uncertainty and verdict (S5) ---

  /// Length of the time blocks of the cluster-robust covariance [s], at least a thousandth of the
  /// recording. 0: a 24th of it, at least 2 s.
  double covariance_block_s = 0.0;
  /// The verdict is `weak` when the largest sigma exceeds one of these, and `degenerate` beyond ten
  /// times one of these.
  double weak_rotation_std = 0.01;     ///< [rad]
  double weak_translation_std = 0.01;  ///< [m]
  double weak_time_shift_std = 0.002;  ///< [s]

  /// Magnitude of gravity that is expected, and its sigma [m/s^2].
  double GravityMagnitude() const;
  double GravityStd() const;
  /// How many `num_threads` asks for.
  int Threads() const;

  /// Throws InputError naming field, value and bound when a value is out of range.
  void Validate() const;
};

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
  visit(IMU_POSE_CALIB_FIELD(solver), Bound{});
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
  visit(IMU_POSE_CALIB_FIELD(estimate_mount_compliance), Bound{});
  visit(IMU_POSE_CALIB_FIELD(estimate_clock_drift), Bound{});
  visit(IMU_POSE_CALIB_FIELD(estimate_clock_walk), Bound{});
  visit(IMU_POSE_CALIB_FIELD(imu_model), Bound{});
  visit(IMU_POSE_CALIB_FIELD(estimate_size_effect), Bound{});
  visit(IMU_POSE_CALIB_FIELD(gravity_magnitude), Bound{0.1, 100.0});
  visit(IMU_POSE_CALIB_FIELD(gravity_magnitude_std), Bound{1e-9, 10.0});
  visit(IMU_POSE_CALIB_FIELD(latitude), Bound{-90.0, 90.0});
  visit(IMU_POSE_CALIB_FIELD(invert_sensor_poses), Bound{});
  visit(IMU_POSE_CALIB_FIELD(estimate_sensor_scale), Bound{});
  visit(IMU_POSE_CALIB_FIELD(knot_spacing_s), Bound{1e-3, 10.0, true});
  visit(IMU_POSE_CALIB_FIELD(robust_loss_scale), Bound{1.0, 1e6});
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
