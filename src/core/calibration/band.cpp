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

/// Length scales for which a trajectory goes on beyond a run: its smoother looks as far.
constexpr double kReach = 2.0;
/// Where samples are between two knots: the turn rate of what swings from knot to knot is largest
/// in the middle, its acceleration at the knots. Elsewhere they would not see it.
constexpr double kGyroPlace = 0.5, kAccelPlace = 1.0;
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
  const GaussianProcess gp(data, h, false);
  InPortions(threads, static_cast<size_t>(n), [&](size_t i) {
    TimedSample& sample = begin[i];
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

/// The samples of a sensor at these instants [s, its clock], which are increasing, but for those in
/// gaps: cubic between four.
std::vector<TimedSample> Resample(const std::vector<TimedSample>& samples, double rate_hz,
                                  const std::vector<double>& instants) {
  const double max_gap = kMaxGapPeriods / rate_hz;
  const auto is_gap = [&](size_t i) { return samples[i + 1].t - samples[i].t > max_gap; };
  std::vector<TimedSample> found;
  size_t i = 0, k = 0;
  for (const double t : instants) {
    while (i + 2 < samples.size() && samples[i + 1].t <= t) ++i;
    if (t < samples[i].t || t > samples[i + 1].t || is_gap(i)) continue;
    const size_t begin = i > 0 && !is_gap(i - 1) ? i - 1 : i;
    const size_t end = i + 2 < samples.size() && !is_gap(i + 1) ? i + 3 : i + 2;
    TimedSample sample{t, Eigen::Vector3d::Zero()};
    for (size_t a = begin; a < end; ++a) {
      double share = 1.0;  // Lagrange's
      for (size_t b = begin; b < end; ++b)
        if (b != a) share *= (t - samples[b].t) / (samples[a].t - samples[b].t);
      sample.value += share * samples[a].value;
    }
    sample.rest = samples[t - samples[i].t < samples[i + 1].t - t ? i : i + 1].rest;
    found.push_back(sample);
  }
  return found;
}

/// Sets how many samples each of `resampled` stands for: those within half of `spacing_s`.
void Count(const std::vector<TimedSample>& samples, double spacing_s,
           std::vector<TimedSample>* resampled) {
  size_t begin = 0, end = 0;
  for (TimedSample& sample : *resampled) {
    for (begin = end; begin < samples.size() && samples[begin].t < sample.t - 0.5 * spacing_s;)
      ++begin;
    for (end = begin; end < samples.size() && samples[end].t < sample.t + 0.5 * spacing_s;) ++end;
    sample.count = std::max(1, static_cast<int>(end - begin));
  }
}

/// One of those that are as noisy can stand for the others.
bool AreAlike(const TimedPose& a, const TimedPose& b) {
  return a.position_scale == b.position_scale && a.rotation_scale == b.rotation_scale;
}

/// Appends the poses of a segment, of those that are alike one in each `spacing_s`.
void AppendThinned(const std::vector<TimedPose>& poses, IndexRange segment, double spacing_s,
                   std::vector<TimedPose>* thinned) {
  // Spans end between poses.
  const double first =
      segment.size() > 1 ? 1.5 * poses[segment.begin].t - 0.5 * poses[segment.begin + 1].t : 0.0;
  const auto span = [&](size_t i) { return std::floor((poses[i].t - first) / spacing_s); };
  for (size_t begin = segment.begin, end = begin; begin < segment.end; begin = end) {
    do {
      ++end;
    } while (end < segment.end && span(end) == span(begin) && AreAlike(poses[begin], poses[end]));
    thinned->push_back(poses[begin + (end - begin) / 2]);
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

PreparedSession Thinned(const PreparedSession& limited, const Estimate& estimate, size_t session,
                        const CorrectionSplines& splines) {
  PreparedSession thinned = limited;
  ConditionedData& data = thinned.data;
  for (size_t i = 0; i < data.imus.size(); ++i) {
    if (!data.imus[i].IsPresent()) continue;
    const ImuSessionEstimate& clock = estimate.sessions[session].imus[i];
    const auto resample = [&](double place, double delay, double rate_hz,
                              std::vector<TimedSample>* samples) {
      std::vector<double> instants;
      for (const CorrectionSplines::Run& run : splines.Runs())
        for (double k = place; k < static_cast<double>(run.spans); k += 1.0)
          instants.push_back(clock.ImuTime(run.begin + run.spacing * k) + delay);
      std::vector<TimedSample> resampled = Resample(*samples, rate_hz, instants);
      Count(*samples, splines.spacing(), &resampled);
      samples->swap(resampled);
    };
    ConditionedImu& imu = data.imus[i];
    resample(kGyroPlace, 0.0, imu.gyro_report.rate_hz, &imu.gyro);
    resample(kAccelPlace, estimate.imus[i].accel_delay, imu.accel_report.rate_hz, &imu.accel);
  }
  std::vector<TimedPose> poses;
  for (IndexRange& segment : data.segments) {
    const size_t begin = poses.size();
    AppendThinned(data.poses, segment, splines.spacing(), &poses);
    segment = {begin, poses.size()};
  }
  data.poses.swap(poses);
  return thinned;
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
      splines.SampleMotion(gp, kReach * kSharpness / cutoff, threads, &runs);
  return std::make_shared<const PoseTrajectory>(
      poses, runs, smoother(gp.position_hyperparameters()), smoother(gp.rotation_hyperparameters()),
      threads, false);
}

}  // namespace imu_pose_calib
