#pragma once

#include "imu_pose_calib/core/calibration_problem.h"

namespace imu_pose_calib {

/// Stage S3: the calibration against the fixed trajectory of S1, doc/math.md. Gyroscope alone first
/// (rotation, gyro bias, time shift), then both sensors.
class GpProblem : public CalibrationProblem {
 public:
  enum class Sensors { kGyro, kGyroAndAccel };

  GpProblem(const CalibrationOptions& options,
            const PoseTrajectory& trajectory,
            const ConditionedData& data,
            Sensors sensors,
            const NoiseStd& noise,
            Estimate* estimate);

 private:
  double FeignedLeverArmInformation() const override { return feigned_information_; }
  void AddGyro();
  void AddAccel();
  /// Number of consecutive samples that share one error of the trajectory: together they tell no
  /// more about it than one, so its variance counts that many times in each sample's weight.
  double SharedSamples(double rate_hz) const;

  double feigned_information_ = 0.0;
};

/// Stage S3 as a whole: rotation, gyro bias and time shift on the gyroscope; then everything on
/// both sensors, twice: each time with the noise that the residuals before show. Moves `estimate`.
Solution SolveAgainstTrajectory(const CalibrationOptions& options,
                                const PoseTrajectory& trajectory,
                                const ConditionedData& data,
                                Estimate* estimate);

}  // namespace imu_pose_calib
