#pragma once

#include <memory>
#include <optional>
#include <vector>

#include "imu_pose_calib/core/ground_truth/trajectory.h"

namespace imu_pose_calib {

/// State of an IMU, or of a pose sensor, at one instant: ground truth.
struct ImuState : BodyState {
  double t = 0.0;  ///< [s] pose clock
  ImuBiases biases;
  bool is_carried = false;  ///< by the IMU alone, across a gap of the poses; alpha_B is not known
  /// Of the rotation [rad, about the axes of B: R_WB Exp(dtheta)], p_WB, omega_B and v_W.
  Eigen::Matrix<double, 12, 12> covariance = Eigen::Matrix<double, 12, 12>::Zero();
  Matrix6d bias_covariance = Matrix6d::Zero();  ///< gyroscope, accelerometer

  ImuState() = default;
  ImuState(const BodyState& body, double t) : BodyState(body), t(t) {}
};

/// Whose stamps go with the states.
enum class TrackClock { kImu, kPoses };

/// What happens between two runs of poses.
struct TrackGap {
  double begin, end;              ///< [s] pose clock
  std::vector<ImuState> carried;  ///< by the IMU's own samples; empty: left out
};

/// The motion of one IMU in one session, from its first to its last sample. Stamps are of one of
/// the clocks.
class ImuTrack {
 public:
  /// Gaps of the poses of up to `max_gap_s` are carried by the IMU where that is possible, see
  /// doc/trajectory.md; longer ones are left out, and all of them with method `gp`.
  ImuTrack(const std::shared_ptr<const Solution>& solution, size_t session, size_t imu,
           TrackClock clock, double max_gap_s);

  struct Instant {
    int64_t stamp_ns;  ///< on the clock of the track
    double t;          ///< [s] pose clock, after the epoch of the session's poses
  };
  /// Of the samples of the gyroscope or, for a rate > 0 [Hz], evenly from the first of them to the
  /// last one.
  std::vector<Instant> Instants(double rate_hz) const;

  /// Nothing where poses or IMU have a gap that is left out. Covariances are 0 with method `gp`,
  /// and hold the error of the IMU's clock when that is the clock of the track.
  std::optional<ImuState> At(double t) const;
  bool has_covariance() const { return !solution_->splines.empty(); }

  const std::vector<TrackGap>& gaps() const { return gaps_; }

  /// A recorded sample of both sensors for the same instant, in I.
  struct Sample {
    int64_t stamp_ns;
    Eigen::Vector3d gyro;   ///< [rad/s]
    Eigen::Vector3d accel;  ///< [m/s^2]
  };
  /// At the stamps of the gyroscope; the accelerometer less its delay, linear between its samples.
  std::vector<Sample> Samples() const;

 private:
  const ConditionedImu& Recorded() const { return solution_->imus[session_][imu_]; }
  const ImuSessionEstimate& Clock() const {
    return solution_->estimate.sessions[session_].imus[imu_];
  }
  int64_t Stamp(double t_imu) const;

  std::shared_ptr<const Solution> solution_;
  size_t session_, imu_;
  TrackClock clock_;
  SessionTrajectory trajectory_;
  double gyro_noise_ = 0.0;  ///< [rad/s]
  std::vector<TrackGap> gaps_;
};

/// `recorded`, or evenly from the first of them until the last one for a rate > 0 [Hz]: their clock
/// is linear between them.
std::vector<ImuTrack::Instant> EvenInstants(const std::vector<ImuTrack::Instant>& recorded,
                                            double rate_hz);

}  // namespace imu_pose_calib
