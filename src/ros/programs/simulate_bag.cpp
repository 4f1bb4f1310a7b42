// Writes a simulated recording and its truth.

#include <boost/algorithm/string.hpp>
#include <cmath>
#include <map>
#include <optional>
#include <utility>

#include "imu_pose_calib/ros/io/output_files.h"
#include "imu_pose_calib/ros/io/text.h"
#include "imu_pose_calib/ros/offline/command_line.h"
#include "imu_pose_calib/ros/offline/ground_truth.h"
#include "imu_pose_calib/ros/simulated/lidar.h"
#include "imu_pose_calib/ros/simulated/recording_writer.h"
#include "imu_pose_calib/simulation/simulator.h"

namespace imu_pose_calib {
namespace {

namespace po = boost::program_options;

/// Those of --format that are bags: of ROS 1, or which of ROS 2.
const std::map<std::string, std::optional<Ros2Format>> kBagFormats = {
    {"bag", std::nullopt}, {"mcap", Ros2Format::kMcap}, {"db3", Ros2Format::kSqlite}};

struct CommandLine {
  std::string output, motion = "handheld", format = "bag", truth;
  SimulatorOptions simulator;
  double imu_rate_hz = 200.0;
  size_t imus = 1;
  BagFormat bag;
  bool pose_sensor = false, lidar = false;
};

po::options_description Describe(CommandLine* line) {
  SimulatorOptions& simulator = line->simulator;
  po::options_description options("Options");
  auto add = options.add_options();
  add("motion", ValueOrDefault(&line->motion, "TEXT"),
      "handheld, tumble, arm, drone, planar, hinge or static");
  add("duration", ValueOrDefault(&simulator.duration_s, "S"), "length");
  add("seed", ValueOrDefault(&simulator.seed, "N"), "motion, noise and biases follow from it");
  add("pose-rate", ValueOrDefault(&simulator.pose_rate_hz, "HZ"), "poses");
  add("imu-rate", ValueOrDefault(&line->imu_rate_hz, "HZ"), "gyroscope and accelerometer");
  add("imus", ValueOrDefault(&line->imus, "N"),
      "on the body, with clocks of their own: /imu, /imu1, ...");
  add("position-std", ValueOrDefault(&simulator.position_std, "M"), "noise per axis");
  add("rotation-std", ValueOrDefault(&simulator.rotation_std, "RAD"), "noise per axis");
  add("gyro-std", ValueOrDefault(&simulator.gyro_std, "RAD/S"), "noise per sample");
  add("accel-std", ValueOrDefault(&simulator.accel_std, "M/S^2"), "noise per sample");
  add("time-shift", ValueOrDefault(&simulator.time_shift_s, "S"), "t_pose = t_imu + time_shift");
  add("accel-delay", ValueOrDefault(&simulator.accel_delay_s, "S"),
      "t_pose = t_accel + time_shift - accel_delay");
  add("format", ValueOrDefault(&line->format, "TEXT"),
      "bag; mcap, db3: of ROS 2; asl: folder OUTPUT/ like EuRoC; text: OUTPUT.poses.txt and "
      "OUTPUT.imu.csv");
  add("split", po::bool_switch(&line->bag.split_imu),
      "gyroscope and accelerometer on two topics, or in two files");
  add("pose-type", ValueOrDefault(&line->bag.pose_type, "TEXT"),
      "PoseStamped, TransformStamped, PoseWithCovarianceStamped, Odometry or tf (world to marker "
      "through six joints)");
  add("imu-type", ValueOrDefault(&line->bag.imu_type, "TEXT"),
      "Imu or Vector3Stamped (/imu/gyro and /imu/accel)");
  add("truth", Value(&line->truth, "FILE"),
      "where the IMU truly was, on its clock: .tum, .csv (EuRoC), .bag, or a folder (ASL)");
  add("pose-sensor", po::bool_switch(&line->pose_sensor),
      "poses of a camera on the body in a world of its own, /pose_sensor");
  add("lidar", po::bool_switch(&line->lidar),
      "a spinning lidar in a room, /points, on the IMU's clock; where it sits: OUTPUT.lidar.yaml");
  po::options_description effects("Effects that real recordings have; 0: none");
  for (const Effect& effect : Effects(&simulator))
    effects.add_options()(effect.name, ValueOrDefault(effect.strength, effect.unit),
                          (effect.text + Format("; usual: %g", effect.usual)).c_str());
  options.add(effects);
  return options;
}

void Check(const std::string& option, double value, bool is_good, const std::string& condition) {
  if (!is_good) Reject("--", option, " = ", YamlNumber(value), " ", condition);
}

/// Completes and checks what the command line has filled in.
SimulatorOptions Simulator(const CommandLine& line) {
  SimulatorOptions simulator = line.simulator;
  simulator.motion = ParseMotion(line.motion);
  simulator.gyro_rate_hz = simulator.accel_rate_hz = line.imu_rate_hz;
  if (line.pose_sensor) simulator.pose_sensors.emplace_back();
  for (const auto& [option, value] : {std::pair{"duration", simulator.duration_s},
                                      {"pose-rate", simulator.pose_rate_hz},
                                      {"imu-rate", line.imu_rate_hz}})
    Check(option, value, value > 0.0, "must be positive");
  Check("time-shift", simulator.time_shift_s, std::abs(simulator.time_shift_s) <= 1e9,
        "does not fit the stamps; must be within 1e9 s");
  for (const auto& [option, value] : {std::pair{"position-std", simulator.position_std},
                                      {"rotation-std", simulator.rotation_std},
                                      {"gyro-std", simulator.gyro_std},
                                      {"accel-std", simulator.accel_std}})
    Check(option, value, value >= 0.0, "must not be negative");
  for (const Effect& effect : Effects(&simulator)) {
    const double strength = *effect.strength;
    Check(effect.name, strength, strength >= effect.least && strength <= effect.most,
          "must be within " + YamlNumber(effect.least) + " and " + YamlNumber(effect.most));
  }
  return simulator;
}

/// The output path without the ending of a bag, to which other endings are added.
std::string Prefix(const CommandLine& line, bool is_bag) {
  const std::string &format = line.format, ending = "." + format;
  if (format == "asl" && line.bag.split_imu)
    throw InputError("--split does not go with the format asl, which has both in one file");
  if (format == "asl" || format == "text") {
    std::string path = boost::trim_right_copy_if(line.output, boost::is_any_of("/"));
    if (path.empty()) throw InputError("give the path to write; see simulate_bag --help");
    return path;
  }
  if (!is_bag) Reject("format '", format, "' is unknown; must be bag, mcap, db3, asl or text");
  if (line.output == ending || !boost::ends_with(line.output, ending))
    Reject("give the path of the bag to write, ending in ", ending, "; see simulate_bag --help");
  return boost::erase_tail_copy(line.output, static_cast<int>(ending.size()));
}

/// The true trajectory of one IMU at the rate of its gyroscope, without its delay; biases are those
/// at the start.
void WriteTruth(const TrajectoryTarget& target, const SimulatorOptions& options, const ImuData& imu,
                OutputFiles* outputs) {
  const TrueTrajectory trajectory(options);
  const auto state = [&](double t) {
    const TrueState marker = trajectory.At(t);
    const Rigid3& T_MI = options.T_MI;
    ImuState state;
    state.q_WB = Eigen::Quaterniond(marker.R_WM) * T_MI.q;
    state.p_WB = marker.p_WM + marker.R_WM * T_MI.p;
    state.omega_B = T_MI.q.conjugate() * marker.omega_M;
    state.v_W = marker.v_W + marker.R_WM * marker.omega_M.cross(T_MI.p);
    state.biases = {options.gyro_bias, options.accel_bias};
    return state;
  };
  SimulatorOptions exact = options;  // but for the clock and the filters of the IMU
  exact.effects.pose_stream = {};
  const double delay = TrueClock(exact).time_shift_s - options.time_shift_s -
                       Wander(exact, 0.5 * options.duration_s);
  std::vector<ImuTrack::Instant> instants;
  for (int k = 0; k < options.duration_s * options.gyro_rate_hz; ++k) {
    const double s = k / options.gyro_rate_hz;  // since the first
    instants.push_back({options.ImuStart() + std::llround(1e9 * s),
                        options.PoseTime(s) + delay + Wander(exact, s)});
  }
  TrajectoryOutput output{instants, state, false, "world", "imu"};
  output.samples = [&imu] {  // both sensors have the same stamps
    std::vector<ImuTrack::Sample> both;
    for (size_t k = 0; k < imu.gyro.size(); ++k)
      both.push_back({imu.gyro[k].t_ns, imu.gyro[k].value, imu.accel[k].value});
    return both;
  };
  output.noise = {options.gyro_std, options.accel_std};
  output.imu_rate_hz = options.gyro_rate_hz;
  output.gyro_bias_walk = options.gyro_bias_walk;
  output.accel_bias_walk = options.accel_bias_walk;
  WriteTrajectory(target, output, outputs);
}

constexpr char kUsage[] =
    "Usage: simulate_bag OUTPUT.bag [options]\n"
    "       simulate_bag OUTPUT.mcap --format mcap [options]      bag of ROS 2, or db3\n"
    "       simulate_bag OUTPUT --format asl|text [options]\n\n"
    "Writes a simulated recording and, beside it, its truth: OUTPUT.truth.yaml.\n\n";

void Run(int argc, char** argv) {
  CommandLine line;
  if (!ParseOrHelp(argc, argv, kUsage, Describe(&line), "", Unnamed{"output", Value(&line.output)}))
    return;
  const auto bag_format = kBagFormats.find(line.format);
  const bool is_bag = bag_format != kBagFormats.end();
  const std::string prefix = Prefix(line, is_bag);
  const SimulatorOptions simulator = Simulator(line);
  if (line.imus < 1 || line.imus > 9 || (line.imus > 1 && !is_bag))
    Reject("--imus = ", line.imus, " must be 1 to 9, and 1 but for a bag");
  if (line.lidar && line.format != "bag")
    Reject("--lidar does not go with the format ", line.format, ", must be bag");
  TrajectoryRequest truth;
  truth.path = line.truth;
  const std::vector<TrajectoryTarget> targets =
      PlanTrajectories(truth, Method::kJoint, 1, line.imus);
  const SessionData data = Simulate(simulator, line.imus);
  OutputFiles outputs;
  if (is_bag) {
    line.bag.ros2 = bag_format->second;
    WriteBag(outputs.Draft(line.output), data, line.bag);
  }
  if (line.format == "asl") WriteAslFolder(prefix, data, &outputs);
  if (line.format == "text") WriteTables(prefix, data, line.bag.split_imu, &outputs);
  outputs.Write(prefix + ".truth.yaml", TruthYaml(simulator));
  for (const TrajectoryTarget& target : targets)
    WriteTruth(target, FurtherImu(simulator, target.place), data.imus[target.place], &outputs);
  outputs.Commit();
  if (line.lidar) {
    AppendLidar(line.output, simulator);
    WriteFile(prefix + ".lidar.yaml", LidarYaml());
  }
}

}  // namespace
}  // namespace imu_pose_calib

int main(int argc, char** argv) {
  return imu_pose_calib::RunCommand("simulate_bag", [&] { imu_pose_calib::Run(argc, argv); });
}
