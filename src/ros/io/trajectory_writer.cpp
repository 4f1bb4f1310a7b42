#include "imu_pose_calib/ros/io/trajectory_writer.h"

#include <nav_msgs/Path.h>
#include <rosbag/bag.h>
#include <std_msgs/Bool.h>
#include <std_msgs/String.h>
#include <tf2_msgs/TFMessage.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <memory>
#include <set>

#include "imu_pose_calib/core/base/dense.h"
#include "imu_pose_calib/core/base/so3.h"
#include "imu_pose_calib/ros/io/conversions.h"
#include "imu_pose_calib/ros/io/tables.h"
#include "imu_pose_calib/ros/io/text.h"

namespace imu_pose_calib {
namespace {

/// In the sensor.yaml of a folder that may be written again.
const char kAuthor[] = "comment: ground truth by imu_pose_calib";
const char kTruth[] = "state_groundtruth_estimate0";

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
      if (!was_carried) count.runs.push_back({instant.stamp_ns, 0});
      count.runs.back().last_ns = instant.stamp_ns;
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

/// The states that the IMU alone has carried, as comments.
std::string Carried(const TrajectoryCount& count) {
  std::string text;
  for (const TrajectoryCount::Run& run : count.runs)
    text += "# by the imu alone, no poses: " + SecondsText(run.first_ns) + " to " +
            SecondsText(run.last_ns) + "\n";
  return text;
}

std::string SensorYaml(const OutputFiles& outputs, const std::string& type,
                       const std::string& rest) {
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

std::string ImuSensorYaml(const TrajectoryOutput& output, const OutputFiles& outputs) {
  const auto line = [](const char* key, double value, const char* unit) {
    return key + (": " + YamlNumber(value)) + "  # " + unit + "\n";
  };
  const double root = std::sqrt(output.imu_rate_hz);
  return SensorYaml(
      outputs, "imu",
      line("rate_hz", output.imu_rate_hz, "Hz") +
          "\n# White noise as the residuals of the calibration show it; random walk as it "
          "assumed.\n" +
          line("gyroscope_noise_density", output.noise.gyro / root, "[ rad / s / sqrt(Hz) ]") +
          line("gyroscope_random_walk", output.gyro_bias_walk, "[ rad / s^2 / sqrt(Hz) ]") +
          line("accelerometer_noise_density", output.noise.accel / root, "[ m / s^2 / sqrt(Hz) ]") +
          line("accelerometer_random_walk", output.accel_bias_walk, "[ m / s^3 / sqrt(Hz) ]"));
}

std::filesystem::path Mav0(const std::string& folder) {
  return std::filesystem::path(folder) / "mav0";
}

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
  const std::filesystem::path truth = Mav0(path) / kTruth, imu = Mav0(path) / "imu0";
  outputs->MakeFolder(truth);
  outputs->MakeFolder(imu);
  // First what tells that the folder is ours.
  outputs->Write(truth / "sensor.yaml", SensorYaml(*outputs, "visual-inertial", ""));
  TextTable sigmas(kSigmaHeader, ',', kDigits), samples(kAslImuHeader, ',', kDigits);
  TrajectoryCount count =
      WriteEuroc(truth / "data.csv", output, output.has_covariance ? &sigmas : nullptr, outputs);
  if (output.has_covariance)
    outputs->Write(truth / "sigma.csv", sigmas.text());
  else
    outputs->Remove(truth / "sigma.csv");  // of an earlier run
  for (const ImuTrack::Sample& s : output.samples())
    samples.AddRow(std::to_string(s.stamp_ns), s.gyro, s.accel);
  outputs->Write(imu / "sensor.yaml", ImuSensorYaml(output, *outputs));
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
  outputs->Write(path, Origin(*outputs) + Carried(count) + (with_covariance ? kOvEvalHeader : "") +
                           table.text());
  return count;
}

// --- Bag ---

/// Between the poses of the path, which is there to be looked at.
constexpr int64_t kPathPeriodNs = 50'000'000;

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
  int64_t next_ns = 0;
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

    if (!track.poses.empty() && stamp_ns < next_ns) return;
    next_ns = stamp_ns + kPathPeriodNs;
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
    throw InputError("trajectory '" + path + "' cannot be written: " + error.what());
  }
}

}  // namespace

TrajectoryFormat ParseTrajectoryFormat(const std::string& name, const std::string& path) {
  std::error_code ignored;
  if (name.empty() && std::filesystem::is_directory(path, ignored)) return TrajectoryFormat::kAsl;
  const std::string suffix = std::filesystem::path(path).extension();
  for (const NamedFormat& format : kFormats)
    if (name.empty() ? format.suffixes.count(suffix) > 0 : name == format.name) return format.value;
  if (name.empty())
    throw InputError("the suffix of trajectory '" + path +
                     "' tells no format: must be .tum, .txt, .csv, .bag or none for a folder; or "
                     "give trajectory_format");
  throw InputError("trajectory_format '" + name +
                   "' is unknown; must be tum, ov_eval, euroc, asl or bag");
}

std::vector<std::string> TrajectoryFiles(const std::string& path, TrajectoryFormat format) {
  if (format != TrajectoryFormat::kAsl) return {path};
  const std::filesystem::path truth = Mav0(path) / kTruth, imu = Mav0(path) / "imu0";
  return {truth / "data.csv", truth / "sigma.csv", truth / "sensor.yaml", imu / "data.csv",
          imu / "sensor.yaml"};
}

void CheckAslFolder(const std::string& path) {
  std::error_code ignored;
  if (!std::filesystem::exists(Mav0(path), ignored)) return;
  std::ifstream file(Mav0(path) / kTruth / "sensor.yaml");
  const std::string text{std::istreambuf_iterator<char>(file), {}};
  if (text.find(kAuthor) == std::string::npos)
    throw InputError("trajectory '" + path +
                     "' holds another dataset (mav0), which would be replaced; choose another");
}

TrajectoryCount WriteTrajectory(const std::string& path, TrajectoryFormat format,
                                const TrajectoryOutput& output, OutputFiles* outputs) {
  if (format == TrajectoryFormat::kAsl) return WriteAsl(path, output, outputs);
  if (format == TrajectoryFormat::kBag) return WriteBag(path, output, outputs);
  if (format != TrajectoryFormat::kEuroc)
    return WriteTum(path, format == TrajectoryFormat::kOvEval, output, outputs);
  TrajectoryCount count = WriteEuroc(path, output, nullptr, outputs);
  // Readers of the dataset's file take its first line for the header, and all others for states.
  count.is_marked = false;
  return count;
}

}  // namespace imu_pose_calib
