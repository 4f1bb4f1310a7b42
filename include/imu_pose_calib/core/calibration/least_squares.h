#pragma once

#include <optional>
#include <vector>

#include "imu_pose_calib/core/base/options.h"
#include "imu_pose_calib/core/base/student_t.h"
#include "imu_pose_calib/core/calibration/estimate.h"
#include "imu_pose_calib/core/solver/normal_equations.h"

namespace imu_pose_calib {

enum class Quantity { kPosition, kRotation, kGyro, kAccel };

inline bool IsOfPoses(Quantity quantity) {
  return quantity == Quantity::kPosition || quantity == Quantity::kRotation;
}

/// What a solve assumes of one sensor in one session.
struct SensorModel {
  Quantity quantity;
  size_t session, imu;          ///< imu: of gyroscope and accelerometer
  double rate_hz;               ///< of its samples
  double noise;                 ///< sigma per sample and axis [m, rad, rad/s, m/s^2], in the band
  StudentT spread;              ///< of samples, in the same unit: what outliers are measured by
  std::vector<double> weights;  ///< robust (0..1], of each sample of the data

  /// Two-sided power spectral density of the noise [unit^2/Hz].
  double Density() const { return noise * noise / rate_hz; }
};

/// The sensors of all sessions, with the noise to start from and all weights 1: position and
/// rotation of a session, then gyroscope and accelerometer of each of its IMUs. Noise of poses as
/// the GP's likelihood says, of IMUs by the options' densities, sigma = density sqrt(rate).
std::vector<SensorModel> InitialModels(const CalibrationOptions& options,
                                       const std::vector<PreparedSession>& sessions);

/// Power spectral density of residuals [unit^2/Hz, two-sided], the mean of axes and of spans of
/// kSpan, at multiples of 1 / kSpan from kFirst on.
struct NoiseSpectrum {
  static constexpr double kSpan = 4.0;  ///< [s]
  static constexpr int kFirst = 2;      ///< what is slower is the bias

  std::vector<double> density;  ///< empty: not known
  double count = 0.0;           ///< of periodograms that each is the mean of

  static double Frequency(size_t k) { return (static_cast<double>(k) + kFirst) / kSpan; }
};

/// What the residuals of a sensor say after a solve.
struct SensorStatistics {
  double noise;            ///< per axis, less what the trajectory's own variance explains
  double rms;              ///< per axis, of all samples used
  StudentT spread;         ///< of the samples
  NoiseSpectrum spectrum;  ///< of residuals without their rest, of poses with their slow errors
  double slow_std = 0.0;   ///< of poses: sigma of slow errors
};

/// A sample in a problem.
struct ProblemSample {
  double t;                         ///< [s] pose clock
  uint32_t index;                   ///< in the data
  float sigma;                      ///< residual * sigma has the sensor's unit
  float trajectory_variance = 0.0;  ///< share of sigma^2
};

/// What is known of a sample of the data.
struct RecordedSample {
  double t;                     ///< [s] of its own clock
  double scale;                 ///< noise relative to the usual one of its sensor
  int count;                    ///< samples that it stands for
  const Eigen::Vector3d& rest;  ///< recorded less what the residual compares, in the sensor's unit
};

/// The samples of a sensor in a problem, whose residual blocks follow each other: three rows in
/// sigma for each sample.
struct SensorBlocks {
  const SensorModel* model;
  size_t first_row = 0;  ///< of the problem's
  std::vector<ProblemSample> samples;
  double count = 0.0;  ///< of recorded samples, for which they stand
  /// Share of the samples' degrees of freedom that the trajectory uses up by following them [0..1].
  double fitted = 0.0;
  double band = 0.0;  ///< [Hz] up to which residuals have a spectrum
  /// Of each sample, in the sensor's unit and over its scale, as of the last FindStatistics().
  std::vector<Eigen::Vector3d> residuals;
};

/// Residuals of the samples of a sensor, measured less model, with the noise that weighs them.
struct SensorResiduals {
  Quantity quantity;
  size_t session, imu;
  double noise;                           ///< sigma of a sample of weight 1 [m, rad, rad/s, m/s^2]
  std::vector<double> t;                  ///< [s] pose clock after the epoch of the session's poses
  std::vector<Eigen::Vector3d> residual;  ///< unit of `noise`; position in W, others in M or I
  std::vector<double> weight;             ///< robust (0..1]
};

struct GaussNewtonStep {
  Eigen::VectorXd x;           ///< of all columns
  double decrease;             ///< of the cost, if residuals were linear; NaN when there is no step
  Eigen::MatrixXd covariance;  ///< of the border
};

struct StepSummary {
  bool is_whole = false;  ///< not damped
  int iterations = 0;     ///< steps that were tried
  /// Largest move of T_MI, a time shift or an accel delay, in its sigma; by Ceres, that of the
  /// Gauss-Newton step where it begins. Infinity when all steps were refused.
  double moved = 0.0;
};

/// Time blocks of the sessions, one after the other: what acts in one of them only is eliminated
/// there, and scores are summed up in each.
class Windows {
 public:
  Windows(const CalibrationOptions& options, const std::vector<PreparedSession>& sessions,
          const Estimate& estimate);

  int count() const { return static_cast<int>(sessions_.size()); }
  /// Window of an instant t [s, pose clock].
  int Of(size_t session, double t) const;
  size_t SessionOf(int window) const { return sessions_[static_cast<size_t>(window)]; }
  int Count(size_t session) const { return spans_[session].count; }

 private:
  struct Span {
    double begin = 0.0, end = 0.0;
    int first = 0, count = 0;
  };
  std::vector<Span> spans_;
  std::vector<size_t> sessions_;  ///< of each window
  double length_s_;
};

/// Parameters of a solve in the order of H, and the first column of each kind.
struct Ordering {
  std::vector<int> border, inner;  ///< blocks
  int columns = 0;
  std::vector<Parameter> calibrated;  ///< from column 0 on
  int gravity = 0, biases = 0;        ///< of each session; biases: no longer border
  std::vector<size_t> means;          ///< knots of each bias, one after the other
  int walks = 0;                      ///< of clocks, and slow errors
  int trajectory = 0;
};

/// Normal equations of a least squares problem, reduced to what acts everywhere. Right-hand sides:
/// scores of the windows, then functionals, which are the columns of the border and the mean of
/// each bias.
struct Linearisation {
  Ordering order;
  NormalEquations equations;
  std::optional<EliminatedWindows> windows;
  Reduced reduced;
  double cost;

  /// The diagonal of H being larger by this share.
  void Eliminate(const CalibrationOptions& options, double damping);
  /// Of the border, which SubstituteBack() completes.
  GaussNewtonStep FindStep() const;
  void SubstituteBack(double damping, Eigen::VectorXd* x) const;

 private:
  Panels Assemble(size_t window, double damping, double* cost) const;
  /// The means of bias knots that are in one window, or are shared.
  void AddMeans(int window, Panels* panels) const;
};

/// A least squares problem over all sessions: what the two solves, against fixed trajectories and
/// jointly with them, have in common. Refers to everything it is given; Solve() moves `estimate`.
struct LeastSquares {
  const CalibrationOptions& options;
  const std::vector<PreparedSession>& sessions;
  const std::vector<SensorModel>& models;
  Estimate* const estimate;

  const Windows windows;
  Problem problem;
  std::vector<Equation> equations;     ///< all residual blocks
  std::vector<SensorBlocks> sensors;   ///< in the order of the models
  std::vector<int> trajectory_blocks;  ///< parameters of the trajectories, when estimated

  LeastSquares(const CalibrationOptions& options, const std::vector<PreparedSession>& sessions,
               const std::vector<SensorModel>& models, Estimate* estimate);

  SensorBlocks* Find(Quantity quantity, size_t session, size_t imu = 0);
  /// A residual block at t [s, pose clock].
  void Add(int block, size_t session, double t);
  /// What is calibrated, as far as a fixed trajectory tells of it or all, and gravity: held where
  /// the options fix it, else with what is known of it beforehand.
  void AddCalibration(bool is_joint);
  void AddBiasWalk(double walk, size_t session, size_t imu, BiasKnots* knots);
  void AddClockWalk(size_t session, size_t imu);
  void AddSlowErrors(size_t session, SlowErrors* errors);

  Ordering Order() const;

  /// A Gauss-Newton step, damped until the cost does not rise; or Ceres, by the options. One that
  /// would move by less than `least` is not taken. After max_iterations refused ones the estimate
  /// is where it was.
  StepSummary Step(double least = 0.0);
  /// The normal equations where the estimate stands.
  Linearisation Linearise();
  std::optional<int> SolveWithCeres(double function_tolerance);
  /// Of each sensor.
  std::vector<SensorStatistics> FindStatistics();
  /// Residuals of all samples of each sensor as of the last FindStatistics(), of those for which
  /// others stand linear in between. `recorded`: the sessions as they were before Thinned().
  std::vector<SensorResiduals> FindResiduals(const std::vector<PreparedSession>& recorded) const;
  /// Residual of sample `i` that its weight is found from: of a pose as it would be if that were 1.
  Eigen::Vector3d AtUsualWeight(const SensorBlocks& sensor, size_t i) const;
  /// Sample `index` of the sensor's data.
  RecordedSample At(const SensorModel& model, size_t index) const;

 private:
  /// What is known beforehand of a block of parameters that is there, in the middle of a session.
  void AddPrior(std::unique_ptr<const ceres::CostFunction> prior, const std::vector<double*>& data,
                size_t session);
  /// Of residuals that start at `rows`; of poses with the slow errors that they are less, of IMUs
  /// weighed by the spread of their samples.
  NoiseSpectrum FindSpectrum(const SensorBlocks& sensor, const float* rows,
                             const StudentT& spread) const;

  // Where the estimate stands; empty: not known.
  std::vector<float> rows_;  ///< residuals
  std::optional<Linearisation> linearisation_;
};

/// The DataError of a solve that did not converge.
[[noreturn]] void ThrowNotConverged(const CalibrationOptions& options);

/// Windows of all sessions by default, and their least length [s].
constexpr int kWindows = 24;
constexpr double kShortestWindow = 2.0;

/// Samples closer than this to the end of a segment are left out: the time shift can move, and
/// differences can be taken.
constexpr double kSegmentEdge = 0.02;  // [s]
/// The sample can be compared: t_M [s, pose clock] is inside of a segment and not at its very end.
bool IsOnTrajectory(const PoseTrajectory& trajectory, double t_M);

}  // namespace imu_pose_calib
