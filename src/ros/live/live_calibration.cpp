#include "imu_pose_calib/ros/live/live_calibration.h"

#include <algorithm>
#include <boost/algorithm/string/join.hpp>
#include <cmath>
#include <tuple>

#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/data/conditioning.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/offline/offline.h"

namespace imu_pose_calib {
namespace {

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

constexpr char kAxes[] = "xyz";
/// By the constants of CalibrationStatus.
constexpr const char* kPhases[] = {"waiting",   "collecting", "solving",
                                   "converged", "degraded",   "saved"};

bool IsValid(const PoseSample& pose) {
  return pose.p_WM.allFinite() && pose.q_WM.coeffs().allFinite() && pose.q_WM.norm() > 1e-3;
}

/// Of translation [m], rotation [rad] and time shift [s].
using Sizes = Eigen::Array3d;

Sizes Targets(const LiveOptions& options) {
  return {options.target_translation_std, options.target_rotation_std,
          options.target_time_shift_std};
}

/// Largest sigma over IMUs and axes.
Sizes LargestStd(const Calibration& result) {
  Sizes largest = Sizes::Zero();
  for (size_t i = 0; i < result.imus.size(); ++i) {
    const Vector6d std_dev = result.imus[i].Std();
    largest = largest.max(Sizes(std_dev.head<3>().maxCoeff(), std_dev.tail<3>().maxCoeff(),
                                result.sessions[0].imus[i].time_shift_std));
  }
  return largest;
}

/// Largest ratio of sigma and target.
double Score(const LiveOptions& options, const Calibration& result) {
  return (LargestStd(result) / Targets(options)).maxCoeff();
}

/// Within two targets of each other.
bool Agree(const LiveOptions& options, const Calibration& a, const Calibration& b) {
  for (size_t i = 0; i < a.imus.size(); ++i) {
    const Rigid3 &one = a.imus[i].T_MI, &other = b.imus[i].T_MI;
    const double shift = a.sessions[0].imus[i].time_shift - b.sessions[0].imus[i].time_shift;
    const Sizes apart((one.p - other.p).norm(), one.q.angularDistance(other.q), std::abs(shift));
    if ((apart > 2.0 * Targets(options)).any()) return false;
  }
  return true;
}

/// As people say them.
std::string Text(const Sizes& std_dev) {
  return Format("%.3g mm, %.3g deg, %.3g ms", 1e3 * std_dev[0], 180.0 / M_PI * std_dev[1],
                1e3 * std_dev[2]);
}

/// Six lines as "rotation    x [######----]  60 %".
std::vector<std::string> Bars(const Vector6d& excitation) {
  std::vector<std::string> bars;
  for (int i = 0; i < 6; ++i) {
    std::string bar(10, '-');
    std::fill_n(bar.begin(), static_cast<int>(std::floor(10.0 * excitation[i])), '#');
    bars.push_back(Format("%-11s %c [%s] %3.0f %%", i < 3 ? "rotation" : "translation",
                          kAxes[i % 3], bar.c_str(), 100.0 * excitation[i]));
  }
  return bars;
}

}  // namespace

template <typename Sample>
StreamStatus LiveCalibration::Stream<Sample>::Status() const {
  StreamStatus status;
  status.received = received;
  status.buffered_s = Duration();
  if (samples.empty()) return status;
  const int64_t newest = samples.back().t_ns;
  status.delay_s = arrival - Seconds(newest);
  const auto recent = std::find_if(samples.rbegin(), samples.rend(), [&](const Sample& sample) {
    return Seconds(newest - sample.t_ns) > kRateSpan;
  });
  const auto count = std::distance(samples.rbegin(), recent);
  const double span = Seconds(newest - std::prev(recent)->t_ns);
  if (span > 0.0) status.rate_hz = static_cast<double>(count - 1) / span;
  return status;
}

template <typename Sample>
std::string LiveCalibration::Stream<Sample>::FindJump(const Sample& sample, double now) const {
  if (samples.empty()) return "";
  const double waited = now - arrival, step = Seconds(sample.t_ns - samples.back().t_ns);
  if (waited < -kMaxReorder)
    return Format("time went back by %.3g s (a recording that starts again?)", -waited);
  if (step < -kMaxReorder)
    return Format("the stamps of the %s went back by %.3g s", name.c_str(), -step);
  if (step > kMaxReorder + kMaxPlayRate * std::max(waited, 0.0))
    return Format("the stamps of the %s jumped ahead by %.3g s", name.c_str(), step);
  return "";
}

template <typename Sample>
void LiveCalibration::Stream<Sample>::Trim(double window, double now) {
  while (!samples.empty() &&
         (samples.size() > kMaxSamples || Duration() + (now - arrival) > window))
    samples.pop_front();
}

LiveCalibration::LiveCalibration(const LiveOptions& options, const CalibrationOptions& calibration,
                                 size_t imus, const std::vector<std::string>& pose_sensors)
    : options_(options), calibration_(calibration) {
  for (const auto& [name, member] : kLiveOptions)
    if (const double value = options_.*member; !(value > 0.0 && std::isfinite(value)))
      throw InputError(Format("%s = %.3g must be positive", name, value));
  if (options_.min_duration >= options_.window)
    throw InputError(Format("min_duration = %.3g must be below window = %.3g",
                            options_.min_duration, options_.window));
  for (size_t i = 0; i < imus; ++i) {
    sensors_.push_back({"gyroscope" + OfImu(i, imus), {}});
    sensors_.push_back({"accelerometer" + OfImu(i, imus), {}});
  }
  poses_.push_back({"poses", {}});
  for (const std::string& name : pose_sensors) poses_.push_back({"poses of " + name, {}});
}

// --- Samples ---

/// False when the sample has no stamp and was dropped. `resets`: a jump of the clock starts anew.
template <typename Sample>
bool LiveCalibration::Add(const Sample& sample, double now, Stream<Sample>* stream, bool resets) {
  if (sample.t_ns == 0) {
    ++stream->unstamped;
    return false;
  }
  const std::string jump = stream->FindJump(sample, now);
  if (!jump.empty() && resets && !IsFrozen()) Reset(jump, now);
  if (!jump.empty()) stream->samples.clear();
  ++stream->received;
  stream->arrival = now;
  stream->samples.push_back(sample);
  stream->Trim(options_.window, now);
  return true;
}

bool LiveCalibration::AddPose(const PoseSample& recorded, double now, size_t source) {
  const bool is_marker = source == 0;
  if (!Add(recorded, now, &poses_[source], /*resets=*/is_marker) || !is_marker) return false;
  for (auto& stream : poses_) stream.Trim(options_.window, now);  // also of a sensor that is silent
  const PoseSample pose = ToMarkerPose(calibration_, recorded);
  if (!IsValid(pose) || (known_.pose && SameValue(pose, *known_.pose))) return false;
  known_.pose = pose;
  pose_changed_ = now;
  auto& path = known_.path;
  const auto age = [&](const PoseSample& old) { return Seconds(pose.t_ns - old.t_ns); };
  while (!path.empty() && (age(path.front()) > options_.window || age(path.front()) < 0.0))
    path.pop_front();
  if (path.empty() || std::abs(age(path.back())) > kPathStep) path.push_back(pose);
  return true;
}

void LiveCalibration::AddGyro(const ImuSample& sample, double now, size_t imu) {
  Add(sample, now, &sensors_[2 * imu]);
}

void LiveCalibration::AddAccel(const ImuSample& sample, double now, size_t imu) {
  Add(sample, now, &sensors_[2 * imu + 1]);
}

bool LiveCalibration::LacksSensor() const {
  return std::any_of(poses_.begin() + 1, poses_.end(),
                     [](const auto& stream) { return stream.samples.empty(); });
}

Vector6d LiveCalibration::Excitation() const {
  Vector6d total = Vector6d::Zero();  // squared rates in M, times the time between two poses
  const PoseSample* from = nullptr;
  for (const PoseSample& pose : known_.path) {
    const double dt = from ? Seconds(pose.t_ns - from->t_ns) : kMaxMotionStep;
    if (dt >= 0.0 && dt < kMinMotionStep) continue;
    if (dt >= kMinMotionStep && dt < kMaxMotionStep) {
      const Eigen::Quaterniond q_MW = from->q_WM.normalized().conjugate();
      Vector6d motion;
      motion << Log(Eigen::Quaterniond(q_MW * pose.q_WM.normalized())),
          q_MW * (pose.p_WM - from->p_WM);
      total += motion.cwiseAbs2() / dt;
    }
    from = &pose;
  }
  total.head<3>() /= kEnoughRotation;
  total.tail<3>() /= kEnoughTranslation;
  return total.cwiseMin(1.0);
}

// --- Solves ---

bool LiveCalibration::WantsSolve() const {
  if (IsSolving() || IsFrozen()) return false;
  const Stream<PoseSample>& marker = poses_.front();
  double shortest = marker.Duration();
  for (const auto& stream : sensors_) shortest = std::min(shortest, stream.Duration());
  if (shortest < options_.min_duration) return false;
  // Two axes determine everything; the solve itself tells how well.
  Eigen::Vector3d rotation = Excitation().head<3>();
  std::sort(rotation.data(), rotation.data() + 3);
  if (rotation[1] < 1.0) return false;
  const double fresh = Seconds(marker.samples.back().t_ns - known_.solved_until_ns);
  return fresh >= (IsConverged() ? 0.5 * options_.window : options_.solve_interval);
}

SessionData LiveCalibration::BeginSolve() {
  is_solving_ = true;
  is_stale_ = false;
  const auto copy = [](const auto& stream) {
    return std::vector(stream.samples.begin(), stream.samples.end());
  };
  SessionData data{copy(poses_[0]), {}, {}};
  known_.solved_until_ns = data.poses.empty() ? 0 : data.poses.back().t_ns;
  for (size_t k = 0; k < sensors_.size(); k += 2)
    data.imus.push_back({copy(sensors_[k]), copy(sensors_[k + 1])});
  for (size_t k = 1; k < poses_.size(); ++k) data.pose_sensors.push_back(copy(poses_[k]));
  return data;
}

bool LiveCalibration::EndSolve(const Calibration& result) {
  const bool counts = !IsStale() && !IsFrozen();
  is_solving_ = is_stale_ = false;
  if (!counts) return false;
  ++known_.solves;
  known_.failure = result.IsUsable() ? "" : result.message;
  if (!result.IsUsable()) {
    known_.last.clear();
    return false;
  }
  known_.last.push_back(result);
  if (known_.last.size() > kStableSolves) known_.last.pop_front();
  const double score = Score(options_, result);
  if (score > kMuchWorse * known_.best_score) return false;
  known_.best_score = std::min(known_.best_score, score);
  known_.result = result;
  return true;
}

void LiveCalibration::Reset(const std::string& reason, double now) {
  for (auto& stream : poses_) stream.samples.clear();
  for (auto& stream : sensors_) stream.samples.clear();
  known_ = Knowledge();
  is_stale_ = is_solving_;
  notice_ = reason.empty() ? "" : reason + "; started anew";
  notice_time_ = now;
  on_reset_();
}

// --- Status ---

bool LiveCalibration::IsConverged() const {
  const auto& last = known_.last;
  return known_.result && Score(options_, *known_.result) <= 1.0 && last.size() == kStableSolves &&
         Agree(options_, last[0], last[1]) && Agree(options_, last[1], last[2]) &&
         Agree(options_, last[0], last[2]);
}

std::string LiveCalibration::MissingStreams() const {
  std::vector<std::string> missing;
  const auto check = [&](const auto& stream) {
    if (stream.samples.empty()) missing.push_back(stream.Missing());
  };
  check(poses_[0]);
  for (const auto& stream : sensors_) check(stream);
  return boost::join(missing, ", ");
}

std::string LiveCalibration::LostStreams(double now) const {
  std::vector<std::string> lost;
  const auto check = [&](double since, const std::string& what) {
    const double silent = now - since;
    if (silent > options_.lost_timeout)
      lost.push_back(Format("%s for %.3g s", what.c_str(), std::round(10.0 * silent) / 10.0));
  };
  check(poses_[0].arrival, "no poses");
  if (lost.empty()) check(pose_changed_, "the marker is lost: the poses repeat or are invalid");
  for (const auto& stream : sensors_) check(stream.arrival, "no " + stream.name);
  return boost::join(lost, ", ");
}

/// What is the matter with pose sensors, each note after "; ".
std::string LiveCalibration::SensorNotes(double now) const {
  std::string notes;
  for (size_t k = 1; k < poses_.size(); ++k) {
    const Stream<PoseSample>& stream = poses_[k];
    const double silent = now - stream.arrival;
    if (stream.samples.empty())
      notes += "; no " + stream.Missing();
    else if (silent > options_.lost_timeout)
      notes += Format("; no %s for %.1f s", stream.name.c_str(), silent);
    if (!known_.result) continue;
    const PoseSensorCalibration& sensor = known_.result->pose_sensors[k - 1];
    if (sensor.status != imu_pose_calib::Status::kOk)
      notes += Format("; sensor%zu is %s", k - 1, ToString(sensor.status));
  }
  return notes;
}

std::string LiveCalibration::Advice() const {
  const Vector6d excitation = Excitation();
  Eigen::Index axis = 0;
  if (excitation.head<3>().minCoeff(&axis) < 1.0)
    return Format("rotate about the marker's %c axis", kAxes[axis]);
  if (!known_.failure.empty()) return "no result yet: " + known_.failure;
  if (excitation.tail<3>().minCoeff(&axis) < 1.0)
    return Format("move along the marker's %c axis", kAxes[axis]);
  if (!known_.result) return "keep moving";
  const std::string sigmas = "sigma " + Text(LargestStd(*known_.result));
  if (Score(options_, *known_.result) > 1.0)
    return "keep moving: " + sigmas + "; target " + Text(Targets(options_));
  if (known_.last.size() < kStableSolves)
    return Format("keep moving: %zu of %zu solves done; ", known_.last.size(), kStableSolves) +
           sigmas;
  return "keep moving until three solves agree; " + sigmas;
}

std::array<StreamStatus, 3> LiveCalibration::Streams() const {
  std::array<StreamStatus, 3> streams{poses_[0].Status(), sensors_[0].Status(),
                                      sensors_[1].Status()};
  for (size_t k = 2; k < sensors_.size(); ++k) {
    const StreamStatus other = sensors_[k].Status();
    StreamStatus& slowest = streams[1 + k % 2];
    if (other.rate_hz < slowest.rate_hz || other.buffered_s < slowest.buffered_s) slowest = other;
  }
  return streams;
}

std::pair<uint8_t, std::string> LiveCalibration::PhaseAndMessage(double now) const {
  if (IsFrozen()) return {CalibrationStatus::SAVED, known_.frozen};
  const double noticed = now - notice_time_;
  if (!notice_.empty() && noticed >= 0.0 && noticed < kNoticeSpan)
    return {CalibrationStatus::DEGRADED, notice_};
  if (const std::string missing = MissingStreams(); !missing.empty())
    return {CalibrationStatus::WAITING, "waiting for " + missing};
  if (const std::string lost = LostStreams(now); !lost.empty())
    return {CalibrationStatus::DEGRADED, lost};
  if (IsConverged())
    return {CalibrationStatus::CONVERGED,
            "sigma " + Text(LargestStd(*known_.result)) + "; call save to keep it"};
  return {IsSolving() ? CalibrationStatus::SOLVING : CalibrationStatus::COLLECTING, Advice()};
}

CalibrationStatus LiveCalibration::Status(double now) const {
  CalibrationStatus status;
  std::tie(status.phase, status.message) = PhaseAndMessage(now);
  status.phase_text = kPhases[status.phase];
  if (!IsFrozen()) status.message += SensorNotes(now);
  const auto [poses, gyro, accel] = Streams();
  status.buffered = std::min({poses.buffered_s, gyro.buffered_s, accel.buffered_s});
  status.pose_rate = poses.rate_hz;
  status.gyro_rate = gyro.rate_hz;
  status.accel_rate = accel.rate_hz;
  status.pose_count = poses.received;
  status.gyro_count = gyro.received;
  status.accel_count = accel.received;
  const Vector6d excitation = Excitation();
  status.rotation_excitation = ToVector3Msg(excitation.head<3>());
  status.translation_excitation = ToVector3Msg(excitation.tail<3>());
  status.bars = Bars(excitation);
  status.solves = static_cast<uint32_t>(known_.solves);
  if (!known_.result) return status;
  const Sizes std_dev = LargestStd(*known_.result);
  status.translation_std = std_dev[0];
  status.rotation_std = std_dev[1];
  status.time_shift_std = std_dev[2];
  status.warnings = known_.result->warnings;
  return status;
}

// --- Solves on a thread of their own ---

void LiveSolver::Start() {
  if (live_->IsSolving()) return;
  start_ = std::chrono::steady_clock::now();
  verdict_ = std::async(std::launch::async, [this, data = live_->BeginSolve()]() mutable {
               return Run(std::exchange(data, {}));  // the samples go with the solve
             }).share();
}

double LiveSolver::SolveTime() const {
  const std::chrono::duration<double> time = std::chrono::steady_clock::now() - start_;
  return live_->IsSolving() ? time.count() : 0.0;
}

LiveSolver::Verdict LiveSolver::Calibrate() {
  std::unique_lock<std::mutex> lock(*mutex_);
  // A solve cannot be interrupted, and one of forgotten data is no answer.
  while (live_->IsStale()) {
    const auto stale = verdict_;
    lock.unlock();
    stale.wait();
    lock.lock();
  }
  Start();
  const auto verdict = verdict_;
  lock.unlock();
  return verdict.get();
}

LiveSolver::Verdict LiveSolver::Run(const SessionData& data) {
  Calibration result;
  try {
    result = solve_(data);
  } catch (const std::exception& error) {
    result.message = OneLine(error);
  }
  const std::lock_guard<std::mutex> lock(*mutex_);
  last_solve_time_ = SolveTime();
  const bool is_stale = live_->IsStale();
  if (live_->EndSolve(result)) on_result_();
  if (is_stale) return {false, "the data were forgotten during the solve: call again"};
  if (result.status == Status::kNotRun) return {false, result.message};
  return {result.IsUsable(), std::string(ToString(result.status)) + ": " + result.message};
}

}  // namespace imu_pose_calib
