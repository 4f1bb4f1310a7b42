#include "imu_pose_calib/core/calibration/band.h"

#include <algorithm>
#include <cmath>

#include "imu_pose_calib/core/base/parallel.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/base/text.h"

namespace imu_pose_calib {
namespace {

/// Length scale of a smoother times the frequency of which it lets half pass: of half of that it
/// takes 6e-6, of a third more it lets 4e-6 pass.
constexpr double kSharpness = 0.9;

/// Length scales for which a trajectory goes on beyond a run: its smoother looks as far.
constexpr double kReach = 2.0;

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
  const double max_gap = LongestStepOf(Band(cutoff));  // the spacing: Band() is its own inverse
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

/// Samples of a sensor in order of time, with gaps.
class Recorded {
 public:
  Recorded(const std::vector<TimedSample>& samples, double spacing_s)
      : samples_(samples), spacing_s_(spacing_s) {}

  /// Whether t [s, its clock] is between two of them without a gap.
  bool Covers(double t) const {
    const size_t i = Find(t);
    return t >= samples_[i].t && t <= samples_[i + 1].t && !IsGap(i);
  }

  /// The sample at t, cubic between four or as many as are there without a gap; in a gap that of
  /// its nearer side goes on. It stands for those within half of the spacing.
  TimedSample At(double t) const {
    size_t i = Find(t);
    if (IsGap(i) && i > 0 && t - samples_[i].t < samples_[i + 1].t - t)
      --i;
    else if (IsGap(i) && i + 2 < samples_.size())
      ++i;
    const size_t begin = i > 0 && !IsGap(i - 1) ? i - 1 : i;
    const size_t end = i + 2 < samples_.size() && !IsGap(i + 1) ? i + 3 : i + 2;
    TimedSample sample{t, Eigen::Vector3d::Zero()};
    for (size_t a = begin; a < end; ++a) {
      double share = 1.0;  // Lagrange's
      for (size_t b = begin; b < end; ++b)
        if (b != a) share *= (t - samples_[b].t) / (samples_[a].t - samples_[b].t);
      sample.value += share * samples_[a].value;
    }
    sample.rest = samples_[t - samples_[i].t < samples_[i + 1].t - t ? i : i + 1].rest;
    const size_t count = After(t + 0.5 * spacing_s_) - After(t - 0.5 * spacing_s_);
    sample.count = std::max(1, static_cast<int>(count));
    return sample;
  }

 private:
  /// How many are not after t.
  size_t After(double t) const {
    return static_cast<size_t>(
        std::upper_bound(samples_.begin(), samples_.end(), t,
                         [](double value, const TimedSample& s) { return value < s.t; }) -
        samples_.begin());
  }
  /// The sample before t, not the last one.
  size_t Find(double t) const { return std::clamp<size_t>(After(t), 1, samples_.size() - 1) - 1; }
  bool IsGap(size_t i) const {
    return samples_[i + 1].t - samples_[i].t > LongestStepOf(spacing_s_);
  }

  const std::vector<TimedSample>& samples_;
  const double spacing_s_;
};

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
    InParallel(threads, 2, [&](size_t is_accel) {
      if (is_accel)
        Smooth(imu.accel_report.rate_hz, cutoff, threads, &imu.accel);
      else
        Smooth(imu.gyro_report.rate_hz, cutoff, threads, &imu.gyro);
    });
  }
  const double rate_hz = session.data.pose_report.rate_hz;
  GpHyperparameters position = session.trajectory->position_hyperparameters();
  GpHyperparameters rotation = session.trajectory->rotation_hyperparameters();
  const bool is_position_lower = LowerCutoff(rate_hz, cutoff, &position);
  const bool is_rotation_lower = LowerCutoff(rate_hz, cutoff, &rotation);
  if (is_position_lower || is_rotation_lower)
    limited.trajectory = std::make_shared<const PoseTrajectory>(
        session.data.poses, session.data.segments, position, rotation, threads, false);
  InParallel(threads, 2,
             [&](size_t is_rotation) { SmoothErrors(is_rotation, cutoff, threads, &limited); });
  return limited;
}

std::vector<ImuInstants> FindInstants(const PreparedSession& limited, const SessionEstimate& clocks,
                                      const CorrectionSplines& splines) {
  std::vector<ImuInstants> instants(limited.data.imus.size());
  for (size_t i = 0; i < instants.size(); ++i) {
    const ConditionedImu& imu = limited.data.imus[i];
    if (!imu.IsPresent()) continue;
    const Recorded gyro(imu.gyro, splines.spacing()), accel(imu.accel, splines.spacing());
    for (const CorrectionSplines::Run& run : splines.Runs()) {
      for (size_t k = 0; k < run.spans; ++k) {
        const double knot = run.begin + run.spacing * static_cast<double>(k);
        const double t = clocks.imus[i].ImuTime(knot);
        if (gyro.Covers(t + 0.5 * run.spacing))
          instants[i].gyro.push_back(knot + 0.5 * run.spacing);
        if (k > 0 && accel.Covers(t + limited.starts[i].accel_delay))
          instants[i].accel.push_back(knot);
      }
    }
    if (instants[i].gyro.empty() || instants[i].accel.empty())
      Throw<DataError>("no ", instants[i].gyro.empty() ? "gyroscope" : "accelerometer",
                       " samples follow each other within two knots (knot_spacing_s: ",
                       splines.spacing(), " s)", OfImu(i, instants.size()));
  }
  return instants;
}

PreparedSession Thinned(const PreparedSession& limited, double spacing_s) {
  PreparedSession thinned = limited;
  std::vector<TimedPose> poses;
  for (IndexRange& segment : thinned.data.segments) {
    const size_t begin = poses.size();
    AppendThinned(limited.data.poses, segment, spacing_s, &poses);
    segment = {begin, poses.size()};
  }
  thinned.data.poses.swap(poses);
  return thinned;
}

void Resample(const PreparedSession& limited, const std::vector<ImuInstants>& instants,
              const Estimate& estimate, size_t session, double spacing_s, int threads,
              PreparedSession* thinned) {
  for (size_t i = 0; i < instants.size(); ++i) {
    const ConditionedImu& imu = limited.data.imus[i];
    if (!imu.IsPresent()) continue;
    const ImuSessionEstimate& clock = estimate.sessions[session].imus[i];
    const auto resample = [&](const std::vector<TimedSample>& samples, double delay,
                              const std::vector<double>& times, std::vector<TimedSample>* out) {
      const Recorded recorded(samples, spacing_s);
      std::vector<TimedSample> resampled(times.size());
      InPortions(threads, times.size(),
                 [&](size_t k) { resampled[k] = recorded.At(clock.ImuTime(times[k]) + delay); });
      out->swap(resampled);
    };
    ConditionedImu* const out = &thinned->data.imus[i];
    resample(imu.gyro, 0.0, instants[i].gyro, &out->gyro);
    resample(imu.accel, estimate.imus[i].accel_delay, instants[i].accel, &out->accel);
  }
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
