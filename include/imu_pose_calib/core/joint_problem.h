#pragma once

#include <optional>
#include <vector>

#include "imu_pose_calib/core/calibration_problem.h"
#include "imu_pose_calib/core/joint_residuals.h"
#include "imu_pose_calib/core/spline.h"

namespace imu_pose_calib {

/// Corrections of the trajectory of S1 by uniform cubic B-splines over the accelerometer's clock
/// tau [s], one per run without a gap:
///   R_WM(tau) = R_gp(tau) Exp(phi(tau)),   p_WM(tau) = p_gp(tau) + d(tau).
class CorrectionSplines {
 public:
  /// Zero corrections with knots about `spacing_s` apart on the parts of the trajectory that the
  /// IMU samples cover where the clocks of `estimate` stand.
  CorrectionSplines(const ConditionedData& data, const Estimate& estimate, double spacing_s);

  /// Place of tau; nothing when no spline covers it.
  std::optional<SplinePlace> Locate(double tau) const;

  /// About the time between knots [s].
  double spacing() const { return spacing_; }

  std::vector<Eigen::Vector3d> d;    ///< control points [m] in W
  std::vector<Eigen::Vector3d> phi;  ///< control points [rad] in M

 private:
  struct Range {
    double begin, end;  ///< tau [s]
    double spacing;     ///< [s]
    size_t first;       ///< control point
    size_t spans;
  };
  const Range* Find(double tau) const;
  double spacing_;
  std::vector<Range> ranges_;
};

/// Robust weights (0..1] of the samples of each sensor, as many as ConditionedData holds.
struct SampleWeights {
  std::vector<double> position, rotation, gyro, accel;

  explicit SampleWeights(const ConditionedData& data)
      : position(data.poses.size(), 1.0),
        rotation(data.poses.size(), 1.0),
        gyro(data.gyro.size(), 1.0),
        accel(data.accel.size(), 1.0) {}
};

/// Stage S4: trajectory and calibration together, doc/math.md. Every pose and every IMU sample is a
/// residual weighted by its own noise only.
class JointProblem : public CalibrationProblem {
 public:
  JointProblem(const CalibrationOptions& options,
               const PoseTrajectory& trajectory,
               const ConditionedData& data,
               const NoiseStd& noise,
               const SampleWeights& weights,
               Estimate* estimate,
               CorrectionSplines* splines);

  /// Keeps the calibration where it is; trajectory, biases and gravity are estimated.
  void HoldCalibration();

  /// Robust weights by the residuals of the last Statistics() in units of `noise`, doc/math.md, S4,
  /// "Passes".
  void UpdateWeights(const NoiseStd& noise, SampleWeights* weights) const;

  /// Noise of each sensor at the frequencies where poses and IMU meet over its `spread` per sample,
  /// at least 1: 1 when it is white. From the last Statistics(); doc/math.md, S4, "Colour".
  NoiseStd NoiseColor(const NoiseStd& spread) const;

 private:
  void AddPoses(const SampleWeights& weights);
  void AddGyro(const SampleWeights& weights);
  void AddAccel(const SampleWeights& weights);
  /// IMU samples of stamp t at tau = t + lead: consecutive ones that share a span and a pair of
  /// bias knots are handed to `create(batch, control points' index, knot)`, which returns their
  /// block.
  template <typename Create>
  void AddImu(const std::vector<TimedSample>& samples,
              const std::vector<double>& weights,
              double lead,
              double noise,
              const BiasKnots& knots,
              const Create& create,
              Sensor* sensor);
  /// The trajectory at an instant given on both clocks [s]; nothing when it is not on a spline.
  std::optional<TrajectoryPoint> PointAt(double tau, double t_M) const;
  /// Two-sided power spectral densities of the white noises [unit^2/Hz].
  NoiseStd Densities() const;
  /// [Hz] above which an IMU sensor says more of the trajectory than the poses do:
  /// S_a = w^4 S_p and S_g = w^2 S_r.
  struct Crossover {
    double accel, gyro;
  };
  Crossover FindCrossover() const;
  NoiseStd FittedShare() const override;
  double FeignedLeverArmInformation() const override;
  /// Control points that act on the span.
  std::vector<double*> ControlPoints(std::vector<Eigen::Vector3d>* spline, size_t first) const;

  CorrectionSplines* const splines_;
};

}  // namespace imu_pose_calib
