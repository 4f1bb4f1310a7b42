#include "imu_pose_calib/core/calibration/correction_splines.h"

#include <algorithm>
#include <cmath>

#include "imu_pose_calib/core/base/parallel.h"
#include "imu_pose_calib/core/calibration/least_squares.h"

namespace imu_pose_calib {
namespace {

constexpr size_t kMinSpans = 4;  // shorter runs say little and are left out

/// Instants without a gap [s, pose clock].
struct Interval {
  double begin, end;
};

/// Where both sensors of an IMU have samples, by the clocks as they stand.
std::vector<Interval> Covered(const ConditionedImu& samples, const ImuSessionEstimate& clock,
                              double accel_delay, double spacing_s) {
  const auto runs = [&](const std::vector<TimedSample>& sensor, double delay) {
    std::vector<Interval> intervals;
    for (size_t i = 0; i < sensor.size(); ++i) {
      const double t = clock.PoseTime(sensor[i].t - delay);
      if (i == 0 || sensor[i].t - sensor[i - 1].t > LongestStepOf(spacing_s))
        intervals.push_back({t, t});
      intervals.back().end = t;
    }
    return intervals;
  };
  const auto gyro = runs(samples.gyro, 0.0);
  const auto accel = runs(samples.accel, accel_delay);
  std::vector<Interval> both;
  for (const Interval& g : gyro)
    for (const Interval& a : accel)
      if (std::min(g.end, a.end) > std::max(g.begin, a.begin))
        both.push_back({std::max(g.begin, a.begin), std::min(g.end, a.end)});
  return both;
}

/// Union of intervals, in order.
std::vector<Interval> Join(std::vector<Interval> intervals) {
  std::sort(intervals.begin(), intervals.end(),
            [](const Interval& a, const Interval& b) { return a.begin < b.begin; });
  std::vector<Interval> joined;
  for (const Interval& interval : intervals) {
    if (joined.empty() || interval.begin > joined.back().end)
      joined.push_back(interval);
    else
      joined.back().end = std::max(joined.back().end, interval.end);
  }
  return joined;
}

/// Control points of the spline with these values at its knots, of which there are `spans` + 1, and
/// these second derivatives, times the squared spacing, at its ends.
void Interpolate(const std::vector<Eigen::Vector3d>& values, const Eigen::Vector3d& first_curvature,
                 const Eigen::Vector3d& last_curvature, Eigen::Vector3d* points) {
  const size_t spans = values.size() - 1;
  points[1] = values[0] - first_curvature / 6.0;
  points[spans + 1] = values[spans] - last_curvature / 6.0;
  std::vector<double> share(spans + 1, 0.0);  // of the next point in each
  for (size_t k = 2; k <= spans; ++k) {
    share[k] = 1.0 / (4.0 - share[k - 1]);
    points[k] = share[k] * (6.0 * values[k - 1] - points[k - 1]);
  }
  for (size_t k = spans; k >= 2; --k) points[k] -= share[k] * points[k + 1];
  points[0] = 2.0 * points[1] - points[2] + first_curvature;
  points[spans + 2] = 2.0 * points[spans + 1] - points[spans] + last_curvature;
}

}  // namespace

CorrectionSplines::CorrectionSplines(const ConditionedData& data, const Estimate& estimate,
                                     size_t session, double spacing_s)
    : spacing_(spacing_s) {
  std::vector<Interval> covered;
  for (size_t i = 0; i < data.imus.size(); ++i) {
    if (!data.imus[i].IsPresent()) continue;
    const auto own = Covered(data.imus[i], estimate.sessions[session].imus[i],
                             estimate.imus[i].accel_delay, spacing_s);
    covered.insert(covered.end(), own.begin(), own.end());
  }
  size_t points = 0;
  for (const IndexRange& segment : data.segments) {
    for (const Interval& interval : Join(covered)) {
      const double begin = std::max(interval.begin, data.poses[segment.begin].t + kSegmentEdge);
      const double end = std::min(interval.end, data.poses[segment.end - 1].t - kSegmentEdge);
      if (end - begin < static_cast<double>(kMinSpans) * spacing_s) continue;
      const auto spans = static_cast<size_t>(std::round((end - begin) / spacing_s));
      runs_.push_back({begin, end, (end - begin) / static_cast<double>(spans), points, spans});
      points += spans + kSplineOrder - 1;
    }
  }
  if (runs_.empty()) throw DataError("poses and IMU samples have no run without a gap in common");
  d.assign(points, Eigen::Vector3d::Zero());
  phi.assign(points, Eigen::Vector3d::Zero());
}

const CorrectionSplines::Run* CorrectionSplines::Find(double t) const {
  const auto after =
      std::upper_bound(runs_.begin(), runs_.end(), t,
                       [](double value, const Run& run) { return value < run.begin; });
  return after == runs_.begin() || t > std::prev(after)->end ? nullptr : &*std::prev(after);
}

std::optional<SplinePlace> CorrectionSplines::Locate(double t) const {
  const Run* const run = Find(t);
  if (run == nullptr) return std::nullopt;
  const double x = (t - run->begin) / run->spacing;
  const size_t span = std::min(run->spans - 1, static_cast<size_t>(x));
  return SplinePlace{run->first + span, x - static_cast<double>(span), run->spacing};
}

std::vector<TimedPose> CorrectionSplines::SampleMotion(const PoseTrajectory& gp, double reach,
                                                       int threads,
                                                       std::vector<IndexRange>* runs) const {
  std::vector<TimedPose> poses;
  for (const Run& run : runs_) {
    const size_t begin = poses.size(), beyond = static_cast<size_t>(reach / run.spacing);
    runs->push_back({begin, begin + run.spans + 1 + 2 * beyond});
    poses.resize(runs->back().end);
    InPortions(threads, runs->back().size(), [&](size_t k) {
      const double t =
          run.begin + run.spacing * (static_cast<double>(k) - static_cast<double>(beyond));
      const double inside = std::clamp(t, run.begin, run.end);
      const MarkerState<double> state = *Correct(gp, inside);
      const double dt = t - inside;
      poses[begin + k].t = t;
      poses[begin + k].q_WM =
          state.q_WM * Exp(Eigen::Vector3d(dt * (state.omega_M + 0.5 * dt * state.alpha_M)));
      poses[begin + k].p_WM = state.p_WM + dt * (state.v_W + 0.5 * dt * state.a_W);
    });
  }
  return poses;
}

void CorrectionSplines::Rebase(const PoseTrajectory& from, const PoseTrajectory& to, int threads) {
  for (const Run& run : runs_) {
    const size_t knots = run.spans + 1;
    // Values and second derivatives.
    std::vector<Eigen::Vector3d> p(knots), q(knots), a(knots), alpha(knots);
    InPortions(threads, knots, [&](size_t k) {
      const double t = std::min(run.end, run.begin + run.spacing * static_cast<double>(k));
      const MarkerState<double> state = *Correct(from, t);
      MarkerState<double> gp;
      to.Evaluate(t, &gp);
      p[k] = state.p_WM - gp.p_WM;
      q[k] = Log(Eigen::Quaterniond(gp.q_WM.conjugate() * state.q_WM));
      a[k] = state.a_W - gp.a_W;
      alpha[k] = state.alpha_M - gp.alpha_M;
    });
    const double h2 = run.spacing * run.spacing;
    Interpolate(p, h2 * a.front(), h2 * a.back(), &d[run.first]);
    Interpolate(q, h2 * alpha.front(), h2 * alpha.back(), &phi[run.first]);
  }
}

std::optional<MarkerState<double>> CorrectionSplines::Correct(const PoseTrajectory& gp,
                                                              double t) const {
  const auto place = Locate(t);
  MarkerState<double> state;
  if (!place || !gp.Evaluate(t, &state)) return std::nullopt;
  const double *d_points[kSplineOrder], *phi_points[kSplineOrder];
  for (size_t j = 0; j < kSplineOrder; ++j) {
    d_points[j] = d[place->first + j].data();
    phi_points[j] = phi[place->first + j].data();
  }
  const SplineWeights weights = CubicWeights(place->u, place->spacing);
  return Corrected<double>(state, EvaluateSpline<double>(d_points, weights),
                           EvaluateSpline<double>(phi_points, weights));
}

}  // namespace imu_pose_calib
