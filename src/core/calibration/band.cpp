#include "imu_pose_calib/core/calibration/band.h"

#include <algorithm>
#include <cmath>

#include "imu_pose_calib/core/base/parallel.h"
#include "imu_pose_calib/core/base/so3.h"

namespace imu_pose_calib {
namespace {

/// Length scale of a smoother times the frequency of which it lets half pass: of half of that it
/// takes 6e-6, of a third more it lets 4e-6 pass.
constexpr double kSharpness = 0.9;

/// Length scales from the end of a run within which samples stay as they are: what lies beyond is
/// missing in their means.
constexpr double kEdge = 2.0;
/// Periods between samples, of a gap.
constexpr double kMaxGapPeriods = 5.5;

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

/// The samples of a run without a gap; `noise_scale` of each, empty: they are alike.
void Smooth(double rate_hz, double cutoff, int threads, TimedSample* begin, TimedSample* end,
            const Eigen::VectorXd& noise_scale = Eigen::VectorXd()) {
  const auto n = static_cast<Eigen::Index>(end - begin);
  GpData data{Eigen::VectorXd(n), Eigen::MatrixXd(n, 3), noise_scale};
  for (Eigen::Index i = 0; i < n; ++i) {
    data.t[i] = begin[i].t;
    data.y.row(i) = begin[i].value;
  }
  const Eigen::RowVector3d mean = data.y.colwise().mean();
  data.y.rowwise() -= mean;
  GpHyperparameters h{kSharpness / cutoff, 1.0, 0.0};  // only the ratio of the two matters
  h.noise_std = NoiseOf(h, rate_hz, cutoff);
  const double edge = kEdge * h.lengthscale_s;
  if (data.t[n - 1] - data.t[0] < 2.0 * edge) return;
  const GaussianProcess gp(data, h, false);
  InPortions(threads, static_cast<size_t>(n), [&](size_t i) {
    TimedSample& sample = begin[i];
    if (sample.t - data.t[0] < edge || data.t[n - 1] - sample.t < edge) return;
    const Eigen::Vector3d smooth = mean.transpose() + gp.Value(sample.t).head<3>();
    sample.rest += sample.value - smooth;
    sample.value = smooth;
  });
}

void Smooth(double rate_hz, double cutoff, int threads, std::vector<TimedSample>* samples) {
  const double max_gap = kMaxGapPeriods / rate_hz;
  TimedSample* const end = samples->data() + samples->size();
  TimedSample* begin = samples->data();
  for (TimedSample* s = begin; s != end; ++s) {
    if (s + 1 != end && (s + 1)->t - s->t <= max_gap) continue;
    Smooth(rate_hz, cutoff, threads, begin, s + 1);
    begin = s + 1;
  }
}

/// Smooths the errors of the poses' positions [m] or rotations [rad] about the session's
/// trajectory.
void SmoothErrors(bool is_rotation, double cutoff, int threads, PreparedSession* session) {
  for (const IndexRange& segment : session->data.segments) {
    TimedPose* const poses = session->data.poses.data() + segment.begin;
    std::vector<Rigid3> T_WM(segment.size());
    std::vector<TimedSample> errors(segment.size());
    Eigen::VectorXd scales(segment.size());
    InPortions(threads, segment.size(), [&](size_t i) {
      const TimedPose& pose = poses[i];
      T_WM[i] = session->trajectory->PoseAt(pose.t);
      errors[i].t = pose.t;
      errors[i].value = is_rotation ? Log(Eigen::Quaterniond(T_WM[i].q.conjugate() * pose.q_WM))
                                    : Eigen::Vector3d(pose.p_WM - T_WM[i].p);
      scales[static_cast<Eigen::Index>(i)] =
          is_rotation ? pose.rotation_scale : pose.position_scale;
    });
    Smooth(session->data.pose_report.rate_hz, cutoff, threads, errors.data(),
           errors.data() + errors.size(), scales);
    for (size_t i = 0; i < segment.size(); ++i) {
      if (is_rotation) {
        const Eigen::Quaterniond q_WM = T_WM[i].q * Exp(errors[i].value);
        poses[i].rotation_rest = Log(Eigen::Quaterniond(q_WM.conjugate() * poses[i].q_WM));
        poses[i].q_WM = q_WM;
      } else {
        poses[i].position_rest = errors[i].rest;
        poses[i].p_WM = T_WM[i].p + errors[i].value;
      }
    }
  }
}

/// Smoothed, and as noisy: one can stand for both.
bool AreAlike(const TimedSample& a, const TimedSample& b) {
  return !a.rest.isZero(0.0) && !b.rest.isZero(0.0);
}
bool AreAlike(const TimedPose& a, const TimedPose& b) {
  return !a.position_rest.isZero(0.0) && !b.position_rest.isZero(0.0) &&
         a.position_scale == b.position_scale && a.rotation_scale == b.rotation_scale;
}

/// Appends the samples of a run, of those that are alike one in each `spacing_s`.
template <typename Timed>
void AppendThinned(const std::vector<Timed>& samples, IndexRange run, double spacing_s,
                   std::vector<Timed>* thinned) {
  // Spans end between samples.
  const double first =
      run.size() > 1 ? 1.5 * samples[run.begin].t - 0.5 * samples[run.begin + 1].t : 0.0;
  const auto span = [&](size_t i) { return std::floor((samples[i].t - first) / spacing_s); };
  for (size_t begin = run.begin, end = begin; begin < run.end; begin = end) {
    do {
      ++end;
    } while (end < run.end && span(end) == span(begin) && AreAlike(samples[begin], samples[end]));
    thinned->push_back(samples[begin + (end - begin) / 2]);
    thinned->back().count = static_cast<int>(end - begin);
  }
}

}  // namespace

PreparedSession LimitBand(const PreparedSession& session, double cutoff, int threads) {
  PreparedSession limited = session;
  for (ConditionedImu& imu : limited.data.imus) {
    if (!imu.IsPresent()) continue;
    Smooth(imu.gyro_report.rate_hz, cutoff, threads, &imu.gyro);
    Smooth(imu.accel_report.rate_hz, cutoff, threads, &imu.accel);
  }
  const double rate_hz = session.data.pose_report.rate_hz;
  GpHyperparameters position = session.trajectory->position_hyperparameters();
  GpHyperparameters rotation = session.trajectory->rotation_hyperparameters();
  const bool is_position_lower = LowerCutoff(rate_hz, cutoff, &position);
  const bool is_rotation_lower = LowerCutoff(rate_hz, cutoff, &rotation);
  if (is_position_lower || is_rotation_lower)
    limited.trajectory = std::make_shared<const PoseTrajectory>(
        session.data.poses, session.data.segments, position, rotation, threads, false);
  for (const bool is_rotation : {false, true}) SmoothErrors(is_rotation, cutoff, threads, &limited);
  return limited;
}

PreparedSession Thinned(const PreparedSession& limited, double spacing_s) {
  PreparedSession session = limited;
  ConditionedData& data = session.data;
  for (ConditionedImu& imu : data.imus) {
    for (std::vector<TimedSample>* const samples : {&imu.gyro, &imu.accel}) {
      std::vector<TimedSample> kept;
      AppendThinned(*samples, {0, samples->size()}, spacing_s, &kept);
      kept.shrink_to_fit();
      samples->swap(kept);
    }
  }
  std::vector<TimedPose> poses;
  for (IndexRange& segment : data.segments) {
    const size_t begin = poses.size();
    AppendThinned(data.poses, segment, spacing_s, &poses);
    segment = {begin, poses.size()};
  }
  poses.shrink_to_fit();
  data.poses.swap(poses);
  return session;
}

std::shared_ptr<const PoseTrajectory> SmoothTrajectory(const PoseTrajectory& gp,
                                                       const CorrectionSplines& splines,
                                                       int threads) {
  const double cutoff = Band(splines.spacing());
  const auto smoother = [&](GpHyperparameters h) {
    h.lengthscale_s = kSharpness / cutoff;
    h.noise_std = NoiseOf(h, 1.0 / splines.spacing(), cutoff);
    return h;
  };
  std::vector<IndexRange> runs;
  const std::vector<TimedPose> poses =
      splines.SampleMotion(gp, kEdge * kSharpness / cutoff, threads, &runs);
  return std::make_shared<const PoseTrajectory>(
      poses, runs, smoother(gp.position_hyperparameters()), smoother(gp.rotation_hyperparameters()),
      threads, false);
}

}  // namespace imu_pose_calib
