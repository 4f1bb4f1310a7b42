#include "imu_pose_calib/core/imu_track.h"

#include <algorithm>
#include <cmath>

namespace imu_pose_calib {
namespace {

constexpr double kStep = 1e-4;  // [s] at the ends of runs

/// The part of a run in which samples of the IMU tell of the motion: at its very ends, poses alone
/// leave the velocity undetermined.
void Trim(const PoseTrajectory& trajectory, CorrectionSplines::Run* run) {
  while (!IsOnTrajectory(trajectory, run->begin) && run->begin < run->end) run->begin += kStep;
  while (!IsOnTrajectory(trajectory, run->end) && run->begin < run->end) run->end -= kStep;
}

}  // namespace

ImuTrack::ImuTrack(const std::shared_ptr<const Solution>& solution,
                   size_t session,
                   size_t imu,
                   const std::shared_ptr<const TrajectoryCovariance>& covariance,
                   TrackClock clock,
                   double max_gap_s)
    : solution_(solution),
      session_(session),
      imu_(imu),
      clock_(clock),
      trajectory_(solution, session, covariance) {
  for (const SensorModel& model : solution->models)
    if (model.quantity == Quantity::kGyro && model.session == session && model.imu == imu)
      gyro_noise_ = model.noise;
  if (!has_covariance()) return;
  std::vector<CorrectionSplines::Run> runs = solution->splines[session].Runs();
  for (CorrectionSplines::Run& run : runs) Trim(*solution->trajectories[session], &run);
  for (size_t k = 0; k + 1 < runs.size(); ++k) {
    gaps_.push_back({runs[k].end, runs[k + 1].begin, {}});
    TrackGap& gap = gaps_.back();
    if (gap.end - gap.begin <= max_gap_s)
      gap.carried = CarryAcrossGap(*solution, trajectory_, session, imu, gap.begin, gap.end);
  }
}

int64_t ImuTrack::Stamp(double t_imu) const {
  if (clock_ == TrackClock::kImu) return Recorded().epoch_ns + std::llround(1e9 * t_imu);
  return trajectory_.epoch_ns() + std::llround(1e9 * Clock().PoseTime(t_imu));
}

std::vector<ImuTrack::Instant> ImuTrack::Instants(double rate_hz) const {
  std::vector<Instant> instants;
  const std::vector<TimedSample>& gyro = Recorded().gyro;
  if (rate_hz == 0.0) {
    for (const TimedSample& s : gyro) instants.push_back({Stamp(s.t), Clock().PoseTime(s.t)});
    return instants;
  }
  const int64_t first = Stamp(gyro.front().t), last = Stamp(gyro.back().t);
  for (int64_t k = 0;; ++k) {
    const int64_t stamp = first + std::llround(1e9 * static_cast<double>(k) / rate_hz);
    if (stamp > last) return instants;
    const auto seconds = [stamp](int64_t epoch) {
      return 1e-9 * static_cast<double>(stamp - epoch);
    };
    instants.push_back({stamp,
                        clock_ == TrackClock::kPoses
                            ? seconds(trajectory_.epoch_ns())
                            : Clock().PoseTime(seconds(Recorded().epoch_ns))});
  }
}

std::optional<ImuState> ImuTrack::At(double t) const {
  ImuState state;
  state.covariance.setZero();
  state.bias_covariance.setZero();
  Eigen::Vector3d acceleration = Eigen::Vector3d::Zero();  // while carried
  const auto next_gap =
      std::upper_bound(gaps_.begin(), gaps_.end(), t, [](double value, const TrackGap& gap) {
        return value <= gap.begin;
      });
  if (next_gap != gaps_.begin() && t < std::prev(next_gap)->end) {
    const std::vector<CarriedState>& carried = std::prev(next_gap)->carried;
    if (carried.empty()) return std::nullopt;
    const auto after = std::upper_bound(
        carried.begin() + 1, carried.end() - 1, t, [](double value, const CarriedState& x) {
          return value < x.t;
        });
    const CarriedState x = Interpolate(*std::prev(after), *after, t);
    acceleration = (after->v_W - std::prev(after)->v_W) / (after->t - std::prev(after)->t);
    state.q_WI = x.q_WI;
    state.p_WI = x.p_WI;
    state.omega_I = x.omega_I;
    state.v_W = x.v_W;
    state.is_carried = true;
    const int place[] = {0, 3, 9};
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        state.covariance.block<3, 3>(place[i], place[j]) = x.covariance.block<3, 3>(3 * i, 3 * j);
  } else if (const auto body = IsOnTrajectory(*solution_->trajectories[session_], t)
                                   ? trajectory_.Imu(imu_, t)
                                   : std::nullopt) {
    state.q_WI = body->q_WB;
    state.p_WI = body->p_WB;
    state.omega_I = body->omega_B;
    state.v_W = body->v_W;
    const auto C = clock_ == TrackClock::kImu ? trajectory_.ImuCovarianceOnItsClock(imu_, t)
                                              : trajectory_.ImuCovariance(imu_, t);
    if (C) state.covariance = C->topLeftCorner<12, 12>();
  } else {
    return std::nullopt;
  }
  state.biases = trajectory_.Biases(imu_, t);
  if (const auto C = trajectory_.BiasCovariance(imu_, t)) state.bias_covariance = *C;
  if (!state.is_carried) return state;
  state.covariance.block<3, 3>(6, 6) = gyro_noise_ * gyro_noise_ * Eigen::Matrix3d::Identity() +
                                       state.bias_covariance.topLeftCorner<3, 3>();
  if (clock_ == TrackClock::kImu) {
    Eigen::Matrix<double, 12, 1> rate = Eigen::Matrix<double, 12, 1>::Zero();
    rate << state.omega_I, state.v_W, Eigen::Vector3d::Zero(), acceleration;
    state.covariance += trajectory_.ClockVariance(imu_, t) * rate * rate.transpose();
  }
  return state;
}

std::vector<ImuTrack::Sample> ImuTrack::Samples() const {
  const double delay = solution_->estimate.imus[imu_].accel_delay;
  std::vector<Sample> samples;
  for (const TimedSample& s : Recorded().gyro) {
    const auto accel = RecordedAt(Recorded().accel, Recorded().accel_report.rate_hz, s.t + delay);
    if (accel) samples.push_back({Stamp(s.t), s.value + s.rest, *accel});
  }
  return samples;
}

}  // namespace imu_pose_calib
