#pragma once

#include <functional>
#include <optional>
#include <vector>

#include "imu_pose_calib/core/trajectory/pose_trajectory.h"

namespace imu_pose_calib {

constexpr double kRateBin = 0.01;      ///< [s] of the rates that are correlated
constexpr int kCandidates = 6;         ///< time shifts that are tried on all three axes
constexpr double kMinExplained = 0.5;  ///< least share of the variance of rates that match
/// Unexplained share of the motion of a flipped segment; of another reading over the one as given.
constexpr double kFlipped = 0.25;

/// Time shifts at which |omega_M| and |gyro| correlate best, the best first, at most `count`.
/// Every overlap of at least `min_overlap_s` is searched, or those within 1 s of `guess`.
std::vector<double> FindTimeShifts(const PoseTrajectory& trajectory,
                                   const std::vector<TimedSample>& gyro, double min_overlap_s,
                                   const std::optional<double>& guess, int count, int threads = 1);

/// Every so many of `size` samples are enough for a closed-form fit.
size_t Stride(size_t size);

/// A sample of the gyroscope and how the marker turns then.
struct RatePair {
  const TimedSample* gyro;
  double t;  ///< [s] pose clock
  MarkerRotation<double> marker;
};

/// Of every `stride`-th gyro sample, those that the clock pose_time(t) puts on the trajectory.
std::vector<RatePair> PairRates(const PoseTrajectory& trajectory,
                                const std::vector<TimedSample>& gyro, size_t stride,
                                const std::function<double(double t)>& pose_time);

/// Rotation, gyro bias and fit of the rates at a given time shift.
struct RateAlignment {
  Eigen::Quaterniond q_MI = Eigen::Quaterniond::Identity();
  Eigen::Vector3d gyro_bias = Eigen::Vector3d::Zero();  ///< [rad/s] in I
  double scale = 0.0;       ///< rms of the gyro's rates over the marker's: 1 when both are rad/s
  double explained = 0.0;   ///< share of the gyro's variance that the marker's rates explain
  size_t count = 0;         ///< gyro samples that fall on the trajectory
  double time_shift = 0.0;  ///< [s] where it is chosen among several

  /// Of the gyroscope [rad/s].
  Eigen::Vector3d Residual(const Eigen::Vector3d& gyro_I, const Eigen::Vector3d& omega_M) const {
    return gyro_I - gyro_bias - q_MI.conjugate() * omega_M;
  }
};

/// Least squares for rotation and bias, omega_M = R_MI (gyro - bias): Wahba's problem.
RateAlignment AlignRates(const std::vector<RatePair>& pairs);
/// That with the most evidence at one of the time shifts: many samples, well explained. `inverted`:
/// to the rates of the world seen from the marker. Nothing is explained when there is no time
/// shift.
RateAlignment AlignRates(const PoseTrajectory& trajectory, const std::vector<TimedSample>& gyro,
                         const std::vector<double>& time_shifts, bool inverted, int threads);

/// What messages call the rates that are aligned.
struct RatesInWords {
  const char* both;    ///< "poses and gyroscope"
  const char* whose;   ///< "the gyroscope's"
  const char* invert;  ///< option that says which way the poses are recorded
  bool is_inverted;    ///< as it is set
};

/// AlignRates() of rates that match. Throws OptionNeeded when inverted poses explain the gyroscope
/// far better, and DataError when nothing does.
RateAlignment MatchRates(const PoseTrajectory& trajectory, const std::vector<TimedSample>& gyro,
                         const std::vector<double>& time_shifts, const RatesInWords& words,
                         int threads);

}  // namespace imu_pose_calib
