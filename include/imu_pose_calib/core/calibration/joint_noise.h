#pragma once

#include <vector>

#include "imu_pose_calib/core/calibration/correction_splines.h"
#include "imu_pose_calib/core/calibration/least_squares.h"

namespace imu_pose_calib {

/// The way of one noise, in the logarithm, from pass to pass to what is found, doc/math.md, S4,
/// "Passes".
class NoiseMove {
 public:
  /// What to move by in this pass, of what is wanted: as the secant through the last two passes
  /// says. What would go to and fro comes to rest.
  double Next(double wanted);

 private:
  double wanted_ = 0.0, moved_ = 0.0;  ///< in the last pass
};

/// Sets the share of each sensor's degrees of freedom that a session's splines use up, and how its
/// noise within the band is seen, doc/math.md, S4, "Degrees of freedom" and "Noise".
void ShareFreedom(const CorrectionSplines& splines, size_t session, LeastSquares* joint);

/// Moves the robust weights of the samples half of the way, in the logarithm, to those of the last
/// residuals and the spread of `models`, doc/math.md, S4, "Noise".
void UpdateWeights(const LeastSquares& joint, const std::vector<CorrectionSplines>& splines,
                   std::vector<SensorModel>* models);

/// Sets the noise of the sensors and the sigmas of the slow errors to what the spectra of the
/// residuals show, doc/math.md, S4, "Noise" and "Slow errors".
void FitNoise(const LeastSquares& joint, std::vector<SensorStatistics>* statistics);

}  // namespace imu_pose_calib
