#include "imu_pose_calib/ros/offline/ground_truth.h"

#include <algorithm>
#include <filesystem>
#include <memory>

#include "imu_pose_calib/core/ground_truth/imu_track.h"
#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/yaml_text.h"
#include "imu_pose_calib/ros/offline/summary_text.h"

namespace imu_pose_calib {
namespace {

constexpr double kLargestRate = 1e4;    // [Hz]
constexpr double kLongestGap = 3600.0;  // [s]

void CheckNumber(const char* name, double value, double largest) {
  if (!(value >= 0.0 && value <= largest))
    throw InputError(std::string(name) + " = " + YamlNumber(value) + " must be 0 to " +
                     YamlNumber(largest));
}

TrackClock ParseClock(const std::string& name) {
  if (name.empty() || name == "imu") return TrackClock::kImu;
  if (name == "poses") return TrackClock::kPoses;
  throw InputError("trajectory_clock '" + name + "' is unknown; must be imu or poses");
}

/// `path` with `addition` before its suffix.
std::string Insert(const std::string& path, const std::string& addition, TrajectoryFormat format) {
  std::filesystem::path name = path;
  if (!name.has_filename()) name = name.parent_path();  // a slash at the end
  if (addition.empty()) return name;
  const bool has_suffix = format != TrajectoryFormat::kAsl && name.has_extension();
  const std::string suffix = has_suffix ? name.extension().string() : "";
  if (has_suffix) name.replace_extension();
  return name.string() + addition + suffix;
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

}  // namespace

std::vector<TrajectoryTarget> PlanTrajectories(const TrajectoryRequest& request, Method method,
                                               size_t sessions, size_t imus) {
  if (request.path.empty()) {
    if (!request.format.empty() || !request.clock.empty() || request.rate_hz != 0.0)
      throw InputError(
          "trajectory_format, trajectory_clock and trajectory_rate need a file: give trajectory");
    return {};
  }
  const TrajectoryFormat format = ParseTrajectoryFormat(request.format, request.path);
  ParseClock(request.clock);
  CheckNumber("trajectory_rate", request.rate_hz, kLargestRate);
  CheckNumber("trajectory_gaps", request.max_gap_s, kLongestGap);
  if (format == TrajectoryFormat::kOvEval && method != Method::kJoint)
    throw InputError(
        "trajectory_format ov_eval has covariances, which only method joint gives; use it, or tum");
  std::vector<TrajectoryTarget> targets;
  for (size_t s = 0; s < sessions; ++s)
    for (size_t i = 0; i < imus; ++i) {
      const std::string addition = (sessions > 1 ? "_session" + std::to_string(s + 1) : "") +
                                   (imus > 1 ? "_imu" + std::to_string(i) : "");
      targets.push_back({Insert(request.path, addition, format), format, s, i});
    }
  for (const TrajectoryTarget& target : targets) {
    const std::filesystem::path folder = std::filesystem::path(target.path).parent_path();
    std::error_code ignored;
    if (!folder.empty() && !std::filesystem::is_directory(folder, ignored))
      throw InputError("trajectory '" + target.path + "' cannot be written: there is no folder '" +
                       folder.string() + "'");
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

std::vector<std::string> WriteTrajectories(const TrajectoryRequest& request,
                                           const std::vector<TrajectoryTarget>& targets,
                                           const Calibration& result,
                                           const std::vector<RecordingInfo>& infos,
                                           const CalibrationOptions& options,
                                           OutputFiles* outputs) {
  std::vector<std::string> lines;
  std::shared_ptr<const TrajectoryCovariance> covariance;
  if (!targets.empty() && result.method == Method::kJoint)
    covariance = std::make_shared<const TrajectoryCovariance>(result.solution);
  for (const TrajectoryTarget& target : targets) {
    const ImuSession& imu = result.sessions[target.session].imus[target.imu];
    const ImuTrack track(result.solution, target.session, target.imu, covariance,
                         ParseClock(request.clock), request.max_gap_s);
    const RecordingInfo& info = infos[target.session];
    const TrajectoryCount count =
        WriteTrajectory(target.path, target.format,
                        {track.Instants(request.rate_hz), [&](double t) { return track.At(t); },
                         track.has_covariance(), [&] { return track.Samples(); }, info.world_frame,
                         info.imus[target.imu].imu_frame, imu.noise, imu.gyro.rate_hz,
                         options.gyro_bias_walk, options.accel_bias_walk},
                        outputs);
    lines.push_back(target.path + ": " + Describe(count, track.gaps()));
  }
  return lines;
}

}  // namespace imu_pose_calib
