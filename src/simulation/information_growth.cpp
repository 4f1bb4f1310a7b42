#include "imu_pose_calib/simulation/information_growth.h"

#include <Eigen/LU>
#include <cmath>

#include "imu_pose_calib/core/base/so3.h"

namespace imu_pose_calib {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

constexpr int kShares = 40;
constexpr int kInstantsPerShare = 100;
constexpr double kDerivativeStep = 1e-3;  // [s]
constexpr double kEdge = 0.1;             // [s] close to gaps, the trajectory is not believed
/// Sigmas of what is known before: of gravity's magnitude [m/s^2], and of everything, in its unit.
constexpr double kGravityPrior = 1e-3, kPrior = 10.0;

// Parameters: p_MI (3), R_MI (3, about the imu axes), time_shift, accel_delay, gravity (3), biases
// of the gyroscope (3) and the accelerometer (3).
constexpr int kReported = 8, kParameters = 17;
constexpr int kShift = 6, kDelay = 7, kGravity = 8, kGyroBias = 11, kAccelBias = 14;
using Rows = Eigen::Matrix<double, 3, kParameters>;
using Information = Eigen::Matrix<double, kParameters, kParameters>;

/// f_I [m/s^2] that an ideal accelerometer feels.
Vector3d SpecificForceOf(const BodyState& imu, const Vector3d& g_W) {
  return imu.q_WB.conjugate() * (imu.a_W - g_W);
}

/// What a gyroscope and an accelerometer sample of sigma 1 tell, one row an axis. False in a gap.
bool Differentiate(const SessionTrajectory& trajectory, size_t imu, const Matrix3d& R_MI,
                   const Vector3d& g_W, double t, Rows* gyro, Rows* accel) {
  const auto marker = trajectory.Marker(t);
  const auto before = trajectory.Imu(imu, t - kDerivativeStep);
  const auto now = trajectory.Imu(imu, t), after = trajectory.Imu(imu, t + kDerivativeStep);
  if (!marker || !before || !now || !after || !trajectory.Marker(t - kEdge) ||
      !trajectory.Marker(t + kEdge))
    return false;
  gyro->setZero();
  gyro->block<3, 3>(0, 3) = Hat(now->omega_B);
  gyro->col(kShift) = now->alpha_B;
  gyro->block<3, 3>(0, kGyroBias).setIdentity();
  const Matrix3d lever = Hat(marker->alpha_B) + Hat(marker->omega_B) * Hat(marker->omega_B);
  accel->setZero();
  accel->block<3, 3>(0, 0) = R_MI.transpose() * lever;
  accel->block<3, 3>(0, 3) = Hat(SpecificForceOf(*now, g_W));
  accel->col(kShift) =
      0.5 / kDerivativeStep * (SpecificForceOf(*after, g_W) - SpecificForceOf(*before, g_W));
  accel->col(kDelay) = -accel->col(kShift);
  accel->block<3, 3>(0, kGravity) = -now->q_WB.conjugate().toRotationMatrix();
  accel->block<3, 3>(0, kAccelBias).setIdentity();
  return true;
}

}  // namespace

InformationGrowth GrowInformation(const Calibration& result, size_t session, size_t imu,
                                  const SessionTrajectory& trajectory, double begin, double end) {
  const ImuSession& own = result.sessions[session].imus[imu];
  const Vector3d& g_W = result.sessions[session].g_W;
  Eigen::Matrix<double, kReported, 1> final_std;
  final_std << result.imus[imu].Std(), own.time_shift_std, result.imus[imu].accel_delay_std;
  const Matrix3d R_MI = result.imus[imu].T_MI.q.toRotationMatrix();

  Information H = Information::Identity() / (kPrior * kPrior);
  const Vector3d down = g_W.normalized();
  H.block<3, 3>(kGravity, kGravity) += down * down.transpose() / (kGravityPrior * kGravityPrior);
  const double step = (end - begin) / (kShares * kInstantsPerShare);
  // Of the samples that an instant stands for.
  const double gyro_weight = step * own.gyro.rate_hz / std::pow(own.noise.gyro, 2);
  const double accel_weight = step * own.accel.rate_hz / std::pow(own.noise.accel, 2);
  InformationGrowth growth;
  for (int k = 0; k < kShares; ++k) {
    for (int i = 0; i < kInstantsPerShare; ++i) {
      Rows gyro, accel;
      const double t = begin + step * (k * kInstantsPerShare + i + 0.5);
      if (!Differentiate(trajectory, imu, R_MI, g_W, t, &gyro, &accel)) continue;
      H += gyro_weight * gyro.transpose() * gyro + accel_weight * accel.transpose() * accel;
    }
    growth.share.push_back((k + 1.0) / kShares);
    growth.std.emplace_back(H.inverse().diagonal().head<kReported>().cwiseMax(0.0).cwiseSqrt());
  }
  const Eigen::Matrix<double, kReported, 1> scale = final_std.cwiseQuotient(growth.std.back());
  for (auto& std_dev : growth.std) std_dev = std_dev.cwiseProduct(scale);
  return growth;
}

}  // namespace imu_pose_calib
