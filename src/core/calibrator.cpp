#include "imu_pose_calib/core/calibrator.h"

#include <cmath>

#include "imu_pose_calib/core/conditioning.h"
#include "imu_pose_calib/core/data_check.h"
#include "imu_pose_calib/core/gp_problem.h"
#include "imu_pose_calib/core/initializer.h"
#include "imu_pose_calib/core/intrinsics.h"
#include "imu_pose_calib/core/joint_solver.h"
#include "imu_pose_calib/core/observability.h"
#include "imu_pose_calib/core/pose_trajectory.h"
#include "imu_pose_calib/core/so3.h"

namespace imu_pose_calib {
namespace {

void ReportData(const ConditionedData& data, Calibration* result) {
  result->poses = data.pose_report;
  result->gyro = data.gyro_report;
  result->accel = data.accel_report;
  result->segments = data.segments.size();
  result->gaps = data.gaps;
  result->jumps = data.jumps;
}

/// Residuals of the poses when the trajectory is not estimated.
void ReportPoseResiduals(const PoseTrajectory& trajectory,
                         const ConditionedData& data,
                         Calibration* result) {
  double position2 = 0.0, rotation2 = 0.0, count = 0.0;
  for (const TimedPose& pose : data.poses) {
    if (!trajectory.Contains(pose.t)) continue;
    const PoseTrajectory::Pose smooth = trajectory.PoseAt(pose.t);
    position2 += (pose.p_WM - smooth.p_WM).squaredNorm();
    rotation2 += Log(Eigen::Quaterniond(smooth.q_WM.conjugate() * pose.q_WM)).squaredNorm();
    count += 3.0;
  }
  result->rms.position = std::sqrt(position2 / count);
  result->rms.rotation = std::sqrt(rotation2 / count);
}

void ReportEstimate(const Estimate& estimate,
                    const ResidualStatistics& statistics,
                    const ConditionedData& data,
                    Calibration* result) {
  result->T_MI = {estimate.q_MI.normalized(), estimate.p_MI};
  if (result->T_MI.q.w() < 0.0) result->T_MI.q.coeffs() *= -1.0;
  result->time_shift =
      1e-9 * static_cast<double>(data.pose_epoch_ns - data.imu_epoch_ns) + estimate.time_shift;
  result->accel_delay = estimate.accel_delay;
  result->clock_drift = estimate.clock_drift;
  result->pose_smoothing = estimate.pose_smoothing;
  result->clock_reference =
      1e-9 * static_cast<double>(data.imu_epoch_ns) + estimate.clock_reference;
  result->gyro_matrix = GyroMatrix(estimate.gyro_intrinsics);
  result->accel_matrix = AccelMatrix(estimate.accel_intrinsics);
  result->g_W = estimate.g_W;
  result->gyro_bias = estimate.gyro_bias.Mean();
  result->accel_bias = estimate.accel_bias.Mean();
  result->noise = statistics.noise;
  result->rms = statistics.rms;
}

}  // namespace

Calibration Calibrate(const CalibrationOptions& options, const CalibrationData& data) {
  options.Validate();
  Calibration result;
  result.method = options.method;
  result.imu_model = options.imu_model;

  DataCheck check = CheckStreams(data);
  ConditionedData conditioned = Condition(options, data);
  PoseTrajectory trajectory = FitTrajectory(options, &conditioned);
  RemoveFlippedSegments(options, &trajectory, &conditioned);
  ReportData(conditioned, &result);
  result.position_lengthscale_s = trajectory.position_hyperparameters().lengthscale_s;
  result.rotation_lengthscale_s = trajectory.rotation_hyperparameters().lengthscale_s;
  CheckMotion(options, conditioned, trajectory, &check);
  result.warnings = check.warnings;
  // With a known lever arm or rotation a turn about one axis may do: the covariance will tell.
  const bool needs_turns = options.estimate_translation && options.estimate_rotation;
  if (needs_turns && IsMotionDegenerate(MeasureTurns(trajectory, conditioned), &result))
    return result;

  const Start start = Initialise(options, trajectory, conditioned);
  CheckMatch(conditioned, trajectory, start, &check);
  result.warnings = check.warnings;
  Estimate estimate(start, conditioned, options.bias_knot_interval_s);

  Solution solution;
  if (options.method == Method::kJoint) {
    const JointStart joint = ChooseKnotSpacing(options, trajectory, conditioned, &estimate);
    result.knot_spacing_s = joint.knot_spacing_s;
    solution = SolveJointly(options, trajectory, conditioned, joint, &estimate);
  } else {
    solution = SolveAgainstTrajectory(options, trajectory, conditioned, &estimate);
  }
  ReportEstimate(estimate, solution.statistics, conditioned, &result);
  GradeResult(options, solution.covariance, &result);
  if (options.method == Method::kGp) ReportPoseResiduals(trajectory, conditioned, &result);
  WarnOfMisfit(solution.covariance, &result);
  return result;
}

const char* ToString(Status status) {
  switch (status) {
    case Status::kOk:
      return "ok";
    case Status::kWeak:
      return "weak";
    case Status::kDegenerate:
      return "degenerate";
    case Status::kNotRun:
      break;
  }
  return "not run";
}

const char* ToString(Method method) {
  switch (method) {
    case Method::kJoint:
      return "joint";
    case Method::kGp:
      break;
  }
  return "gp";
}

const char* ToString(ImuModel model) {
  switch (model) {
    case ImuModel::kScaleMisalignment:
      return "scale_misalignment";
    case ImuModel::kCalibrated:
      break;
  }
  return "calibrated";
}

}  // namespace imu_pose_calib
