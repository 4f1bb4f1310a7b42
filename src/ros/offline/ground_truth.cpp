#include "imu_pose_calib/ros/offline/ground_truth.h"

#include <nav_msgs/Path.h>
#include <rosbag/bag.h>
#include <std_msgs/Bool.h>
#include <std_msgs/String.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <boost/algorithm/string/erase.hpp>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <memory>
#include <set>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/core/pose_sensor/sensor_track.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/tables.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

namespace fs = std::filesystem;

/// In the sensor.yaml of a folder that may be written again.
const char kAuthor[] = "comment: ground truth by imu_pose_calib";
const char kTruth[] = "state_groundtruth_estimate0";

/// The header of the original, with its blanks: readers compare the cells.
const char kEurocHeader[] =
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
    "q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], "
    "b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], "
    "b_a_RS_S_z [m s^-2]\n";
const char kSigmaHeader[] =
    "#timestamp [ns],p_x [m],p_y [m],p_z [m],theta_x [rad],theta_y [rad],theta_z [rad],"
    "v_x [m s^-1],v_y [m s^-1],v_z [m s^-1],b_w_x [rad s^-1],b_w_y [rad s^-1],b_w_z [rad s^-1],"
    "b_a_x [m s^-2],b_a_y [m s^-2],b_a_z [m s^-2],carried []\n";
const char kOvEvalHeader[] =
    "# timestamp(s) tx ty tz qx qy qz qw Pr11 Pr12 Pr13 Pr22 Pr23 Pr33 "
    "Pt11 Pt12 Pt13 Pt22 Pt23 Pt33\n";

// --- Files ---

/// Visits the states that there are, in order; the sign of the quaternion does not jump.
template <typename Visit>
TrajectoryCount ForEachState(const TrajectoryOutput& output, Visit visit) {
  TrajectoryCount count;
  Eigen::Quaterniond last = Eigen::Quaterniond::Identity();
  bool was_carried = false;
  for (const ImuTrack::Instant& instant : output.instants) {
    auto state = output.state(instant.t);
    if (!state) continue;
    if (state->q_WB.dot(last) < 0.0) state->q_WB.coeffs() *= -1.0;
    last = state->q_WB;
    visit(instant.stamp_ns, *state);
    ++count.states;
    if (state->is_carried) {
      ++count.carried;
      if (!was_carried) count.runs.emplace_back(instant.stamp_ns, 0);
      count.runs.back().second = instant.stamp_ns;
    }
    was_carried = state->is_carried;
  }
  return count;
}

constexpr int kDigits = 12;  ///< of the numbers in a text

/// Row by row.
Vector6d UpperTriangle(const Eigen::Matrix3d& C) {
  Vector6d upper;
  upper << C(0, 0), C(0, 1), C(0, 2), C(1, 1), C(1, 2), C(2, 2);
  return upper;
}

/// What every file says of its origin.
std::string Origin(const OutputFiles& outputs) {
  return std::string("# imu_pose_calib ") + kVersion + ", run_id: " + outputs.run_id() + "\n";
}

/// `rest`: what is of a kind of sensor alone.
std::string SensorYaml(const OutputFiles& outputs, const std::string& type,
                       const std::string& rest = "") {
  return "%YAML:1.0\n" + Origin(outputs) + "sensor_type: " + type + "\n" + kAuthor + R"(

# Sensor S in the body B, x_B = T_BS x_S: B is the IMU.
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.0,
         0.0, 1.0, 0.0, 0.0,
         0.0, 0.0, 1.0, 0.0,
         0.0, 0.0, 0.0, 1.0]
)" + rest;
}

std::string NoiseYaml(const TrajectoryOutput& output) {
  const double root = std::sqrt(output.imu_rate_hz);
  const auto line = [](const std::string& key, double value, const std::string& unit) {
    return key + ": " + YamlNumber(value) + "  # " + unit + "\n";
  };
  return line("rate_hz", output.imu_rate_hz, "Hz") +
         "\n# White noise as the residuals of the calibration show it; random walk as it "
         "assumed.\n" +
         line("gyroscope_noise_density", output.noise.gyro / root, "[ rad / s / sqrt(Hz) ]") +
         line("gyroscope_random_walk", output.gyro_bias_walk, "[ rad / s^2 / sqrt(Hz) ]") +
         line("accelerometer_noise_density", output.noise.accel / root, "[ m / s^2 / sqrt(Hz) ]") +
         line("accelerometer_random_walk", output.accel_bias_walk, "[ m / s^3 / sqrt(Hz) ]");
}

fs::path Mav0(const std::string& folder) { return fs::path(folder) / "mav0"; }

/// `sigmas` gets those of the states, if it is not null.
TrajectoryCount WriteEuroc(const std::string& path, const TrajectoryOutput& output,
                           TextTable* sigmas, OutputFiles* outputs) {
  TextTable states(kEurocHeader, ',', kDigits);
  TrajectoryCount count = ForEachState(output, [&](int64_t stamp_ns, const ImuState& x) {
    const std::string stamp = std::to_string(stamp_ns);
    states.AddRow(stamp, x.p_WB, x.q_WB.w(), x.q_WB.vec(), x.v_W, x.biases.gyro, x.biases.accel);
    if (sigmas == nullptr) return;
    const Eigen::VectorXd sigma = x.covariance.diagonal().cwiseMax(0.0).cwiseSqrt();
    const Eigen::VectorXd bias_sigma = x.bias_covariance.diagonal().cwiseMax(0.0).cwiseSqrt();
    sigmas->AddRow(stamp, sigma.segment<3>(3), sigma.segment<3>(0), sigma.segment<3>(9), bias_sigma,
                   x.is_carried ? 1.0 : 0.0);
  });
  outputs->Write(path, states.text());
  return count;
}

TrajectoryCount WriteAsl(const std::string& path, const TrajectoryOutput& output,
                         OutputFiles* outputs) {
  const fs::path truth = Mav0(path) / kTruth, imu = Mav0(path) / "imu0";
  outputs->MakeFolder(truth);
  outputs->MakeFolder(imu);
  // First what tells that the folder is ours.
  outputs->Write(truth / "sensor.yaml", SensorYaml(*outputs, "visual-inertial"));
  TextTable sigmas(kSigmaHeader, ',', kDigits), samples(kAslImuHeader, ',', kDigits);
  TrajectoryCount count =
      WriteEuroc(truth / "data.csv", output, output.has_covariance ? &sigmas : nullptr, outputs);
  if (output.has_covariance)
    outputs->Write(truth / "sigma.csv", sigmas.text());
  else
    outputs->Remove(truth / "sigma.csv");  // of an earlier run
  for (const ImuTrack::Sample& s : output.samples())
    samples.AddRow(std::to_string(s.stamp_ns), s.gyro, s.accel);
  outputs->Write(imu / "sensor.yaml", SensorYaml(*outputs, "imu", NoiseYaml(output)));
  outputs->Write(imu / "data.csv", samples.text());
  return count;
}

TrajectoryCount WriteTum(const std::string& path, bool with_covariance,
                         const TrajectoryOutput& output, OutputFiles* outputs) {
  TextTable table("", ' ', kDigits);
  TrajectoryCount count = ForEachState(output, [&](int64_t stamp_ns, const ImuState& x) {
    const std::string stamp = SecondsText(stamp_ns);
    if (!with_covariance) return table.AddRow(stamp, x.p_WB, x.q_WB.coeffs());
    table.AddRow(stamp, x.p_WB, x.q_WB.coeffs(), UpperTriangle(x.covariance.block<3, 3>(0, 0)),
                 UpperTriangle(x.covariance.block<3, 3>(3, 3)));
  });
  std::string head = Origin(*outputs);
  for (const auto& [first_ns, last_ns] : count.runs)
    head += "# by the imu alone, no poses: " + SecondsText(first_ns) + " to " +
            SecondsText(last_ns) + "\n";
  outputs->Write(path, head + (with_covariance ? kOvEvalHeader : "") + table.text());
  return count;
}

// --- Bag ---

/// Between the poses of the path, which is there to be looked at.
const ros::Duration kPathPeriod(0.05);

/// Row by row, as messages have it.
using Covariance = Eigen::Map<Eigen::Matrix<double, 6, 6, Eigen::RowMajor>>;

nav_msgs::Odometry ToOdometry(const std_msgs::Header& header, const std::string& child,
                              const ImuState& x) {
  const Eigen::Matrix3d R = x.q_WB.toRotationMatrix();
  const Eigen::Vector3d v_I = R.transpose() * x.v_W;
  nav_msgs::Odometry msg;
  msg.header = header;
  msg.child_frame_id = child;
  msg.pose.pose = ToPoseMsg({x.q_WB, x.p_WB});
  msg.twist.twist.linear = ToVector3Msg(v_I);
  msg.twist.twist.angular = ToVector3Msg(x.omega_B);
  // Pose: position and rotation about the axes of W. Twist: both in I.
  Eigen::Matrix<double, 6, 12> pose = Eigen::Matrix<double, 6, 12>::Zero(), twist = pose;
  pose.block<3, 3>(0, 3).setIdentity();
  pose.block<3, 3>(3, 0) = R;
  twist.block<3, 3>(0, 0) = Hat(v_I);
  twist.block<3, 3>(0, 9) = R.transpose();
  twist.block<3, 3>(3, 6).setIdentity();
  Covariance(msg.pose.covariance.data()) = Propagate(pose, x.covariance);
  Covariance(msg.twist.covariance.data()) = Propagate(twist, x.covariance);
  return msg;
}

TrajectoryCount FillBag(const TrajectoryOutput& output, const std::string& run_id,
                        rosbag::Bag* bag) {
  const std::string child = output.imu_frame + "_ground_truth";
  nav_msgs::Path track;
  track.header.frame_id = output.world_frame;
  std::optional<bool> last_carried;
  TrajectoryCount count = ForEachState(output, [&](int64_t stamp_ns, const ImuState& x) {
    const ros::Time stamp = std::max(ros::TIME_MIN, FromNanoseconds(stamp_ns));
    const std_msgs::Header header = MakeHeader(stamp, output.world_frame);
    const nav_msgs::Odometry odometry = ToOdometry(header, child, x);
    bag->write("/ground_truth/odometry", stamp, odometry);
    if (last_carried != x.is_carried) {
      std_msgs::Bool carried;
      carried.data = x.is_carried;
      bag->write("/ground_truth/by_imu_alone", stamp, carried);
      last_carried = x.is_carried;
    }

    tf2_msgs::TFMessage tf;
    tf.transforms = {ToTransformStamped(header, child, {x.q_WB, x.p_WB})};
    bag->write("/tf", stamp, tf);

    if (!track.poses.empty() && stamp < track.poses.back().header.stamp + kPathPeriod) return;
    track.poses.emplace_back();
    track.poses.back().header = header;
    track.poses.back().pose = odometry.pose.pose;
  });
  // At the start, so that whoever plays it sees the whole.
  if (!track.poses.empty()) {
    track.header.stamp = track.poses.front().header.stamp;
    bag->write("/ground_truth/path", track.header.stamp, track);
    std_msgs::String run;
    run.data = run_id;
    bag->write("/ground_truth/run_id", track.header.stamp, run);
  }
  bag->close();
  return count;
}

TrajectoryCount WriteBag(const std::string& path, const TrajectoryOutput& output,
                         OutputFiles* outputs) {
  std::unique_ptr<rosbag::Bag> bag;
  try {
    bag = std::make_unique<rosbag::Bag>(outputs->Draft(path), rosbag::bagmode::Write);
    return FillBag(output, outputs->run_id(), bag.get());
  } catch (const rosbag::BagException& error) {
    // On a full disk its destructor, which writes the rest, would end the process: it is kept.
    static auto* unfinished = new std::vector<std::unique_ptr<rosbag::Bag>>;
    unfinished->push_back(std::move(bag));
    Reject("trajectory '", path, "' cannot be written: ", error.what());
  }
}

// --- What is asked for ---

struct NamedFormat {
  TrajectoryFormat value;
  const char* name;
  std::set<std::string> suffixes;  ///< that stand for it
};
const NamedFormat kFormats[] = {{TrajectoryFormat::kAsl, "asl", {""}},
                                {TrajectoryFormat::kTum, "tum", {".tum", ".txt"}},
                                {TrajectoryFormat::kEuroc, "euroc", {".csv"}},
                                {TrajectoryFormat::kBag, "bag", {".bag"}},
                                {TrajectoryFormat::kOvEval, "ov_eval", {}}};

TrajectoryFormat FormatOf(const TrajectoryRequest& request) {
  const std::string &path = request.path, &name = request.format;
  if (name.empty() && IsFolder(path)) return TrajectoryFormat::kAsl;
  const std::string suffix = fs::path(path).extension();
  for (const NamedFormat& format : kFormats)
    if (name.empty() ? format.suffixes.count(suffix) > 0 : name == format.name) return format.value;
  if (name.empty())
    Reject("the suffix of trajectory '", path,
           "' tells no format: must be .tum, .txt, .csv, .bag or none for a folder; or give "
           "trajectory_format");
  Reject("trajectory_format '", name, "' is unknown; must be tum, ov_eval, euroc, asl or bag");
}

constexpr double kLargestRate = 1e4;    // [Hz]
constexpr double kLongestGap = 3600.0;  // [s]

void CheckNumber(const char* name, double value, double largest) {
  if (!(value >= 0.0 && value <= largest))
    Reject(name, " = ", YamlNumber(value), " must be 0 to ", YamlNumber(largest));
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
    Reject("trajectory_frame '", request.frame, "' is no pose sensor of the recording", known);
  if (format == TrajectoryFormat::kEuroc || format == TrajectoryFormat::kAsl)
    Reject(
        "trajectory_format euroc and asl have biases, and a pose sensor has none; must be tum, "
        "ov_eval or bag");
  if (format == TrajectoryFormat::kOvEval && !has_imu)
    Reject("trajectory_format ov_eval has covariances, and there are none without an imu; use tum");
  if (request.clock == "imu")
    Reject("trajectory_clock imu is none of a pose sensor; must be poses, or left out for its own");
  return found;
}

/// `path` with `addition` before its suffix.
std::string Insert(const std::string& path, const std::string& addition, TrajectoryFormat format) {
  fs::path name = path;
  if (!name.has_filename()) name = name.parent_path();  // a slash at the end
  const std::string suffix = format == TrajectoryFormat::kAsl ? "" : name.extension().string();
  return boost::erase_tail_copy(name.string(), static_cast<int>(suffix.size())) + addition + suffix;
}

/// "12000 states, 200 of them by the imu alone in 1 gap of up to 0.50 s". `has_comments`: the file
/// says which.
std::string Describe(const TrajectoryCount& count, const std::vector<TrackGap>& gaps,
                     bool has_comments) {
  const auto gaps_text = [](size_t n) { return std::to_string(n) + (n == 1 ? " gap" : " gaps"); };
  std::string text = std::to_string(count.states) + " states";
  double longest = 0.0, left_out = 0.0;
  size_t carried = 0;
  for (const TrackGap& gap : gaps) {
    const double length = gap.end - gap.begin;
    if (gap.carried.empty()) {
      left_out += length;
    } else {
      ++carried;
      longest = std::max(longest, length);
    }
  }
  if (carried > 0)
    text += Format(", %zu of them by the imu alone in %s of up to %.2f s", count.carried,
                   gaps_text(carried).c_str(), longest);
  if (gaps.size() > carried)
    text += Format(", %s left out (%.1f s)", gaps_text(gaps.size() - carried).c_str(), left_out);
  if (has_comments) return text;
  for (const auto& [first_ns, last_ns] : count.runs)
    text += "\n  by the imu alone, which the format cannot say: " + SecondsText(first_ns) + " to " +
            SecondsText(last_ns);
  return text;
}

/// Writes that of a pose sensor; returns what is to be said of it.
std::string WriteSensor(const TrajectoryTarget& target, const SensorTrack& track, double rate_hz,
                        const RecordingInfo& info, OutputFiles* outputs) {
  const TrajectoryOutput output{track.Instants(rate_hz), [&](double t) { return track.At(t); },
                                track.has_covariance(), info.world_frame,
                                info.pose_sensors[target.place].frame};
  const size_t states = WriteTrajectory(target, output, outputs).states;
  const size_t left_out = output.instants.size() - states;
  return std::to_string(states) + " states" +
         (left_out > 0 ? ", " + std::to_string(left_out) + " in gaps of the poses left out" : "") +
         (output.has_covariance ? "" : ", without sigmas");
}

/// Throws InputError unless a file, or for kAsl a folder of earlier ground truth, can be there.
void CheckPlace(const std::string& path, TrajectoryFormat format) {
  CheckFolderOf("trajectory", path);
  const std::string name = "trajectory '" + path + "' ";
  if (format != TrajectoryFormat::kAsl) {
    if (IsFolder(path)) Reject(name, "is a folder; only asl writes to one");
    return;
  }
  std::error_code ignored;
  if (!IsFolder(path) && fs::exists(path, ignored)) Reject(name, "is a file; asl needs a folder");
  if (!fs::exists(Mav0(path), ignored)) return;
  std::ifstream file(Mav0(path) / kTruth / "sensor.yaml");
  const std::string text{std::istreambuf_iterator<char>(file), {}};
  if (text.find(kAuthor) == std::string::npos)
    Reject(name, "holds another dataset (mav0), which would be replaced; choose another");
}

}  // namespace

TrackClock ParseClock(const std::string& field, const std::string& name) {
  if (name.empty() || name == "imu") return TrackClock::kImu;
  if (name == "poses") return TrackClock::kPoses;
  Reject(field, " '", name, "' is unknown; must be imu or poses");
}

std::vector<TrajectoryTarget> PlanTrajectories(const TrajectoryRequest& request, Method method,
                                               size_t sessions, size_t imus,
                                               const std::vector<PoseSensorInfo>& sensors) {
  if (request.path.empty()) {
    if (!request.format.empty() || !request.clock.empty() || request.rate_hz != 0.0 ||
        !request.frame.empty())
      Reject(
          "trajectory_format, trajectory_clock, trajectory_frame and trajectory_rate need a file: "
          "give trajectory");
    return {};
  }
  const TrajectoryFormat format = FormatOf(request);
  ParseClock("trajectory_clock", request.clock);
  CheckNumber("trajectory_rate", request.rate_hz, kLargestRate);
  CheckNumber("trajectory_gaps", request.max_gap_s, kLongestGap);
  if (format == TrajectoryFormat::kOvEval && method != Method::kJoint)
    Reject(
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
  for (const TrajectoryTarget& target : targets) CheckPlace(target.path, format);
  return targets;
}

std::vector<std::string> TrajectoryTarget::Files() const {
  if (format != TrajectoryFormat::kAsl) return {path};
  const fs::path truth = Mav0(path) / kTruth, imu = Mav0(path) / "imu0";
  return {truth / "data.csv", truth / "sigma.csv", truth / "sensor.yaml", imu / "data.csv",
          imu / "sensor.yaml"};
}

bool TrajectoryTarget::IsIn(const Calibration& result) const {
  if (!is_sensor) return result.sessions[session].imus[place].is_present;
  const PoseSensorCalibration& sensor = result.pose_sensors[place];
  return sensor.status != Status::kDegenerate && sensor.sessions[session].is_present;
}

TrajectoryCount WriteTrajectory(const TrajectoryTarget& target, const TrajectoryOutput& output,
                                OutputFiles* outputs) {
  const std::string& path = target.path;
  const TrajectoryFormat format = target.format;
  if (format == TrajectoryFormat::kAsl) return WriteAsl(path, output, outputs);
  if (format == TrajectoryFormat::kBag) return WriteBag(path, output, outputs);
  if (format == TrajectoryFormat::kEuroc) return WriteEuroc(path, output, nullptr, outputs);
  return WriteTum(path, format == TrajectoryFormat::kOvEval, output, outputs);
}

std::vector<std::string> WriteTrajectories(const TrajectoryRequest& request,
                                           const std::vector<TrajectoryTarget>& targets,
                                           const CalibrationRun& run, OutputFiles* outputs) {
  const Calibration& result = run.result;
  std::vector<std::string> lines;
  const TrackClock clock = ParseClock("trajectory_clock", request.clock);
  for (const TrajectoryTarget& target : targets) {
    const auto& [path, format, session, place, is_sensor] = target;
    const RecordingInfo& info = run.infos[session];
    if (is_sensor) {
      const SensorTrack track(result.solution, session, result.pose_sensors[place], clock);
      lines.push_back(path + ": " + WriteSensor(target, track, request.rate_hz, info, outputs));
      continue;
    }
    const ImuSession& imu = result.sessions[session].imus[place];
    const ImuTrack track(result.solution, session, place, clock, request.max_gap_s);
    const TrajectoryCount count =
        WriteTrajectory(target,
                        {track.Instants(request.rate_hz), [&](double t) { return track.At(t); },
                         track.has_covariance(), info.world_frame, info.imus[place].imu_frame,
                         [&] { return track.Samples(); }, imu.noise, imu.gyro.rate_hz,
                         run.options.gyro_bias_walk, run.options.accel_bias_walk},
                        outputs);
    // Readers of EuRoC's file take its first line for the header, and all others for states.
    const bool has_comments = format != TrajectoryFormat::kEuroc;
    lines.push_back(path + ": " + Describe(count, track.gaps(), has_comments));
  }
  return lines;
}

}  // namespace imu_pose_calib
