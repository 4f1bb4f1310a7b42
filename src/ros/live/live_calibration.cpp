#include "imu_pose_calib/ros/live/live_calibration.h"

#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <cmath>
#include <sstream>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/core/data/stamps.h"

namespace imu_pose_calib {
namespace {

constexpr double kDegrees = 180.0 / 3.14159265358979323846;

/// Bound on the memory of a stream, whatever its rate.
constexpr size_t kMaxSamples = 500'000;
/// Stamps may go back by this much within a stream [s], as when a recording is conditioned.
constexpr double kMaxReorder = 1.0;
/// Recordings may be played this much faster than real time.
constexpr double kMaxPlayRate = 20.0;

/// What a good calibration needs on every axis.
constexpr double kEnoughRotation = 3.0 * 1.0 * 1.0;     // [rad^2/s]
constexpr double kEnoughTranslation = 3.0 * 0.3 * 0.3;  // [m^2/s]
/// Rates are differences over this time, long enough for the noise of poses [s].
constexpr double kMinMotionStep = 0.1, kMaxMotionStep = 0.3;

constexpr double kPathStep = 0.05;  // [s]

constexpr size_t kStableSolves = 3;
/// Of two results about as precise the newer one counts.
constexpr double kMuchWorse = 1.2;
constexpr double kRateSpan = 2.0;    // [s]
constexpr double kNoticeSpan = 5.0;  // [s]

double Seconds(int64_t ns) { return 1e-9 * static_cast<double>(ns); }

template <typename... Args>
std::string Text(const Args&... args) {
  std::ostringstream text;
  text.precision(3);
  (text << ... << args);
  return text.str();
}

bool IsValid(const PoseSample& pose) {
  return pose.p_WM.allFinite() && pose.q_WM.coeffs().allFinite() && pose.q_WM.norm() > 1e-3;
}

/// Largest ratio of sigma and target.
double Score(const LiveOptions& options, const Calibration& result) {
  const LargestStd std_dev = MaxStd(result);
  return std::max({std_dev.rotation / options.target_rotation_std,
                   std_dev.translation / options.target_translation_std,
                   std_dev.time_shift / options.target_time_shift_std});
}

/// Within two targets of each other.
bool Agree(const LiveOptions& options, const Calibration& a, const Calibration& b) {
  for (size_t i = 0; i < a.imus.size(); ++i) {
    const Rigid3 &one = a.imus[i].T_MI, &other = b.imus[i].T_MI;
    const double shift = a.sessions[0].imus[i].time_shift - b.sessions[0].imus[i].time_shift;
    if (one.q.angularDistance(other.q) > 2.0 * options.target_rotation_std ||
        (one.p - other.p).norm() > 2.0 * options.target_translation_std ||
        std::abs(shift) > 2.0 * options.target_time_shift_std)
      return false;
  }
  return true;
}

/// As people say them.
std::string Text(const LargestStd& std_dev) {
  return Text(1e3 * std_dev.translation, " mm, ", kDegrees * std_dev.rotation, " deg, ",
              1e3 * std_dev.time_shift, " ms");
}

std::string Sigmas(const Calibration& result) { return "sigma " + Text(MaxStd(result)); }

}  // namespace

const std::array<LiveOptions::Field, 7> LiveOptions::kFields = {
    {{"window", &LiveOptions::window},
     {"min_duration", &LiveOptions::min_duration},
     {"solve_interval", &LiveOptions::solve_interval},
     {"lost_timeout", &LiveOptions::lost_timeout},
     {"target_rotation_std", &LiveOptions::target_rotation_std},
     {"target_translation_std", &LiveOptions::target_translation_std},
     {"target_time_shift_std", &LiveOptions::target_time_shift_std}}};

void LiveOptions::Validate() const {
  for (const auto& [name, member] : kFields)
    if (const double value = this->*member; !(value > 0.0 && std::isfinite(value)))
      throw InputError(Text(name, " = ", value, " must be positive"));
  if (min_duration >= window)
    throw InputError(Text("min_duration = ", min_duration, " must be below window = ", window));
}

const char* ToString(Phase phase) {
  constexpr const char* kNames[] = {"waiting",   "collecting", "solving",
                                    "converged", "degraded",   "saved"};
  return kNames[static_cast<size_t>(phase)];
}

LargestStd MaxStd(const Calibration& result) {
  LargestStd largest{0.0, 0.0, 0.0};
  for (size_t i = 0; i < result.imus.size(); ++i) {
    const Vector6d std_dev = result.imus[i].Std();
    largest.rotation = std::max(largest.rotation, std_dev.tail<3>().maxCoeff());
    largest.translation = std::max(largest.translation, std_dev.head<3>().maxCoeff());
    largest.time_shift = std::max(largest.time_shift, result.sessions[0].imus[i].time_shift_std);
  }
  return largest;
}

template <typename Sample>
double LiveCalibration::Stream<Sample>::Duration() const {
  return samples.empty() ? 0.0 : Seconds(samples.back().t_ns - samples.front().t_ns);
}

template <typename Sample>
StreamStatus LiveCalibration::Stream<Sample>::Status() const {
  StreamStatus status;
  status.received = received;
  status.buffered_s = Duration();
  if (samples.empty()) return status;
  status.delay_s = arrival - Seconds(samples.back().t_ns);
  const int64_t newest = samples.back().t_ns;
  const auto recent = std::find_if(samples.rbegin(), samples.rend(), [&](const Sample& sample) {
    return Seconds(newest - sample.t_ns) > kRateSpan;
  });
  const auto count = std::distance(samples.rbegin(), recent);
  const double span = Seconds(newest - std::prev(recent)->t_ns);
  if (span > 0.0) status.rate_hz = static_cast<double>(count - 1) / span;
  return status;
}

LiveCalibration::LiveCalibration(const LiveOptions& options, const CalibrationOptions& calibration,
                                 size_t imus)
    : options_(options), calibration_(calibration) {
  options_.Validate();
  for (size_t i = 0; i < imus; ++i)
    imus_.push_back({{"gyroscope" + OfImu(i, imus), {}}, {"accelerometer" + OfImu(i, imus), {}}});
}

// --- Samples ---

/// Empty, or how the clock of the stream has jumped.
template <typename Sample>
std::string LiveCalibration::FindJump(const Sample& sample, double now,
                                      const Stream<Sample>& stream) const {
  if (stream.samples.empty()) return "";
  const double waited = now - stream.arrival;
  if (waited < -kMaxReorder)
    return Text("time went back by ", -waited, " s (a recording that starts again?)");
  const double step = Seconds(sample.t_ns - stream.samples.back().t_ns);
  if (step < -kMaxReorder)
    return Text("the stamps of the ", stream.name, " went back by ", -step, " s");
  if (step > kMaxReorder + kMaxPlayRate * std::max(waited, 0.0))
    return Text("the stamps of the ", stream.name, " jumped ahead by ", step, " s");
  return "";
}

/// False when the sample has no stamp and was dropped.
template <typename Sample>
bool LiveCalibration::Add(const Sample& sample, double now, Stream<Sample>* stream) {
  if (sample.t_ns == 0) {
    ++stream->unstamped;
    return false;
  }
  const std::string jump = FindJump(sample, now, *stream);
  if (!jump.empty() && !IsFrozen()) Reset(jump, now);
  if (!jump.empty()) stream->samples.clear();
  ++stream->received;
  stream->arrival = now;
  auto& samples = stream->samples;
  samples.push_back(sample);
  while (samples.size() > kMaxSamples || stream->Duration() > options_.window) samples.pop_front();
  return true;
}

bool LiveCalibration::AddPose(const PoseSample& recorded, double now) {
  if (!Add(recorded, now, &poses_)) return false;
  const PoseSample pose = ToMarkerPose(calibration_, recorded);
  if (!IsValid(pose) || (pose_ && SameValue(pose, *pose_))) return false;
  pose_ = pose;
  pose_changed_ = now;
  MeasureMotion(pose);
  ExtendPath(pose);
  return true;
}

void LiveCalibration::AddGyro(const ImuSample& sample, double now, size_t imu) {
  Add(sample, now, &imus_[imu].gyro);
}

void LiveCalibration::AddAccel(const ImuSample& sample, double now, size_t imu) {
  Add(sample, now, &imus_[imu].accel);
}

void LiveCalibration::MeasureMotion(const PoseSample& pose) {
  const double dt = motion_from_ ? Seconds(pose.t_ns - motion_from_->t_ns) : kMaxMotionStep;
  if (dt >= 0.0 && dt < kMinMotionStep) return;
  if (dt >= kMinMotionStep && dt < kMaxMotionStep) {
    const Eigen::Quaterniond q_MW = motion_from_->q_WM.normalized().conjugate();
    const Eigen::Vector3d turned = Log(Eigen::Quaterniond(q_MW * pose.q_WM.normalized()));
    const Eigen::Vector3d moved = q_MW * (pose.p_WM - motion_from_->p_WM);
    motion_.push_back({pose.t_ns, turned.cwiseAbs2() / dt, moved.cwiseAbs2() / dt});
    total_.rotation += motion_.back().rotation;
    total_.translation += motion_.back().translation;
  }
  motion_from_ = pose;
  while (!motion_.empty() && Seconds(pose.t_ns - motion_.front().t_ns) > options_.window) {
    total_.rotation -= motion_.front().rotation;
    total_.translation -= motion_.front().translation;
    motion_.pop_front();
  }
}

void LiveCalibration::ExtendPath(const PoseSample& pose) {
  const auto seconds_since = [&](const PoseSample& old) { return Seconds(pose.t_ns - old.t_ns); };
  const auto is_outside = [&](const PoseSample& old) {
    return seconds_since(old) > options_.window || seconds_since(old) < 0.0;
  };
  while (!path_.empty() && is_outside(path_.front())) path_.pop_front();
  if (path_.empty() || std::abs(seconds_since(path_.back())) > kPathStep) path_.push_back(pose);
}

Excitation LiveCalibration::Excited() const {
  const auto share = [](const Eigen::Vector3d& motion, double enough) -> Eigen::Vector3d {
    return (motion / enough).cwiseMax(0.0).cwiseMin(1.0);
  };
  return {share(total_.rotation, kEnoughRotation), share(total_.translation, kEnoughTranslation)};
}

// --- Solves ---

bool LiveCalibration::WantsSolve() const {
  if (is_solving_ || IsFrozen()) return false;
  double shortest = poses_.Duration();
  for (const Imu& imu : imus_)
    shortest = std::min({shortest, imu.gyro.Duration(), imu.accel.Duration()});
  if (shortest < options_.min_duration) return false;
  // Two axes determine everything; the solve itself tells how well.
  Eigen::Vector3d rotation = Excited().rotation;
  std::sort(rotation.data(), rotation.data() + 3);
  if (rotation[1] < 1.0) return false;
  const double fresh = Seconds(poses_.samples.back().t_ns - solved_until_ns_);
  return fresh >= (IsConverged() ? 0.5 * options_.window : options_.solve_interval);
}

SessionData LiveCalibration::BeginSolve() {
  is_solving_ = true;
  is_stale_ = false;
  solved_until_ns_ = poses_.samples.empty() ? 0 : poses_.samples.back().t_ns;
  const auto copy = [](const auto& samples) { return std::vector(samples.begin(), samples.end()); };
  SessionData data{copy(poses_.samples), {}};
  for (const Imu& imu : imus_)
    data.imus.push_back({copy(imu.gyro.samples), copy(imu.accel.samples)});
  return data;
}

bool LiveCalibration::EndSolve(const Calibration& result) {
  is_solving_ = false;
  if (is_stale_ || IsFrozen()) return false;
  if (!result.IsUsable()) {
    FailSolve(result.message);
    return false;
  }
  ++solves_;
  failure_.clear();
  last_.push_back(result);
  if (last_.size() > kStableSolves) last_.pop_front();
  const double score = Score(options_, result);
  if (result_ && score > kMuchWorse * best_score_) return false;
  best_score_ = result_ ? std::min(best_score_, score) : score;
  result_ = result;
  return true;
}

void LiveCalibration::FailSolve(const std::string& reason) {
  is_solving_ = false;
  if (is_stale_) return;
  ++solves_;
  failure_ = reason;
  last_.clear();
}

void LiveCalibration::Reset(const std::string& reason, double now) {
  poses_.samples.clear();
  for (Imu& imu : imus_) {
    imu.gyro.samples.clear();
    imu.accel.samples.clear();
  }
  pose_.reset();
  path_.clear();
  motion_.clear();
  total_ = Motion();
  motion_from_.reset();
  is_stale_ = is_solving_;
  solved_until_ns_ = 0;
  solves_ = 0;
  failure_.clear();
  last_.clear();
  result_.reset();
  frozen_.clear();
  ++resets_;
  notice_ = reason.empty() ? "" : reason + "; started anew";
  notice_time_ = now;
}

void LiveCalibration::Freeze(const std::string& message) { frozen_ = message; }

// --- Status ---

bool LiveCalibration::IsConverged() const {
  return result_ && Score(options_, *result_) <= 1.0 && last_.size() == kStableSolves &&
         Agree(options_, last_[0], last_[1]) && Agree(options_, last_[1], last_[2]) &&
         Agree(options_, last_[0], last_[2]);
}

std::string LiveCalibration::MissingStreams() const {
  std::vector<std::string> missing;
  const auto check = [&](const auto& stream) {
    if (stream.samples.empty())
      missing.push_back(stream.name +
                        (stream.unstamped > 0 ? " with header stamps (all are 0)" : ""));
  };
  check(poses_);
  for (const Imu& imu : imus_) {
    check(imu.gyro);
    check(imu.accel);
  }
  return boost::join(missing, ", ");
}

std::string LiveCalibration::LostStreams(double now) const {
  std::vector<std::string> lost;
  const auto check = [&](const auto& stream) {
    const double silent = now - stream.arrival;
    if (silent > options_.lost_timeout)
      lost.push_back(Text("no ", stream.name, " for ", std::round(10.0 * silent) / 10.0, " s"));
  };
  check(poses_);
  if (lost.empty() && now - pose_changed_ > options_.lost_timeout)
    lost.push_back(Text("the marker is lost: the poses repeat or are invalid for ",
                        std::round(10.0 * (now - pose_changed_)) / 10.0, " s"));
  for (const Imu& imu : imus_) {
    check(imu.gyro);
    check(imu.accel);
  }
  return boost::join(lost, ", ");
}

std::string LiveCalibration::Advice() const {
  const Excitation excitation = Excited();
  constexpr const char* kAxes[] = {"x", "y", "z"};
  Eigen::Index axis = 0;
  if (excitation.rotation.minCoeff(&axis) < 1.0)
    return Text("rotate about the marker's ", kAxes[axis], " axis");
  if (!failure_.empty()) return "no result yet: " + failure_;
  if (excitation.translation.minCoeff(&axis) < 1.0)
    return Text("move along the marker's ", kAxes[axis], " axis");
  if (!result_) return "keep moving";
  if (Score(options_, *result_) > 1.0)
    return "keep moving: " + Sigmas(*result_) + "; target " +
           Text(LargestStd{options_.target_rotation_std, options_.target_translation_std,
                           options_.target_time_shift_std});
  if (last_.size() < kStableSolves)
    return Text("keep moving: ", last_.size(), " of ", kStableSolves, " solves done; ",
                Sigmas(*result_));
  return "keep moving until three solves agree; " + Sigmas(*result_);
}

LiveStatus LiveCalibration::Status(double now) const {
  LiveStatus status;
  status.poses = poses_.Status();
  const auto slower = [](const StreamStatus& a, const StreamStatus& b) {
    return a.rate_hz < b.rate_hz || a.buffered_s < b.buffered_s;
  };
  for (size_t i = 0; i < imus_.size(); ++i) {
    const StreamStatus gyro = imus_[i].gyro.Status(), accel = imus_[i].accel.Status();
    if (i == 0 || slower(gyro, status.gyro)) status.gyro = gyro;
    if (i == 0 || slower(accel, status.accel)) status.accel = accel;
  }
  status.excitation = Excited();
  status.solves = solves_;

  const auto say = [&](Phase phase, const std::string& message) {
    status.phase = phase;
    status.message = message;
    return status;
  };
  if (IsFrozen()) return say(Phase::kSaved, frozen_);
  const double noticed = now - notice_time_;
  if (!notice_.empty() && noticed >= 0.0 && noticed < kNoticeSpan)
    return say(Phase::kDegraded, notice_);
  if (const std::string missing = MissingStreams(); !missing.empty())
    return say(Phase::kWaiting, "waiting for " + missing);
  if (const std::string lost = LostStreams(now); !lost.empty()) return say(Phase::kDegraded, lost);
  if (IsConverged()) return say(Phase::kConverged, Sigmas(*result_) + "; call save to keep it");
  if (is_solving_) return say(Phase::kSolving, Advice());
  return say(Phase::kCollecting, Advice());
}

}  // namespace imu_pose_calib
