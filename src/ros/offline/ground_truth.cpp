#include "imu_pose_calib/ros/offline/ground_truth.h"

#include <algorithm>
#include <boost/algorithm/string/erase.hpp>
#include <filesystem>
#include <memory>

#include "imu_pose_calib/core/ground_truth/imu_track.h"
#include "imu_pose_calib/core/pose_sensor/sensor_track.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

constexpr double kLargestRate = 1e4;    // [Hz]
constexpr double kLongestGap = 3600.0;  // [s]

void CheckNumber(const char* name, double value, double largest) {
  if (!(value >= 0.0 && value <= largest))
    throw InputError(std::string(name) + " = " + YamlNumber(value) + " must be 0 to " +
                     YamlNumber(largest));
}

/// Places of the pose sensors whose trajectories are asked for. Throws InputError when there is no
/// such sensor, or the format or clock is none for it.
std::vector<size_t> FindSensors(const TrajectoryRequest& request, TrajectoryFormat format,
                                bool has_imu, const std::vector<PoseSensorInfo>& sensors) {
  if (request.frame.empty() && has_imu) return {};
  std::vector<size_t> found;
  std::string known;
  for (size_t k = 0; k < sensors.size(); ++k) {
    const std::string name = "sensor" + std::to_string(k);
    known += (k == 0 ? "; must be " : ", ") + name + " (" + sensors[k].frame + ")";
    if (request.frame.empty() || request.frame == name || request.frame == sensors[k].frame ||
        (request.frame == "sensor" && sensors.size() == 1))
      found.push_back(k);
  }
  if (found.empty())
    throw InputError("trajectory_frame '" + request.frame + "' is no pose sensor of the recording" +
                     known);
  if (format == TrajectoryFormat::kEuroc || format == TrajectoryFormat::kAsl)
    throw InputError(
        "trajectory_format euroc and asl have biases, and a pose sensor has none; must be tum, "
        "ov_eval or bag");
  if (format == TrajectoryFormat::kOvEval && !has_imu)
    throw InputError(
        "trajectory_format ov_eval has covariances, and there are none without an imu; use tum");
  if (request.clock == "imu")
    throw InputError(
        "trajectory_clock imu is none of a pose sensor; must be poses, or left out for its own");
  return found;
}

/// `path` with `addition` before its suffix.
std::string Insert(const std::string& path, const std::string& addition, TrajectoryFormat format) {
  std::filesystem::path name = path;
  if (!name.has_filename()) name = name.parent_path();  // a slash at the end
  const std::string suffix = format == TrajectoryFormat::kAsl ? "" : name.extension().string();
  return boost::erase_tail_copy(name.string(), static_cast<int>(suffix.size())) + addition + suffix;
}

std::string Gaps(size_t count) { return std::to_string(count) + (count == 1 ? " gap" : " gaps"); }

/// "12000 states, 200 of them across gaps".
std::string Describe(const TrajectoryCount& count, const std::vector<TrackGap>& gaps) {
  std::string text = std::to_string(count.states) + " states";
  double longest = 0.0, left_out = 0.0;
  size_t carried = 0;
  for (const TrackGap& gap : gaps) {
    if (!gap.carried.empty()) {
      ++carried;
      longest = std::max(longest, gap.end - gap.begin);
    } else {
      left_out += gap.end - gap.begin;
    }
  }
  if (carried > 0)
    text += Format(", %zu of them by the imu alone in %s of up to %.2f s", count.carried,
                   Gaps(carried).c_str(), longest);
  if (gaps.size() > carried)
    text += Format(", %s left out (%.1f s)", Gaps(gaps.size() - carried).c_str(), left_out);
  if (count.is_marked) return text;
  for (const TrajectoryCount::Run& run : count.runs)
    text += "\n  by the imu alone, which the format cannot say: " + SecondsText(run.first_ns) +
            " to " + SecondsText(run.last_ns);
  return text;
}

/// Writes that of a pose sensor; returns what is to be said of it.
std::string WriteSensor(const TrajectoryTarget& target, const SensorTrack& track, double rate_hz,
                        const RecordingInfo& info, OutputFiles* outputs) {
  const TrajectoryOutput output{track.Instants(rate_hz), [&](double t) { return track.At(t); },
                                track.has_covariance(), info.world_frame,
                                info.pose_sensors[target.place].frame};
  const size_t states = WriteTrajectory(target.path, target.format, output, outputs).states;
  const size_t left_out = output.instants.size() - states;
  return std::to_string(states) + " states" +
         (left_out > 0 ? ", " + std::to_string(left_out) + " in gaps of the poses left out" : "") +
         (output.has_covariance ? "" : ", without sigmas");
}

}  // namespace

TrackClock ParseClock(const std::string& field, const std::string& name) {
  if (name.empty() || name == "imu") return TrackClock::kImu;
  if (name == "poses") return TrackClock::kPoses;
  throw InputError(field + " '" + name + "' is unknown; must be imu or poses");
}

std::vector<TrajectoryTarget> PlanTrajectories(const TrajectoryRequest& request, Method method,
                                               size_t sessions, size_t imus,
                                               const std::vector<PoseSensorInfo>& sensors) {
  if (request.path.empty()) {
    if (!request.format.empty() || !request.clock.empty() || request.rate_hz != 0.0 ||
        !request.frame.empty())
      throw InputError(
          "trajectory_format, trajectory_clock, trajectory_frame and trajectory_rate need a file: "
          "give trajectory");
    return {};
  }
  const TrajectoryFormat format = ParseTrajectoryFormat(request.format, request.path);
  ParseClock("trajectory_clock", request.clock);
  CheckNumber("trajectory_rate", request.rate_hz, kLargestRate);
  CheckNumber("trajectory_gaps", request.max_gap_s, kLongestGap);
  if (format == TrajectoryFormat::kOvEval && method != Method::kJoint)
    throw InputError(
        "trajectory_format ov_eval has covariances, which only method joint gives; use it, or tum");
  std::vector<size_t> places = FindSensors(request, format, imus > 0, sensors);
  const bool is_sensor = !places.empty();
  for (size_t i = 0; i < imus && !is_sensor; ++i) places.push_back(i);
  std::vector<TrajectoryTarget> targets;
  for (size_t s = 0; s < sessions; ++s)
    for (const size_t place : places) {
      const std::string name = (is_sensor ? "_sensor" : "_imu") + std::to_string(place);
      const std::string addition = (sessions > 1 ? "_session" + std::to_string(s + 1) : "") +
                                   (places.size() > 1 ? name : "");
      targets.push_back({Insert(request.path, addition, format), format, s, place, is_sensor});
    }
  for (const TrajectoryTarget& target : targets) {
    CheckFolderOf("trajectory", target.path);
    std::error_code ignored;
    const bool is_folder = std::filesystem::is_directory(target.path, ignored);
    if (format == TrajectoryFormat::kAsl) {
      if (!is_folder && std::filesystem::exists(target.path, ignored))
        throw InputError("trajectory '" + target.path + "' is a file; asl needs a folder");
      CheckAslFolder(target.path);
    } else if (is_folder) {
      throw InputError("trajectory '" + target.path + "' is a folder; only asl writes to one");
    }
  }
  return targets;
}

bool IsThere(const TrajectoryTarget& target, const Calibration& result) {
  if (!target.is_sensor) return result.sessions[target.session].imus[target.place].is_present;
  const PoseSensorCalibration& sensor = result.pose_sensors[target.place];
  return sensor.status != Status::kDegenerate && sensor.sessions[target.session].is_present;
}

std::vector<std::string> WriteTrajectories(const TrajectoryRequest& request,
                                           const std::vector<TrajectoryTarget>& targets,
                                           const CalibrationRun& run, OutputFiles* outputs) {
  const Calibration& result = run.result;
  std::vector<std::string> lines;
  std::shared_ptr<const TrajectoryCovariance> covariance;
  if (!targets.empty() && !result.solution->splines.empty())
    covariance = std::make_shared<const TrajectoryCovariance>(result.solution);
  const TrackClock clock = ParseClock("trajectory_clock", request.clock);
  for (const TrajectoryTarget& target : targets) {
    const RecordingInfo& info = run.infos[target.session];
    if (target.is_sensor) {
      const SensorTrack track(result.solution, target.session, result.pose_sensors[target.place],
                              covariance, clock);
      lines.push_back(target.path + ": " +
                      WriteSensor(target, track, request.rate_hz, info, outputs));
      continue;
    }
    const ImuSession& imu = result.sessions[target.session].imus[target.place];
    const ImuTrack track(result.solution, target.session, target.place, covariance, clock,
                         request.max_gap_s);
    const TrajectoryCount count = WriteTrajectory(
        target.path, target.format,
        {track.Instants(request.rate_hz), [&](double t) { return track.At(t); },
         track.has_covariance(), info.world_frame, info.imus[target.place].imu_frame,
         [&] { return track.Samples(); }, imu.noise, imu.gyro.rate_hz, run.options.gyro_bias_walk,
         run.options.accel_bias_walk},
        outputs);
    lines.push_back(target.path + ": " + Describe(count, track.gaps()));
  }
  return lines;
}

}  // namespace imu_pose_calib
