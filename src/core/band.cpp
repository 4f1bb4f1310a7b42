#include "imu_pose_calib/core/band.h"

#include <algorithm>
#include <cmath>

#include "imu_pose_calib/core/so3.h"

namespace imu_pose_calib {
namespace {

/// Length scale of a smoother times the frequency of which it lets half pass: of half of that it
/// takes 6e-6, of a third more it lets 4e-6 pass.
constexpr double kSharpness = 0.9;

/// Noise of the GP that lets half of `cutoff` [Hz] pass: there, the spectra of its signal and of
/// its noise meet.
double NoiseOf(const GpHyperparameters& h, double rate_hz, double cutoff) {
  const double x = 2.0 * M_PI * cutoff * h.lengthscale_s;
  const double density = h.signal_std * h.signal_std * h.lengthscale_s * std::sqrt(2.0 * M_PI) *
                         std::exp(-0.5 * x * x);
  return std::sqrt(density * rate_hz);
}

/// Moves the cut-off of a smoother down; false when it is as low already.
bool LowerCutoff(double rate_hz, double cutoff, GpHyperparameters* h) {
  if (h->noise_std >= NoiseOf(*h, rate_hz, cutoff)) return false;
  h->lengthscale_s = std::max(h->lengthscale_s, kSharpness / cutoff);
  h->noise_std = NoiseOf(*h, rate_hz, cutoff);
  return true;
}

void Smooth(double rate_hz, double cutoff, std::vector<TimedSample>* samples) {
  const auto n = static_cast<Eigen::Index>(samples->size());
  GpData data{Eigen::VectorXd(n), Eigen::MatrixXd(n, 3)};
  for (Eigen::Index i = 0; i < n; ++i) {
    data.t[i] = (*samples)[static_cast<size_t>(i)].t;
    data.y.row(i) = (*samples)[static_cast<size_t>(i)].value;
  }
  const Eigen::RowVector3d mean = data.y.colwise().mean();
  data.y.rowwise() -= mean;
  GpHyperparameters h{kSharpness / cutoff, 1.0, 0.0};  // only the ratio of the two matters
  h.noise_std = NoiseOf(h, rate_hz, cutoff);
  const WindowedGp gp(data, h);
  for (TimedSample& sample : *samples) {
    const Eigen::Vector3d smooth = mean.transpose() + gp.Evaluate(sample.t).col(0);
    sample.rest += sample.value - smooth;
    sample.value = smooth;
  }
}

}  // namespace

PreparedSession LimitBand(const PreparedSession& session, double cutoff, std::launch policy) {
  PreparedSession limited = session;
  std::vector<std::future<void>> smoothed;
  for (ConditionedImu& imu : limited.data.imus) {
    if (!imu.IsPresent()) continue;
    smoothed.push_back(
        std::async(policy, [&imu, cutoff] { Smooth(imu.gyro_report.rate_hz, cutoff, &imu.gyro); }));
    smoothed.push_back(std::async(
        policy, [&imu, cutoff] { Smooth(imu.accel_report.rate_hz, cutoff, &imu.accel); }));
  }
  const double rate_hz = session.data.pose_report.rate_hz;
  GpHyperparameters position = session.trajectory->position_hyperparameters();
  GpHyperparameters rotation = session.trajectory->rotation_hyperparameters();
  const bool is_position_lower = LowerCutoff(rate_hz, cutoff, &position);
  const bool is_rotation_lower = LowerCutoff(rate_hz, cutoff, &rotation);
  if (is_position_lower || is_rotation_lower) {
    limited.trajectory = std::make_shared<const PoseTrajectory>(
        session.data.poses, session.data.segments, position, rotation, policy);
    for (TimedPose& pose : limited.data.poses) {
      if (!limited.trajectory->Contains(pose.t)) continue;
      const PoseTrajectory::Pose smooth = limited.trajectory->PoseAt(pose.t);
      if (is_position_lower) {
        pose.position_rest = pose.p_WM - smooth.p_WM;
        pose.p_WM = smooth.p_WM;
      }
      if (is_rotation_lower) {
        pose.rotation_rest = Log(Eigen::Quaterniond(smooth.q_WM.conjugate() * pose.q_WM));
        pose.q_WM = smooth.q_WM;
      }
    }
  }
  for (std::future<void>& task : smoothed) task.get();
  return limited;
}

}  // namespace imu_pose_calib
